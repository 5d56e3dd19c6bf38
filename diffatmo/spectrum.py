"""Optical properties of sunlight, air, ozone and aerosol as functions of wavelength.

Everything here is a coefficient of a constituent at its reference level (the ground; for ozone the peak of its layer),
ready for the fields of :class:`diffatmo.atmosphere.Atmosphere`. Wavelengths are nm; tables cover
:data:`WAVELENGTH_RANGE` and are interpolated linearly, so that every function has a derivative in wavelength too.
"""

from functools import cache
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np

from diffatmo import constants
from diffatmo._types import Scalar, Spectrum

WAVELENGTH_RANGE = (360.0, 840.0)
"""Interval, nm, covered by the tables of the sun and of ozone."""


@cache
def _table(name: str) -> np.ndarray:
    """Columns of ``data/<name>.csv``: wavelength first, one row of names after the comment that gives the source."""
    with resources.files("diffatmo").joinpath("data", f"{name}.csv").open(encoding="utf-8") as file:
        return np.loadtxt((line for line in file if not line.startswith(("#", "wavelength"))), delimiter=",").T


def _interpolate(name: str, wavelengths: Spectrum) -> Spectrum:
    """Linear interpolation in a table of bin means; refuses concrete wavelengths that it does not cover."""
    wavelengths = jnp.asarray(wavelengths, dtype=jnp.result_type(float))
    lower, upper = WAVELENGTH_RANGE
    if not isinstance(wavelengths, jax.core.Tracer) and not bool(
        jnp.all((wavelengths >= lower) & (wavelengths <= upper))
    ):
        raise ValueError(f"wavelengths_nm: got {wavelengths.tolist()}, expected numbers from {lower:g} to {upper:g}")
    nodes, values = _table(name)
    return jnp.interp(wavelengths, jnp.asarray(nodes), jnp.asarray(values))


def solar_irradiance(wavelengths: Spectrum) -> Spectrum:
    """Solar irradiance above the atmosphere at 1 au, W m^-2 nm^-1 (ASTM G173, means over 10 nm)."""
    return _interpolate("solar_irradiance", wavelengths)


def rayleigh_scattering(wavelengths: Spectrum) -> Spectrum:
    """Scattering coefficient of dry air (360 ppm CO2) at 1013.25 hPa and 288.15 K, km^-1.

    Cross section of Bodhaine, Wood, Dutton & Slusser 1999, J. Atmos. Oceanic Technol. 16, eq. 29 (within 0.01 % of the
    full calculation from 250 to 850 nm), times the number density there. Bucholtz 1995 agrees within 0.3 %, but is
    in two pieces that do not join smoothly at 500 nm.
    """
    square = (jnp.asarray(wavelengths, dtype=jnp.result_type(float)) * 1e-3) ** 2
    numerator = 1.0455996 - 341.29061 / square - 0.90230850 * square
    denominator = 1 + 0.0027059889 / square - 85.968563 * square
    per_km = 1e-32 * constants.LOSCHMIDT * 1e3
    return numerator / denominator * per_km


def ozone_cross_section(wavelengths: Spectrum) -> Spectrum:
    """Absorption cross section of ozone at 233 K, m^2 (Serdyuchenko et al. 2014, means over 10 nm)."""
    return _interpolate("ozone_cross_section", wavelengths)


def ozone_absorption(
    wavelengths: Spectrum, *, column_du: float | Scalar = 300.0, half_width: float | Scalar = 15.0
) -> Spectrum:
    """Absorption coefficient of ozone at the peak of its layer, km^-1.

    ``column_du`` is the vertical column in Dobson units. The layer is a tent of half-width ``half_width`` km, whose
    integral is ``half_width``, so that the number density at the peak is column / half_width.
    """
    optical_depth_per_dobson = ozone_cross_section(wavelengths) * constants.DOBSON_UNIT
    return optical_depth_per_dobson * (column_du / half_width)


def angstrom_aerosol(
    wavelengths: Spectrum,
    *,
    optical_depth_550: float | Scalar,
    exponent: float | Scalar,
    single_scattering_albedo: float | Scalar | Spectrum,
    scale_height: float | Scalar,
) -> tuple[Spectrum, Spectrum]:
    """Scattering and absorption coefficients, km^-1, of an aerosol at the ground.

    Its vertical extinction optical depth is ``optical_depth_550`` (wavelength / 550 nm)^-``exponent`` (Ångström 1929),
    spread over an exponential atmosphere of ``scale_height`` km.
    """
    ratio = jnp.asarray(wavelengths, dtype=jnp.result_type(float)) / 550.0
    extinction = optical_depth_550 / scale_height * ratio ** (-exponent)
    return single_scattering_albedo * extinction, (1 - single_scattering_albedo) * extinction
