"""Optical properties against numbers published elsewhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import constants, spectrum
from diffatmo.atmosphere import DensityProfile

GRID = np.arange(360.0, 841.0, 5.0)


def test_solar_spectrum_is_close_to_a_black_body_of_the_suns_size():
    # Planck's law at the sun's effective temperature (IAU 2015: 5772 K), seen under the sun's solid angle. The visible
    # continuum comes from deeper, hotter layers than the effective temperature: 5 % more over this band.
    h, c, k = 6.62607015e-34, 2.99792458e8, 1.380649e-23
    metres = GRID * 1e-9
    planck = 2 * h * c**2 / metres**5 / np.expm1(h * c / (metres * k * 5772.0)) * 1e-9 * constants.SUN_SOLID_ANGLE
    table = np.asarray(spectrum.solar_irradiance(GRID))
    wide = (GRID >= 450) & (GRID <= 800)
    assert np.trapezoid(table[wide], GRID[wide]) == pytest.approx(np.trapezoid(planck[wide], GRID[wide]), rel=0.06)


def test_solar_spectrum_averages_astm_g173():
    # Samples of the standard, column "Etr", at 400-409 nm and 430-439 nm.
    samples = np.array(
        [
            [1.6885, 1.7520, 1.8140, 1.7400, 1.7630, 1.7150, 1.6660, 1.6300, 1.6990, 1.8090],
            [1.2120, 1.0990, 1.8220, 1.6913, 1.5600, 1.7090, 1.8680, 1.9000, 1.6630, 1.6010],
        ]
    )
    np.testing.assert_allclose(spectrum.solar_irradiance(np.array([404.5, 434.5])), samples.mean(1), rtol=1e-5)


def test_rayleigh_agrees_with_bucholtz():
    # Bucholtz 1995, table 3: A lambda^-(B + C lambda + D / lambda), cross section in cm^2, wavelength in micrometres,
    # one fit below 0.5 and one above. Its authors claim 0.1 % each; refractive indices differ by another 0.2 %.
    short = np.array([0.36, 0.40, 0.44, 0.48])
    long = np.array([0.55, 0.60, 0.68, 0.80])
    sigma = np.concatenate(
        [
            3.01577e-28 * short ** -(3.55212 + 1.35579 * short + 0.11563 / short),
            4.01061e-28 * long ** -(3.99668 + 0.00110298 * long + 0.0271393 / long),
        ]
    )
    expected = sigma * 1e-4 * 2.54743e25 * 1e3
    found = spectrum.rayleigh_scattering(np.concatenate([short, long]) * 1e3)
    np.testing.assert_allclose(found, expected, rtol=3e-3)


def test_rayleigh_optical_depth_of_the_standard_atmosphere():
    # Hansen & Travis 1974, eq. 2.30, for 1013 hPa; the column of air above 45 N is 2.152e25 molecules/cm^2 (Bodhaine
    # et al. 1999, eq. 30). Refractive index and depolarisation have been revised since: 0.3 %.
    micrometres = np.array([0.40, 0.55, 0.70])
    expected = 0.008569 * micrometres**-4 * (1 + 0.0113 * micrometres**-2 + 0.00013 * micrometres**-4)
    column_km = 2.152e25 * 1e4 / constants.LOSCHMIDT * 1e-3
    found = np.asarray(spectrum.rayleigh_scattering(micrometres * 1e3)) * column_km
    np.testing.assert_allclose(found, expected, rtol=4e-3)


def test_ozone_coefficients_of_the_renderers():
    # Hillaire 2020, table 1: (0.650, 1.881, 0.085)e-3 per km at 680, 550, 440 nm for a tent of half-width 15 km. There
    # the mean from 680 to 690 nm stands for 680 nm; here it stands for the centre of that bin.
    found = spectrum.ozone_absorption(np.array([685.0, 555.0, 445.0]))
    np.testing.assert_allclose(found, [0.650e-3, 1.881e-3, 0.085e-3], rtol=2e-3)


def test_ozone_layer_integrates_to_its_column(x64):
    wavelengths = jnp.array([500.0, 600.0])
    center, half_width, column = 22.0, 12.0, 350.0
    peak = spectrum.ozone_absorption(wavelengths, column_du=column, half_width=half_width)
    altitude = jnp.linspace(0.0, 60.0, 60001)
    density = DensityProfile.tent(jnp.asarray(center), jnp.asarray(half_width))(altitude)
    depth = jnp.trapezoid(density, altitude) * peak
    # Optical depth of the column: molecules per area times cross section.
    expected = column * constants.DOBSON_UNIT * spectrum.ozone_cross_section(wavelengths)
    np.testing.assert_allclose(depth, expected, rtol=1e-7)


def test_chappuis_band_peaks_at_600_nm():
    # Peak of the Chappuis band: about 5e-25 m^2 = 5e-21 cm^2 at 602 nm (any handbook).
    sigma = np.asarray(spectrum.ozone_cross_section(GRID))
    assert abs(GRID[sigma.argmax()] - 602) < 5
    assert sigma.max() == pytest.approx(5.0e-25, rel=0.03)


def test_aerosol_has_the_optical_depth_and_albedo_asked_for():
    wavelengths = jnp.array([440.0, 550.0, 870.0])
    scattering, absorption = spectrum.angstrom_aerosol(
        wavelengths, optical_depth_550=0.2, exponent=1.4, single_scattering_albedo=0.9, scale_height=1.5
    )
    depth = (scattering + absorption) * 1.5
    assert float(depth[1]) == pytest.approx(0.2, rel=1e-6)
    slope = jnp.log(depth[0] / depth[2]) / jnp.log(wavelengths[2] / wavelengths[0])
    assert float(slope) == pytest.approx(1.4, rel=1e-5)
    np.testing.assert_allclose(scattering / (scattering + absorption), 0.9, rtol=1e-6)


def test_derivatives(x64, check_jacobian):
    # Away from the nodes of the tables, where the interpolant has kinks.
    def coefficients(wavelengths):
        return jnp.concatenate(
            [
                spectrum.solar_irradiance(wavelengths),
                1e2 * spectrum.rayleigh_scattering(wavelengths),
                1e3 * spectrum.ozone_absorption(wavelengths),
            ]
        )

    check_jacobian(coefficients, [[441.3, 552.1, 689.9]], step=1e-3, tolerance=1e-7)

    def constituents(x):
        wavelengths, (column, width, depth, exponent, albedo, height) = jnp.array([441.3, 689.9]), x
        aerosol = spectrum.angstrom_aerosol(
            wavelengths,
            optical_depth_550=depth,
            exponent=exponent,
            single_scattering_albedo=albedo,
            scale_height=height,
        )
        return jnp.stack([1e2 * spectrum.ozone_absorption(wavelengths, column_du=column, half_width=width), *aerosol])

    check_jacobian(constituents, [[300.0, 15.0, 0.1, 1.3, 0.9, 1.2]])


@pytest.mark.parametrize("wavelengths", [[300.0], [550.0, 1064.0], [float("nan")]])
def test_wavelengths_outside_the_tables_are_refused(wavelengths):
    with pytest.raises(ValueError, match=r"wavelengths_nm: .* expected numbers from 360 to 840"):
        spectrum.solar_irradiance(jnp.array(wavelengths))


def test_jit():
    wavelengths = jnp.array([440.0, 550.0])
    np.testing.assert_allclose(
        jax.jit(spectrum.ozone_absorption)(wavelengths), spectrum.ozone_absorption(wavelengths), rtol=1e-6
    )
