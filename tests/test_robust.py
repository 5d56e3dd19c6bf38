"""Robust losses: derivatives that fit together, no harm to clean skies, and no harm by clouds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky
from toy_sky import FREE, Toy

from fitting import FitError, fit
from fitting.robust import _LOSSES as FUNCTIONS
from fitting.robust import LOSSES, Loss, scale


@pytest.mark.parametrize("name", LOSSES)
def test_weight_and_curvature_are_the_derivatives(name, x64):
    rho, _ = FUNCTIONS[name]
    u = jnp.array([0.0, 0.2, 0.7, 0.999, 1.001, 3.0, 100.0])
    _, first, second = rho(u)
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda v: rho(v)[0]))(u), first, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(jax.grad(lambda v: rho(v)[1]))(u), second, atol=1e-12)
    # Small residuals are given their squares.
    assert float(rho(jnp.array(1e-6))[0]) == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize("name", LOSSES)
def test_gradient_of_the_loss_is_that_of_the_weighted_residuals(name, x64):
    residual = 3 * jnp.asarray(np.random.default_rng(0).standard_normal((50, 3)))
    loss = Loss(name, jnp.array(1.3))
    gradient = jax.grad(lambda r: loss(r)[1])(residual)
    np.testing.assert_allclose(gradient, 2 * loss(residual)[0][:, None] * residual, rtol=1e-10)


def test_scale_is_that_of_the_noise_whatever_the_outliers():
    normal = np.random.default_rng(1).standard_normal((20_000, 3))
    everything = np.ones(20_000, bool)
    # The median of 20 000 values of χ² with 3 degrees of freedom is known to 1 %.
    assert scale(3 * normal, everything) == pytest.approx(3, rel=0.02)
    normal[:4000] += 1000
    assert scale(3 * normal, everything) < 3 * 1.3
    assert scale(0.1 * normal, everything) == 1


@pytest.mark.parametrize("name", LOSSES)
def test_a_clean_sky_is_fitted_as_by_least_squares(name):
    plain = toy_sky.result()
    robust = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), loss=name)
    assert robust.converged
    assert sum(robust.outliers) < 0.1 * sum(o.used.sum() for o in robust.observations)
    for ours, best in zip(robust.parameters, plain.parameters, strict=True):
        # What is given away is a few percent of the information.
        assert abs(ours.value - best.value) < 0.6 * best.standard_error
        assert 0.97 < ours.standard_error / best.standard_error < 1.2


def clouds(images, share, seed=0):
    """Bright patches over ``share`` of every image, up to three times the sky, and where they are."""
    random = np.random.default_rng(seed)
    places = []
    for image in images:
        height, width = image.used.shape
        covered = np.zeros((height, width), bool)
        while covered.mean() < share:
            y, x = random.integers(height), random.integers(width)
            rows, columns = np.ogrid[:height, :width]
            covered |= ((rows - y) ** 2 + ((columns - x) / 2) ** 2) < 4
        bright = 1 + 2 * random.random((height, width, 1)) * covered[..., None]
        image.image[:] = (image.image * bright).astype(np.float32)
        places.append(covered)
    return places


def test_clouds_over_a_fifth_of_the_sky_change_no_optical_depth():
    """By more than its standard error, held against the sky without the cloudy pixels; least squares is off by many."""
    free = ["rayleigh_scattering", "mie_scattering", "mie_g"]
    settings = {"init": toy_sky.change(toy_sky.truth(), mie_scattering=6e-3, mie_g=0.7), "free": free, "model": Toy()}
    images, masked = toy_sky.observations(), toy_sky.observations()
    places = clouds(images, 0.2)
    for image, covered in zip(masked, places, strict=True):
        image.used[covered] = False
    clean, cloudy, blind = fit(masked, **settings), fit(images, **settings, loss="tukey"), fit(images, **settings)
    depths = [e.name for e in clean.parameters if "optical_depth" in e.name]
    assert cloudy.converged
    # The faintest of the clouds, a few percent brighter than the sky, are not outliers.
    assert sum(cloudy.outliers) == pytest.approx(sum(covered.sum() for covered in places), rel=0.1)
    off = [abs(cloudy.estimate(n).value - clean.estimate(n).value) / cloudy.estimate(n).standard_error for n in depths]
    assert max(off) < 1
    wrong = [abs(blind.estimate(n).value - clean.estimate(n).value) / clean.estimate(n).standard_error for n in depths]
    assert max(wrong) > 10


def test_error_bars_with_a_loss_are_calibrated():
    """Over realisations of noise and clouds, errors divided by their bars have a mean square of one."""
    free, truth = ["rayleigh_scattering", "mie_g"], toy_sky.truth()
    pulls = []
    for seed in range(12):
        images = toy_sky.observations(seed)
        clouds(images, 0.1, seed)
        found = fit(images, init=truth, free=free, model=Toy(), loss="tukey").with_truth(truth)
        pulls += [e.pull for e in found.parameters if not e.derived]
    # 48 pulls, nearly independent: their mean square is 1 ± 0.2.
    assert 0.5 < np.mean(np.square(pulls)) < 1.8


def test_refuses_an_unknown_loss():
    with pytest.raises(FitError, match="loss: got 'l1', expected one of huber, cauchy, tukey"):
        fit(toy_sky.observations(), init=toy_sky.truth(), free=["mie_g"], model=Toy(), loss="l1")
