"""The parameters of an atmosphere: one immutable pytree, presets, and the TOML file that holds it."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tomli_w
from jaxtyping import Array, Float

from diffatmo import constants, spectrum
from diffatmo._names import did_you_mean
from diffatmo._types import Altitude, Scalar, Spectrum
from diffatmo.numerics import array
from diffatmo.phase import MIE_PHASES, PhaseTable, Shape


class AtmosphereError(ValueError):
    """A parameter is missing, unknown or out of range; the message names the key and what would be right."""


class DensityProfile(eqx.Module):
    """Relative number density against altitude in two layers (Bruneton 2017, ``DensityProfileLayer``).

    In each layer the density is ``max(0, exp_term exp(exp_scale h) + linear_term h + constant_term)``; the lower layer
    ends at altitude ``width``. Every number but ``width`` has the shape (2,): lower layer, upper layer.
    """

    width: Scalar
    exp_term: Float[Array, "2"]
    exp_scale: Float[Array, "2"]
    linear_term: Float[Array, "2"]
    constant_term: Float[Array, "2"]

    def __call__(self, altitude: Altitude) -> Float[Array, "..."]:
        """Relative density (1 at the reference level) at ``altitude``, km."""
        # The layer first, then its formula: one exponential, not two.
        layer = (self.exp_term, self.exp_scale, self.linear_term, self.constant_term)
        term, scale, linear, constant = (jnp.where(altitude < self.width, x[0], x[1]) for x in layer)
        density = term * jnp.exp(scale * altitude) + linear * altitude + constant
        return jnp.where(density > 0, density, 0)

    @classmethod
    def exponential(cls, scale_height: Scalar) -> "DensityProfile":
        """exp(-h / scale_height), ``scale_height`` in km."""
        zero, rate = jnp.zeros(2), jnp.stack([jnp.zeros_like(scale_height), -1 / scale_height])
        return cls(jnp.zeros(()), jnp.array([0.0, 1.0]), rate, zero, zero)

    @classmethod
    def tent(cls, center: Scalar, half_width: Scalar) -> "DensityProfile":
        """1 at altitude ``center``, falling linearly to 0 at ``center ± half_width`` (km)."""
        zero, slope = jnp.zeros(2), 1 / half_width
        return cls(
            center,
            zero,
            zero,
            jnp.stack([slope, -slope]),
            jnp.stack([1 - center * slope, 1 + center * slope]),
        )


def _numbers(value: Any) -> Any:
    """``value`` as an array of JAX's; what holds no numbers, as one of NumPy's, for :func:`check` to name."""
    try:
        return array(value)
    except (TypeError, ValueError):
        return np.array(value, dtype=object)


class Atmosphere(eqx.Module):
    """All parameters of a planet's sky, at ``w`` wavelengths.

    Lengths are km, coefficients km^-1 at the ground (ozone: at its peak), wavelengths nm. Every leaf is an array and may
    be differentiated; ``mie_phase`` is static: a name, or a :class:`~diffatmo.phase.PhaseTable`, to which ``mie_g`` means
    nothing. Raises :class:`AtmosphereError` for a value outside its range.
    """

    wavelengths: Spectrum = eqx.field(converter=_numbers)
    solar_irradiance: Spectrum = eqx.field(converter=_numbers)
    bottom_radius: Scalar = eqx.field(converter=_numbers)
    top_radius: Scalar = eqx.field(converter=_numbers)
    rayleigh_scattering: Spectrum = eqx.field(converter=_numbers)
    rayleigh_scale_height: Scalar = eqx.field(converter=_numbers)
    mie_scattering: Spectrum = eqx.field(converter=_numbers)
    mie_absorption: Spectrum = eqx.field(converter=_numbers)
    mie_scale_height: Scalar = eqx.field(converter=_numbers)
    mie_g: Scalar = eqx.field(converter=_numbers)
    ozone_absorption: Spectrum = eqx.field(converter=_numbers)
    ground_albedo: Spectrum = eqx.field(converter=_numbers)
    ozone_center_altitude: Scalar = eqx.field(converter=_numbers, default=25.0)
    ozone_half_width: Scalar = eqx.field(converter=_numbers, default=15.0)
    mie_phase: Shape = eqx.field(static=True, default="henyey-greenstein")

    def __check_init__(self) -> None:
        check(self)

    @property
    def top_altitude(self) -> Scalar:
        """Altitude of the top of the atmosphere, km."""
        return self.top_radius - self.bottom_radius

    @property
    def mie_extinction(self) -> Spectrum:
        """Aerosol scattering plus absorption, km^-1."""
        return self.mie_scattering + self.mie_absorption

    @property
    def rayleigh_optical_depth(self) -> Spectrum:
        """Vertical optical depth τ_R = β_R H_R (of the whole exponential, not cut at the top)."""
        return self.rayleigh_scattering * self.rayleigh_scale_height

    @property
    def mie_optical_depth(self) -> Spectrum:
        """Vertical aerosol extinction optical depth τ_M = (scattering + absorption) H_M."""
        return self.mie_extinction * self.mie_scale_height

    @property
    def rayleigh_density(self) -> DensityProfile:
        """Relative density of air."""
        return DensityProfile.exponential(self.rayleigh_scale_height)

    @property
    def mie_density(self) -> DensityProfile:
        """Relative density of aerosol."""
        return DensityProfile.exponential(self.mie_scale_height)

    @property
    def ozone_density(self) -> DensityProfile:
        """Relative density of the absorber, 1 at its peak."""
        return DensityProfile.tent(self.ozone_center_altitude, self.ozone_half_width)


_UNITS = {
    "wavelengths": "_nm",
    "bottom_radius": "_km",
    "top_radius": "_km",
    "rayleigh_scattering": "_per_km",
    "rayleigh_scale_height": "_km",
    "mie_scattering": "_per_km",
    "mie_absorption": "_per_km",
    "mie_scale_height": "_km",
    "ozone_absorption": "_per_km",
    "ozone_center_altitude": "_km",
    "ozone_half_width": "_km",
}
FILE_KEYS = {field.name: field.name + _UNITS.get(field.name, "") for field in fields(Atmosphere)}
"""Field of :class:`Atmosphere` -> key of the TOML file (the unit is in the key)."""

TABULATED, ANGLES, VALUES = "tabulated", "mie_phase_angles_deg", "mie_phase_values"
"""How a file names a table of the aerosol's phase function, and its two keys."""

