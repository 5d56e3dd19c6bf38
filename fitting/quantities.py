"""The numbers that a fit reports: the fields of the atmosphere, and what follows from them.

Images determine some combinations better than their factors, first of all the optical depths τ = β H, so these are numbers
of their own, with error bars of their own.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo import constants, spectrum
from diffatmo.atmosphere import FILE_KEYS, SPECTRAL, Atmosphere
from diffatmo.numerics import safe_divide, safe_log

REFERENCE_NM = 550.0
"""Where the optical depth of an aerosol is quoted."""


class Quantity(NamedTuple):
    """What a number of the result is: ``name`` is the field, and its wavelength in nm where it has one."""

    name: str
    field: str
    wavelength: float | None
    unit: str


def _angstrom_exponent(atmosphere: Atmosphere) -> Float[Array, ""]:
    """-d ln τ / d ln λ of the aerosol, between the shortest and the longest wavelength (Ångström 1929)."""
    bands, extinction = atmosphere.wavelengths, safe_log(atmosphere.mie_extinction)
    short, long = jnp.argmin(bands), jnp.argmax(bands)
    return safe_divide(extinction[short] - extinction[long], jnp.log(bands[long] / bands[short]))


def _at_reference(values: Float[Array, " w"], atmosphere: Atmosphere) -> Float[Array, ""]:
    """A spectrum at 550 nm: a power law between the wavelengths on either side."""
    bands = atmosphere.wavelengths
    order = jnp.argsort(bands)
    return jnp.exp(jnp.interp(jnp.log(REFERENCE_NM), jnp.log(bands[order]), safe_log(values)[order]))


def _optical_depth_at_reference(atmosphere: Atmosphere) -> Float[Array, ""]:
    """Aerosol extinction optical depth at 550 nm."""
    return _at_reference(atmosphere.mie_optical_depth, atmosphere)


def _visibility(atmosphere: Atmosphere) -> Float[Array, ""]:
    """Distance at which a contrast has fallen to 2 % at the ground, at 550 nm: ln 50 / extinction (Koschmieder 1924)."""
    at_ground = atmosphere.mie_extinction + atmosphere.rayleigh_scattering
    return safe_divide(jnp.log(50.0), _at_reference(at_ground, atmosphere))


def _turbidity(atmosphere: Atmosphere) -> Float[Array, ""]:
    """Optical depth of air and aerosol over that of air, at 550 nm (Preetham, Shirley & Smits 1999, section 2.2)."""
    air = _at_reference(atmosphere.rayleigh_optical_depth, atmosphere)
    return 1 + safe_divide(_at_reference(atmosphere.mie_optical_depth, atmosphere), air)


def _ozone_column(atmosphere: Atmosphere) -> Float[Array, ""]:
    """Vertical column in Dobson units of the ozone that absorbs as much, summed over the wavelengths."""
    per_unit = spectrum.ozone_cross_section(atmosphere.wavelengths) * constants.DOBSON_UNIT
    return jnp.sum(atmosphere.ozone_absorption) * atmosphere.ozone_half_width / jnp.sum(per_unit)


class _Derived(NamedTuple):
    """A combination of fields: its function, the fields it depends on, its unit, and whether it is a spectrum."""

    function: Callable[[Atmosphere], Float[Array, "..."]]
    ingredients: tuple[str, ...]
    unit: str
    spectral: bool


_AEROSOL = ("mie_scattering", "mie_absorption", "mie_scale_height")

DERIVED = {
    "rayleigh_optical_depth": _Derived(
        lambda a: a.rayleigh_optical_depth, ("rayleigh_scattering", "rayleigh_scale_height"), "", True
    ),
    "mie_optical_depth": _Derived(lambda a: a.mie_optical_depth, _AEROSOL, "", True),
    "mie_single_scattering_albedo": _Derived(
        lambda a: safe_divide(a.mie_scattering, a.mie_extinction), _AEROSOL[:2], "", True
    ),
    f"mie_optical_depth_{REFERENCE_NM:g}": _Derived(_optical_depth_at_reference, _AEROSOL, "", False),
    "mie_angstrom_exponent": _Derived(_angstrom_exponent, _AEROSOL[:2], "", False),
    "visibility": _Derived(_visibility, (*_AEROSOL[:2], "rayleigh_scattering"), "km", False),
    "turbidity": _Derived(_turbidity, (*_AEROSOL, "rayleigh_scattering", "rayleigh_scale_height"), "", False),
    "ozone_column": _Derived(_ozone_column, ("ozone_absorption", "ozone_half_width"), "DU", False),
}
"""Combinations by name."""

ALWAYS = ("rayleigh_optical_depth", "mie_optical_depth", "mie_single_scattering_albedo")
"""Those that are reported whenever they vary; the others mean something only with a spectral shape that is tied to them."""


def is_spectral(field: str) -> bool:
    """Whether ``field``, derived or not, has one number per wavelength."""
    return DERIVED[field].spectral if field in DERIVED else field in SPECTRAL


def derived_fields(free: Sequence[str], names: Sequence[str] = ALWAYS) -> list[str]:
    """Those of the derived quantities ``names`` that vary when the fields ``free`` do."""
    return [name for name in DERIVED if name in names and set(DERIVED[name].ingredients) & set(free)]


def spectral_name(name: str, wavelength: float) -> str:
    """Name of one wavelength's number."""
    return f"{name}_{wavelength:g}"


def _unit(field: str) -> str:
    if field in DERIVED:
        return DERIVED[field].unit
    suffix = FILE_KEYS.get(field, field).removeprefix(field)
    return {"_km": "km", "_per_km": "1/km", "_nm": "nm", "": ""}[suffix]


def quantities(fields: Sequence[str], wavelengths: Sequence[float]) -> list[Quantity]:
    """What each number of ``fields`` is, in order; spectral fields have one number per wavelength."""
    result = []
    for field in fields:
        if is_spectral(field):
            result += [Quantity(spectral_name(field, nm), field, nm, _unit(field)) for nm in wavelengths]
        else:
            result.append(Quantity(field, field, None, _unit(field)))
    return result


def numbers(atmosphere: Atmosphere, fields: Sequence[str]) -> Float[Array, " q"]:
    """The numbers of ``fields``, derived ones included, in the order of :func:`quantities`."""
    values = [DERIVED[name].function(atmosphere) if name in DERIVED else getattr(atmosphere, name) for name in fields]
    return jnp.concatenate([jnp.atleast_1d(value) for value in values])
