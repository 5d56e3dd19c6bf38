"""Whitened residuals, and the coloured Jacobian against the plain one."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plain_residuals
import pytest
import toy_sky
from plain_residuals import residuals

from diffatmo.models import RayMarch
from fitting.batch import rounded, stack
from fitting.correction import DIRECTIONS, Correction
from fitting.least_squares import jacobian, pushes, triangle
from fitting.linearisation import linearise
from fitting.observation import sigma
from fitting.parameters import select
from fitting.problem import Problem, light, predict, whitened
from fitting.smooth import Fields

NM = [680.0, 550.0, 440.0]
TIE = {"mie_absorption": "start"}


def problem(model, free, tie=None, exposure=("fixed", "fixed"), pixels=40, **options):
    mask = np.zeros((16, 64), bool)
    mask.flat[:: 16 * 64 // pixels] = True
    images = toy_sky.observations(zeniths=(30.0, 80.0), mask=mask, exposure=exposure, **options)
    # Only the pixels that are used, and one that is not, whatever it holds.
    images = [eqx.tree_at(lambda o: o.shown, image, image.used.copy()) for image in images]
    images[0].shown[0, 1] = True
    images[0].image[0, 1] = np.nan
    batch = stack(images, NM)
    parameters = select(toy_sky.truth(), free, tie)
    weight = jnp.where(batch.used[..., None], 1 / sigma(batch, batch.measured), 0)
    y = jnp.concatenate([parameters.start, 0.1 * jnp.arange(batch.nuisances.size)])
    return Problem(model, parameters, batch, weight), y


def test_pictures_of_other_sizes_need_no_other_program():
    """The arrays of a batch are of few sizes, so that what was compiled for one photo serves the next; none is much larger."""

    def arrays(shown):
        mask = np.arange(16 * 64).reshape(16, 64) < shown
        images = toy_sky.observations(zeniths=(30.0,), mask=mask)
        images = [eqx.tree_at(lambda o: o.shown, image, image.used.copy()) for image in images]
        return jax.tree.flatten(jax.tree.map(jnp.shape, stack(images, NM)), is_leaf=lambda x: isinstance(x, tuple))

    assert arrays(600) == arrays(1000)
    counts = np.arange(1, 8193)
    sizes = np.array([rounded(int(count)) for count in counts])
    assert len(np.unique(sizes)) < 16
    assert (sizes >= counts).all()
    assert (sizes[2048:] <= 1.25 * counts[2048:]).all()
    assert sizes[-1] == 8192


@pytest.mark.parametrize("tie", [{"mie_absorption": "start"}, {"mie": "angstrom", "rayleigh_scattering": "lambda^-4"}])
def test_coloured_jacobian_is_the_jacobian(x64, tie):
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE, tie=tie, exposure=("free", "lens-per-channel"))
    assert ours.batch.nuisances.factors == 4
    plain = eqx.filter_jit(jax.jacfwd(residuals))(y, ours)
    np.testing.assert_allclose(plain_residuals.jacobian(y, ours), plain, atol=1e-10 * np.abs(plain).max())


@pytest.mark.parametrize("tiles", [1, 4])
def test_rows_hold_the_sums_over_all_pixels(x64, tiles):
    """χ², gradient and JᵀJ, however many tiles, for the nuisances of the linearisation and for others."""
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE, tie=TIE, exposure=("free", "lens-per-channel"), pixels=45)
    assert ours.batch.measured.shape[1] % 4 == 0
    ours = eqx.tree_at(lambda p: p.batch, ours, dataclasses.replace(ours.batch, tiles=tiles))
    x, linear = ours.split(y)
    plain, slope = eqx.filter_jit(residuals)(y, ours), eqx.filter_jit(jax.jacfwd(residuals))(y, ours)
    for before in (linear, linear + jnp.array([0.3, -0.2, 0.1, 0.0])):
        found = eqx.filter_jit(linearise)(x, before, ours)
        residual, rows = jacobian(y, found, ours)
        assert rows.size < slope.size
        assert residual @ residual == pytest.approx(float(plain @ plain), rel=1e-10)
        np.testing.assert_allclose(
            rows.T @ residual, slope.T @ plain, rtol=1e-8, atol=1e-8 * np.abs(slope.T @ plain).max()
        )
        np.testing.assert_allclose(rows.T @ rows, slope.T @ slope, rtol=1e-8, atol=1e-9 * np.abs(slope.T @ slope).max())


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
    rows = eqx.filter_eval_shape(linearise, *ours.split(y), ours).rows
    # Besides radiance, one, and residual.
    assert rows.shape[-1] == len(toy_sky.FREE) + 3
    assert y.size > 2 * len(toy_sky.FREE)


def test_unused_pixels_do_not_count():
    ours, y = problem(toy_sky.Toy(), ["mie_g"], exposure=("free", "fixed"))
    residual, slope = residuals(y, ours), plain_residuals.jacobian(y, ours)
    unused = ~np.repeat(np.asarray(ours.batch.used).reshape(-1), 3)
    assert unused.any()
    assert np.all(residual[unused] == 0)
    assert np.all(slope[unused] == 0)
    assert np.isfinite(linearise(*ours.split(y), ours).rows).all()


def test_residuals_at_the_truth_are_the_noise():
    ours, y = problem(toy_sky.Toy(), ["mie_g"], pixels=512)
    whitened = eqx.filter_jit(residuals)(y, ours)[np.repeat(np.asarray(ours.batch.used).reshape(-1), 3)]
    # About 3000 normal numbers: their standard deviation is known to 1.3 %.
    assert float(jnp.std(whitened)) == pytest.approx(1, abs=0.06)


def test_triangle_holds_what_least_squares_needs():
    random = np.random.default_rng(1)
    slope, residual = random.standard_normal((500, 4)), random.standard_normal(500)
    factor = triangle(residual, slope)
    r, z = factor[:-1, :-1], factor[:-1, -1]
    np.testing.assert_allclose(r.T @ r, slope.T @ slope, atol=1e-9)
    np.testing.assert_allclose(r.T @ z, slope.T @ residual, atol=1e-9)
    assert np.sum(factor[:, -1] ** 2) == pytest.approx(np.sum(residual**2), rel=1e-12)
    assert triangle(residual[:2], slope[:2]).shape == (5, 5)


def test_smooth_fields_are_orthogonal_with_mean_square_one():
    """So that a sum of b of them with coefficients of variance 1/b has variance 1 in the mean over the used pixels."""
    batch = stack(toy_sky.observations(), [680.0, 550.0, 440.0])
    fields = Fields.of(batch, 3)
    for image, pixels in enumerate(np.asarray(batch.used)):
        field = np.asarray(fields.at(batch.directions[image, pixels], fields.centre[image], fields.coefficient[image]))
        np.testing.assert_allclose(field.T @ field / pixels.sum(), np.eye(field.shape[1]), atol=1e-3)
    # On the sphere a polynomial of degree 3 has (3 + 1)² coefficients.
    assert fields.coefficient.shape[-1] == 16


def test_a_correction_that_changes_has_its_part_of_the_derivatives(x64):
    """Along directions of any coordinates, those of the sun's place included."""
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE, tie=TIE, sun_offset="free", exposure=("free", "fixed"))
    random = np.random.default_rng(5)
    ratio = jnp.asarray(random.uniform(0.9, 1.1, ours.weight.shape))
    slope = jnp.asarray(random.uniform(-0.5, 0.5, (*ours.weight.shape, DIRECTIONS)))
    along = jnp.asarray(random.uniform(-0.5, 0.5, (DIRECTIONS, ours.size)))
    at = y[: ours.size] - 0.1
    ours = dataclasses.replace(ours, correction=Correction(ratio, at, slope, along))

    def corrected(y):
        coordinates, moved = ours.parts(y[: ours.size])
        radiance = predict(ours.sky, ours.parameters.atmosphere(coordinates), ours.batch.views(moved))
        return whitened(y, radiance * ratio * jnp.exp(slope @ (along @ (y[: ours.size] - at))), ours).reshape(-1)

    plain = eqx.filter_jit(jax.jacfwd(corrected))(y)
    np.testing.assert_allclose(plain_residuals.jacobian(y, ours), plain, atol=1e-10 * np.abs(plain).max())
    found = linearise(*ours.split(y), ours)
    residual, rows = jacobian(y, found, ours)
    assert residual @ residual == pytest.approx(float(corrected(y) @ corrected(y)), rel=1e-10)
    np.testing.assert_allclose(rows.T @ rows, plain.T @ plain, rtol=1e-8, atol=1e-9 * np.abs(plain.T @ plain).max())