SPECTRAL = (
    "wavelengths",
    "solar_irradiance",
    "rayleigh_scattering",
    "mie_scattering",
    "mie_absorption",
    "ozone_absorption",
    "ground_albedo",
)
"""Fields with one number per wavelength."""

_POSITIVE = ("bottom_radius", "rayleigh_scale_height", "mie_scale_height", "ozone_half_width")
_NOT_NEGATIVE = (
    "solar_irradiance",
    "rayleigh_scattering",
    "mie_scattering",
    "mie_absorption",
    "ozone_absorption",
    "ozone_center_altitude",
)


_PHASE_NAMES = f"{' or '.join(map(repr, MIE_PHASES))}, or a table: a PhaseTable, in a file {TABULATED!r}"

SHORTEST_NM, LONGEST_NM = 10.0, 1e6
"""Wavelengths beyond which the unit is another one."""


def _refuse(key: str, value: Any, expected: str) -> None:
    raise AtmosphereError(f"{FILE_KEYS.get(key, key)}: got {value}, expected {expected}")


def _listed(value: np.ndarray) -> Any:
    """With as few digits as tell the number in its own precision."""
    return np.reshape([float(str(x)) for x in value.flat], value.shape).tolist()


def check(atmosphere: Atmosphere) -> None:
    """Raise :class:`AtmosphereError` unless every concrete value is in its range (traced values are not looked at)."""
    if not isinstance(atmosphere.mie_phase, PhaseTable) and atmosphere.mie_phase not in MIE_PHASES:
        _refuse("mie_phase", repr(atmosphere.mie_phase), _PHASE_NAMES)
    values: dict[str, np.ndarray] = {}
    count: int | None = None
    for name in FILE_KEYS:
        value = getattr(atmosphere, name)
        if name == "mie_phase":
            continue
        if isinstance(value, np.ndarray):
            _refuse(name, value.tolist(), "numbers")
        if name in SPECTRAL:
            if value.ndim != 1 or value.size == 0:
                _refuse(name, f"an array of shape {value.shape}", "a list with one number per wavelength")
            count = value.size if count is None else count
            if value.size != count:
                _refuse(name, f"{value.size} numbers", f"{count}, one for each of {FILE_KEYS['wavelengths']}")
        elif value.ndim != 0:
            _refuse(name, f"an array of shape {value.shape}", "one number")
        if isinstance(value, jax.core.Tracer):
            continue
        values[name] = np.asarray(value)
        if not np.all(np.isfinite(values[name])):
            _refuse(name, _listed(values[name]), "finite numbers")
    if "wavelengths" in values and not np.all(
        (values["wavelengths"] >= SHORTEST_NM) & (values["wavelengths"] <= LONGEST_NM)
    ):
        _refuse("wavelengths", _listed(values["wavelengths"]), f"nm, from {SHORTEST_NM:g} to {LONGEST_NM:g}")
    for name in _POSITIVE:
        if name in values and np.any(values[name] <= 0):
            _refuse(name, _listed(values[name]), "numbers > 0")
    for name in _NOT_NEGATIVE:
        if name in values and np.any(values[name] < 0):
            _refuse(name, _listed(values[name]), "numbers >= 0")
    if "ground_albedo" in values and np.any((values["ground_albedo"] < 0) | (values["ground_albedo"] > 1)):
        _refuse("ground_albedo", _listed(values["ground_albedo"]), "numbers from 0 to 1")
    if "mie_g" in values and abs(float(values["mie_g"])) >= 1:
        _refuse("mie_g", _listed(values["mie_g"]), "a number with -1 < g < 1")
    if "top_radius" in values and "bottom_radius" in values and values["top_radius"] <= values["bottom_radius"]:
        _refuse(
            "top_radius",
            _listed(values["top_radius"]),
            f"more than bottom_radius_km = {_listed(values['bottom_radius'])}",
        )


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise AtmosphereError(f"{key}: got {value!r}, expected a number")
    return float(value)


