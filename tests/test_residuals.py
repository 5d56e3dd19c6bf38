"""Whitened residuals, and the coloured Jacobian against the plain one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky

from diffatmo.models import RayMarch
from fitting.batch import stack
from fitting.observation import sigma
from fitting.parameters import select
from fitting.residuals import Problem, jacobian, light, linearise, projected, residuals, smooth_fields, triangle

NM = [680.0, 550.0, 440.0]


def problem(model, free, tie=None, exposure=("fixed", "fixed"), pixels=40):
    mask = np.zeros((16, 64), bool)
    mask.flat[:: 16 * 64 // pixels] = True
    images = toy_sky.observations(zeniths=(30.0, 80.0), mask=mask, exposure=exposure)
    # Only the pixels that are used, and one that is not, whatever it holds.
    images = [eqx.tree_at(lambda o: o.shown, image, image.used.copy()) for image in images]
    images[0].shown[0, 1] = True
    images[0].image[0, 1] = np.nan
    batch = stack(images, NM)
    parameters = select(toy_sky.truth(), free, tie)
    weight = jnp.where(batch.used[..., None], 1 / sigma(batch, batch.measured), 0)
    y = jnp.concatenate([parameters.start, 0.1 * jnp.arange(batch.nuisances.size)])
    return Problem(model, parameters, batch, weight), y


@eqx.filter_jit
def both(y, ours):
    return jacobian(y, linearise(ours.split(y)[0], ours), ours)


@pytest.mark.parametrize("tie", [{"mie_absorption": "start"}, {"mie": "angstrom", "rayleigh_scattering": "lambda^-4"}])
def test_coloured_jacobian_is_the_jacobian(x64, tie):
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE, tie=tie, exposure=("free", "lens-per-channel"))
    assert ours.batch.nuisances.factors == 4
    residual, coloured = both(y, ours)
    np.testing.assert_allclose(residual, eqx.filter_jit(residuals)(y, ours), rtol=1e-12)
    plain = eqx.filter_jit(jax.jacfwd(residuals))(y, ours)
    np.testing.assert_allclose(coloured, plain, atol=1e-10 * np.abs(plain).max())


def test_wavelengths_do_not_mix_in_a_real_model():
    """What the colouring rests on."""
    model, towards = RayMarch(), jnp.asarray(toy_sky.towards_sun(60.0))
    directions = jnp.asarray(toy_sky.DIRECTIONS[::8, ::16])

    @jax.jit
    def image(atmosphere):
        return model.sky(atmosphere).view(altitude=jnp.asarray(0.1), sun=towards).radiance(view=directions).radiance

    own = toy_sky.truth()
    for name in ("rayleigh_scattering", "mie_scattering", "mie_absorption", "ozone_absorption", "ground_albedo"):
        other = toy_sky.change(own, **{name: getattr(own, name).at[0].mul(1.5)})
        changed = np.any(image(own) != image(other), axis=(0, 1))
        assert changed.tolist() == [name != "ground_albedo", False, False], name


def test_one_tangent_for_each_field():
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE)
    assert eqx.filter_eval_shape(linearise, y, ours).tangents.shape[-1] == len(toy_sky.FREE)
    assert y.size > 2 * len(toy_sky.FREE)


def test_unused_pixels_do_not_count():
    ours, y = problem(toy_sky.Toy(), ["mie_g"], exposure=("free", "fixed"))
    residual, slope = both(y, ours)
    unused = ~np.repeat(np.asarray(ours.batch.used).reshape(-1), 3)
    assert unused.any()
    assert np.all(residual[unused] == 0)
    assert np.all(slope[unused] == 0)


def test_residuals_at_the_truth_are_the_noise():
    ours, y = problem(toy_sky.Toy(), ["mie_g"], pixels=512)
    whitened = eqx.filter_jit(residuals)(y, ours)[np.repeat(np.asarray(ours.batch.used).reshape(-1), 3)]
    # About 3000 normal numbers: their standard deviation is known to 1.3 %.
    assert float(jnp.std(whitened)) == pytest.approx(1, abs=0.06)


def test_triangle_holds_what_least_squares_needs():
    random = np.random.default_rng(1)
    slope, residual = random.standard_normal((500, 4)), random.standard_normal(500)
    factor = np.asarray(triangle(jnp.asarray(residual, jnp.float32), jnp.asarray(slope, jnp.float32)), float)
    r, z = factor[:-1, :-1], factor[:-1, -1]
    # Float32 rounding of sums of 500 terms.
    np.testing.assert_allclose(r.T @ r, slope.T @ slope, atol=1e-3)
    np.testing.assert_allclose(r.T @ z, slope.T @ residual, atol=1e-3)
    assert np.sum(factor[:, -1] ** 2) == pytest.approx(np.sum(residual**2), rel=1e-5)


def test_smooth_fields_are_orthogonal_with_mean_square_one():
    """So that a sum of b of them with coefficients of variance 1/b has variance 1 in the mean over the used pixels."""
    batch = stack(toy_sky.observations(), [680.0, 550.0, 440.0])
    fields = smooth_fields(batch, 3)
    used = np.asarray(batch.used)
    for field, pixels in zip(fields, used, strict=True):
        assert np.all(field[~pixels] == 0)
        product = field[pixels].T @ field[pixels] / pixels.sum()
        np.testing.assert_allclose(product, np.eye(product.shape[0]), atol=1e-8)
    # On the sphere a polynomial of degree 3 has (3 + 1)² coefficients.
    assert fields.shape[-1] == 16


def test_projection_is_the_jacobian_transposed():
    """Against a relative error put into the radiance by hand."""
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE)
    linearisation = linearise(y[: ours.parameters.size], ours)
    _, slope = jacobian(y, linearisation, ours)
    fields = jnp.asarray(smooth_fields(ours.batch, 1), y.dtype)
    expected = light(y, linearisation, ours)
    got = projected(slope, expected, fields, ours)
    image, channel, field = 1, 2, 3
    wrong = expected.at[image, :, channel].multiply(1 + fields[image, :, field])
    moved = ((wrong - expected) * ours.weight).reshape(-1)
    np.testing.assert_allclose(got[image, channel, field], slope.T @ moved, rtol=1e-4, atol=1e-2)