@pytest.mark.parametrize("corrected", [False, True])
def test_a_push_is_the_jacobian_transposed(x64, corrected):
    """Against an error put into the radiance by hand: relative, or as large as what a correction has added there."""
    ours, y = problem(toy_sky.Toy(), toy_sky.FREE, exposure=("free", "fixed"))
    correction = jnp.asarray(np.random.default_rng(3).uniform(0.9, 1.1, ours.weight.shape))
    ours = dataclasses.replace(
        ours,
        fields=Fields.of(ours.batch, 1),
        correction=Correction.constant(correction, y[: ours.size]) if corrected else None,
    )
    got = pushes(y, linearise(*ours.split(y), ours), ours)
    coordinates, moved = ours.parts(ours.split(y)[0])
    atmosphere = ours.parameters.atmosphere(coordinates)
    expected = light(y, predict(ours.sky, atmosphere, ours.batch.views(moved)), ours) * (correction if corrected else 1)
    image, channel, field = 1, 2, 3
    forms = ours.fields.at(ours.batch.directions[image], ours.fields.centre[image], ours.fields.coefficient[image])
    part = 1 - 1 / correction[image, :, channel] if corrected else 1
    wrong = expected.at[image, :, channel].multiply(1 + part * forms[:, field])
    moved = np.asarray((wrong - expected) * ours.weight).reshape(-1)
    np.testing.assert_allclose(
        got[image, channel, field], plain_residuals.jacobian(y, ours).T @ moved, rtol=1e-8, atol=1e-6
    )
