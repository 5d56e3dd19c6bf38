"""Colour: published white points and the standard's own transfer function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import color

GRID = jnp.arange(360.0, 831.0, 10.0)


def test_equal_energy_is_white():
    # X = Y = Z by construction of the observer; the table's three integrals agree to 5e-4.
    np.testing.assert_allclose(jnp.ones(GRID.size) @ color.xyz_weights(GRID), 1, rtol=1e-5)
    # Its linear sRGB colour: rows of the standard's matrix summed.
    np.testing.assert_allclose(
        color.to_linear_srgb(jnp.ones(GRID.size), wavelengths=GRID), [1.2048, 0.9483, 0.9088], rtol=1e-3
    )


def black_body(kelvin, wavelengths):
    metres = np.asarray(wavelengths, dtype=np.float64) * 1e-9
    return jnp.asarray(metres**-5 / np.expm1(6.62607015e-34 * 2.99792458e8 / (metres * 1.380649e-23 * kelvin)) * 1e-30)


@pytest.mark.parametrize(
    ("kelvin", "x", "y"),
    # Planckian locus: CIE illuminant A is a black body of 2855.5 K at (0.4476, 0.4074); 6504 K is at (0.3135, 0.3236).
    [(2855.5, 0.4476, 0.4074), (6504.0, 0.3135, 0.3236)],
)
def test_chromaticity_of_black_bodies(kelvin, x, y):
    xyz = black_body(kelvin, GRID) @ color.xyz_weights(GRID)
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), [x, y], atol=3e-4)


def test_coarse_spectra_are_not_undersampled():
    # Linear in wavelength, so that interpolation is exact, at spacings the observer's curves would alias.
    def spectrum(wavelengths):
        return 1 + (wavelengths - 550) / 400

    fine, coarse = np.asarray(GRID), np.arange(360.0, 831.0, 94.0)
    np.testing.assert_allclose(
        spectrum(coarse) @ np.asarray(color.xyz_weights(jnp.asarray(coarse))),
        spectrum(fine) @ np.asarray(color.xyz_weights(GRID)),
        rtol=1e-4,
    )


def test_order_of_wavelengths_does_not_matter():
    rng = np.random.default_rng(0)
    radiance, shuffle = jnp.asarray(rng.random(GRID.size), dtype=jnp.float32), rng.permutation(GRID.size)
    np.testing.assert_allclose(
        color.to_linear_srgb(radiance[shuffle], wavelengths=GRID[shuffle]),
        color.to_linear_srgb(radiance, wavelengths=GRID),
        rtol=1e-5,
    )


def test_three_bands_are_shown_as_given_and_one_as_grey():
    descending = color.to_linear_srgb(jnp.array([1.0, 2.0, 3.0]), wavelengths=jnp.array([680.0, 550.0, 440.0]))
    ascending = color.to_linear_srgb(jnp.array([3.0, 2.0, 1.0]), wavelengths=jnp.array([440.0, 550.0, 680.0]))
    np.testing.assert_array_equal(descending, [1, 2, 3])
    np.testing.assert_array_equal(ascending, [1, 2, 3])
    np.testing.assert_array_equal(color.to_linear_srgb(jnp.array([5.0]), wavelengths=jnp.array([550.0])), [5, 5, 5])


def test_a_sun_that_light_is_relative_to_is_white():
    """Whatever the wavelengths; a sun of which the spectrum is known has its own colour."""
    nodes = jnp.array([405.0, 455.0, 520.0, 570.0, 625.0, 720.0])
    light = jnp.outer(jnp.array([0.5, 2.0]), jnp.ones(6))
    shown = color.to_linear_srgb_of_sunlight(light, wavelengths=nodes, irradiance=jnp.ones(6))
    np.testing.assert_allclose(shown, np.outer([0.5, 2.0], np.ones(3)), rtol=1e-6)
    known = jnp.linspace(1.0, 2.0, 6)
    np.testing.assert_array_equal(
        color.to_linear_srgb_of_sunlight(light, wavelengths=nodes, irradiance=known),
        color.to_linear_srgb(light, wavelengths=nodes),
    )


def test_luminance_weights_are_those_of_the_standard():
    np.testing.assert_allclose(color.LUMINANCE, [0.2126, 0.7152, 0.0722], atol=1e-4)


def test_srgb_transfer_function():
    # IEC 61966-2-1: 0.5 linear is code 188 of 255, and 18 % grey is 118.
    codes = 255 * color.srgb_encode(jnp.array([0.0, 0.18, 0.5, 1.0]))
    np.testing.assert_allclose(codes, [0, 117.6, 187.5, 255], atol=0.1)
    x = jnp.linspace(-0.1, 1.2, 500)
    np.testing.assert_allclose(color.srgb_decode(color.srgb_encode(x)), x, atol=2e-6)
    for function in (color.srgb_encode, color.srgb_decode):
        assert np.isfinite(jax.vmap(jax.grad(function))(jnp.array([-1.0, 0.0, 0.0031308, 0.04045, 1.0]))).all()


def test_tone_curve_is_exposure_for_dark_and_white_for_bright():
    np.testing.assert_allclose(color.tone_map(jnp.array([1e-4]), exposure=2.0), [2e-4], rtol=1e-3)
    np.testing.assert_allclose(color.tone_map(jnp.array([1e4, 3e38])), 1)
    assert float(color.tone_map(jnp.array(-1.0))) == 0


def test_auto_exposure_ignores_the_sun_and_survives_black():
    picture = jnp.ones((10, 10, 3)).at[0, 0].set(1e6)
    assert float(color.auto_exposure(picture)) == pytest.approx(1, rel=1e-5)
    assert float(color.auto_exposure(4 * picture)) == pytest.approx(0.25, rel=1e-5)
    assert float(color.auto_exposure(jnp.zeros((4, 4, 3)))) == 1
    framed = jnp.full((20, 20, 3), jnp.nan).at[5:15, 5:15].set(picture.reshape(10, 10, 3))
    assert float(color.auto_exposure(framed)) == float(color.auto_exposure(picture))
    assert np.isfinite(jax.grad(lambda p: color.auto_exposure(p))(jnp.zeros((4, 4, 3)))).all()


def test_display_differentiates(x64, check_jacobian):
    def shown(x):
        return color.display(x[:7], wavelengths=jnp.linspace(400.0, 700.0, 7), exposure=x[7])

    point = jnp.linspace(0.2, 0.9, 8)
    assert bool(jnp.all((shown(point) > 0) & (shown(point) < 1)))
    check_jacobian(shown, [point])