def from_dict(data: Mapping[str, Any]) -> Atmosphere:
    """An atmosphere from the keys of its TOML file.

    Raises :class:`AtmosphereError` naming the key for anything missing, unknown, of the wrong type or out of range.
    """
    by_key = {key: name for name, key in FILE_KEYS.items()}
    data, table = _take_table(data)
    unknown = sorted(set(data) - set(by_key))
    if unknown:
        hint = did_you_mean(unknown[0], list(by_key)) or ";"
        raise AtmosphereError(f"{unknown[0]}: unknown key{hint} an atmosphere has the keys {', '.join(by_key)}")
    optional = ("ozone_center_altitude", "ozone_half_width", "mie_phase", *["mie_g"] * (table is not None))
    missing = [key for key, name in by_key.items() if key not in data and name not in optional]
    if missing:
        raise AtmosphereError(f"{missing[0]}: missing; an atmosphere needs {', '.join(missing)}")
    values: dict[str, Any] = {}
    for key, value in data.items():
        name = by_key[key]
        if name == "mie_phase":
            if not isinstance(value, str):
                _refuse(name, repr(value), f"a name: {_PHASE_NAMES}")
            values[name] = value
        elif name in SPECTRAL:
            if not isinstance(value, list) or not value:
                raise AtmosphereError(f"{key}: got {value!r}, expected a list with one number per wavelength")
            values[name] = [_number(key, item) for item in value]
        else:
            values[name] = _number(key, value)
    if table is not None:
        values = {"mie_g": table.asymmetry} | values | {"mie_phase": table}
    return Atmosphere(**values)


def _take_table(data: Mapping[str, Any]) -> tuple[dict[str, Any], PhaseTable | None]:
    """Split the table of the aerosol's phase function, if the file has one, from the other keys."""
    rest = {key: value for key, value in data.items() if key not in (ANGLES, VALUES)}
    if data.get("mie_phase") != TABULATED:
        if len(rest) < len(data):
            raise AtmosphereError(f"{ANGLES}, {VALUES}: given, but mie_phase is not {TABULATED!r}")
        return rest, None
    columns = []
    for key in (ANGLES, VALUES):
        if not isinstance(data.get(key), list):
            raise AtmosphereError(
                f"{key}: got {data.get(key)!r}, expected a list of numbers, as mie_phase is {TABULATED!r}"
            )
        columns.append([_number(key, item) for item in data[key]])
    try:
        table = PhaseTable(*columns)
    except ValueError as error:
        raise AtmosphereError(f"{ANGLES}, {VALUES}: {error}") from error
    del rest["mie_phase"]
    return rest, table


def _shortest(value: Any) -> float:
    """The decimal with the fewest digits that reads back as the same number in the same precision."""
    number = float(str(value))
    return number if math.isfinite(number) else float(value)


def to_dict(atmosphere: Atmosphere) -> dict[str, Any]:
    """The keys of the TOML file, as plain Python numbers that read back to the same bits."""
    result: dict[str, Any] = {}
    for name, key in FILE_KEYS.items():
        value = getattr(atmosphere, name)
        if isinstance(value, PhaseTable):
            result |= {key: TABULATED, ANGLES: list(value.angles_deg), VALUES: list(value.values)}
        elif isinstance(value, str):
            result[key] = value
        else:
            array = np.asarray(value)
            result[key] = [_shortest(item) for item in array] if array.ndim else _shortest(array[()])
    return result


def loads(text: str, source: str = "atmosphere") -> Atmosphere:
    """Read an atmosphere from TOML text; ``source`` is named in the errors."""
    try:
        return from_dict(tomllib.loads(text))
    except AtmosphereError as error:
        raise AtmosphereError(f"{source}: {error}") from error
    except (ValueError, OverflowError, RecursionError) as error:
        raise AtmosphereError(f"{source}: not a TOML file of an atmosphere: {error}") from error


def dumps(atmosphere: Atmosphere) -> str:
    """Write an atmosphere as TOML text; :func:`loads` gives the same bits back."""
    return tomli_w.dumps(to_dict(atmosphere), multiline_strings=False)


def load(path: str | Path) -> Atmosphere:
    """Read an atmosphere from a TOML file. Raises :class:`AtmosphereError` naming file and key."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise AtmosphereError(f"{path}: cannot be read: {error}") from error
    return loads(text, str(path))


def save(atmosphere: Atmosphere, path: str | Path) -> None:
    """Write an atmosphere to a TOML file."""
    Path(path).write_text(dumps(atmosphere), encoding="utf-8")


def earth(wavelengths: Any = None) -> Atmosphere:
    """A clear day on Earth.

    Without ``wavelengths`` (nm): the three bands 680, 550, 440 nm of Bruneton & Neyret 2008 with Hillaire 2020's ozone
    (table 1: Rayleigh (5.802, 13.558, 33.1)e-3 /km over 8 km, Mie 3.996e-3 scattering and 0.444e-3 absorption over
    1.2 km, g = 0.8, ozone (0.650, 1.881, 0.085)e-3), a solar irradiance of 1 and an albedo of 0.3. With wavelengths, the
    same air computed by :mod:`diffatmo.spectrum`: Rayleigh after Bodhaine et al. 1999, 300 DU of ozone, grey aerosol, the
    solar spectrum.
    """
    if wavelengths is None:
        bands = jnp.array([680.0, 550.0, 440.0])
        solar, air = jnp.ones(3), jnp.array([5.802e-3, 13.558e-3, 33.1e-3])
        ozone = jnp.array([0.650e-3, 1.881e-3, 0.085e-3])
    else:
        bands = array(wavelengths)
        solar, air = spectrum.solar_irradiance(bands), spectrum.rayleigh_scattering(bands)
        ozone = spectrum.ozone_absorption(bands, column_du=300.0)
    ones = jnp.ones_like(bands)
    return Atmosphere(
        wavelengths=bands,
        solar_irradiance=solar,
        bottom_radius=constants.EARTH_RADIUS_KM,
        top_radius=constants.EARTH_RADIUS_KM + 100.0,
        rayleigh_scattering=air,
        rayleigh_scale_height=8.0,
        mie_scattering=3.996e-3 * ones,
        mie_absorption=0.444e-3 * ones,
        mie_scale_height=1.2,
        mie_g=0.8,
        ozone_absorption=ozone,
        ground_albedo=0.3 * ones,
    )


def mars() -> Atmosphere:
    """A moderately dusty day on Mars at 680, 550, 440 nm.

    Air: CO2 at 610 Pa and 210 K, its Rayleigh cross section 2.4 times that of terrestrial air (Sneep & Ubachs 2005,
    table 2), scale height kT/mg = 10.8 km. Dust: optical depth 0.5 mixed with the gas (Lemmon et al. 2015),
    single-scattering albedo 0.97, 0.94, 0.76 (Tomasko et al. 1999; Wolff et al. 2009), g = 0.7. Ground: bright soil,
    albedo 0.30, 0.16, 0.07 (Bell et al. 2008). Irradiance relative to 1 at Mars.
    """
    bands = jnp.array([680.0, 550.0, 440.0])
    number_density_ratio = 610.0 / (1.380649e-23 * 210.0) / constants.LOSCHMIDT
    extinction = 0.5 / 10.8
    albedo = np.array([0.97, 0.94, 0.76])
    return Atmosphere(
        wavelengths=bands,
        solar_irradiance=jnp.ones(3),
        bottom_radius=constants.MARS_RADIUS_KM,
        top_radius=constants.MARS_RADIUS_KM + 120.0,
        rayleigh_scattering=2.4 * number_density_ratio * spectrum.rayleigh_scattering(bands),
        rayleigh_scale_height=10.8,
        mie_scattering=extinction * albedo,
        mie_absorption=extinction * (1 - albedo),
        mie_scale_height=10.8,
        mie_g=0.7,
        ozone_absorption=jnp.zeros(3),
        ground_albedo=[0.30, 0.16, 0.07],
    )


PRESETS = {"earth": earth, "mars": mars}
"""Presets by the name the command line takes."""
