"""What is known of an atmosphere before an image is looked at.

A prior is a normal distribution of one number of the result (:mod:`fitting.quantities`), or of its logarithm. It enters the
fit as one more residual, (number - value) / error, and the result says for every number how much of its precision is the
images' own. The named priors state what the field knows anyway, each with its source.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffatmo import constants, spectrum
from diffatmo._names import did_you_mean
from diffatmo.atmosphere import Atmosphere
from diffatmo.compiling import outermost
from diffatmo.numerics import array, safe_log
from fitting._errors import FitError, is_number
from fitting.parameters import Coordinates, Parameters
from fitting.quantities import DERIVED, REFERENCE_NM, Quantity, numbers, quantities, spectral_name

ONE = 1e-4
"""Second singular value, over the first, of the derivatives of numbers that vary as one: rounding."""

SMALLEST, LARGEST = 1e-15, 1e15
"""Errors, and values, of which single precision holds the squares."""


@dataclass(frozen=True)
class Prior:
    """``name`` is ``value`` ± ``error``.

    ``name`` is a number of the result (``rayleigh_optical_depth_550``), or a spectral field, which means each of its
    wavelengths on its own; where they vary as one number, as by a tie, it is known once, at the wavelength nearest to 550 nm.
    With ``relative``, ``error`` is one of the logarithm: 0.1 for 10 %, ln 2 for a factor of two. Raises :class:`FitError`.
    """

    name: str
    value: float
    error: float
    relative: bool = False
    source: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise FitError(f"prior: got the name {self.name!r}, expected that of a number, like 'mie_g'")
        for key, value in (("value", self.value), ("error", self.error)):
            if not is_number(value):
                raise FitError(f"prior: {self.name}: {key}: got {value!r}, expected a number")
        if not (SMALLEST <= self.error <= LARGEST and abs(self.value) <= LARGEST):
            raise FitError(
                f"prior: {self}: expected a finite value and a finite error > 0, the value up to {LARGEST:g}, the error from "
                f"{SMALLEST:g} to {LARGEST:g}"
            )
        if self.relative and not self.value > 0:
            raise FitError(f"prior: {self}: a relative error needs a value > 0")

    def __str__(self) -> str:
        """As one would write it."""
        spread = f"× e^±{self.error:.2g}" if self.relative else f"± {self.error:.3g}"
        return f"{self.name} = {self.value:.5g} {spread}"


class Priors(eqx.Module):
    """Priors as residuals."""

    fields: tuple[str, ...] = eqx.field(static=True)
    index: Int[Array, " k"]
    """Which of the numbers of ``fields``."""
    value: Float[Array, " k"]
    error: Float[Array, " k"]
    relative: Bool[Array, " k"]

    def residuals(self, atmosphere: Atmosphere) -> Float[Array, " k"]:
        """(number - value) / error."""
        found = numbers(atmosphere, self.fields)[self.index]
        # safe_log is finite at zero, where a number may start.
        logarithm = safe_log(found) - safe_log(jnp.where(self.relative, self.value, 1))
        return jnp.where(self.relative, logarithm, found - self.value) / self.error


def varying(parameters: Parameters) -> tuple[list[str], list[Quantity]]:
    """The fields, derived ones included, that vary in a fit of ``parameters``, and their numbers."""
    free = set(parameters.fields)
    fields = [*parameters.fields, *(name for name in DERIVED if free & set(DERIVED[name].ingredients))]
    return fields, quantities(fields, [float(nm) for nm in parameters.init.wavelengths])


def collect(priors: Sequence[Prior], parameters: Parameters) -> Priors | None:
    """``priors`` on numbers of ``parameters``; raises :class:`FitError` for one that is not of a number that varies."""
    if not priors:
        return None
    fields, known = varying(parameters)
    index: list[int] = []
    stated: list[Prior] = []
    for prior in priors:
        # The name of one number may be that of a field as well.
        alone = any(prior.name == one.name for one in known) or not any(prior.name == one.field for one in known)
        name = prior.name if alone else _once(prior.name, parameters)
        meant = [number for number, one in enumerate(known) if one.name == name][:1]
        meant = meant or [number for number, one in enumerate(known) if one.field == name]
        if not meant:
            names = ", ".join(dict.fromkeys(one.field for one in known))
            hint = did_you_mean(prior.name, [text for one in known for text in (one.field, one.name)]) or ";"
            raise FitError(f"prior: {prior.name!r} does not vary in this fit{hint} numbers that do are of {names}")
        index += meant
        stated += [prior] * len(meant)
    dtype = parameters.start.dtype
    return Priors(
        fields=tuple(fields),
        index=array(index, int),
        value=array([prior.value for prior in stated], dtype),
        error=array([prior.error for prior in stated], dtype),
        relative=array([prior.relative for prior in stated], bool),
    )


# Named priors -------------------------------------------------------------------------------------------------------


def molecular(parameters: Parameters, *, pressure_hpa: float = 1013.25, temperature_k: float = 288.15) -> list[Prior]:
    """Air, from pressure and temperature at the ground.

    The optical depth of air is proportional to the mass above, thus to the pressure: Bodhaine et al. 1999, J. Atmos. Oceanic
    Technol. 16, 1854, whose values are good to 0.5 %. Column over density at the ground is R T / (M g) for any profile in
    hydrostatic equilibrium; that an exponential stands for the real profile makes it uncertain by 5 %.

    Where a tie makes the scattering one number, so is what is known of it; by how much the tied spectrum departs from that of
    air (λ⁻⁴ by 2 %) adds to its error.
    """
    for name, value in (("pressure_hpa", pressure_hpa), ("temperature_k", temperature_k)):
        if not (is_number(value) and 0 < value < math.inf):
            raise FitError(f"prior: molecular: {name}: got {value!r}, expected a number > 0")
    height = constants.GAS_CONSTANT * temperature_k / (constants.MOLAR_MASS_AIR * constants.GRAVITY) / 1000
    # The coefficients of the spectrum are those of sea level in the standard atmosphere.
    wavelengths = parameters.init.wavelengths
    standard = spectrum.rayleigh_scattering(wavelengths)
    standard_height = constants.GAS_CONSTANT * 288.15 / (constants.MOLAR_MASS_AIR * constants.GRAVITY) / 1000
    depths = standard * standard_height * pressure_hpa / 1013.25
    source = "Bodhaine et al. 1999; hydrostatic equilibrium"
    known, error = list(zip(map(float, wavelengths), map(float, depths), strict=True)), 0.005
    if _together("rayleigh_optical_depth", parameters):
        tied = parameters.atmosphere(parameters.start).rayleigh_scattering
        error = math.hypot(error, float(np.std(np.log(np.asarray(tied) / np.asarray(standard)))))
        known = [known[_middle(parameters)]]
    return [
        *(Prior(spectral_name("rayleigh_optical_depth", nm), depth, error, True, source) for nm, depth in known),
        Prior("rayleigh_scale_height", height, 0.05, True, source),
    ]


def ozone(*, latitude_deg: float, longitude_deg: float, day_of_year: int) -> list[Prior]:
    """The column of ozone, from its climatology: Van Heuklon 1979, Solar Energy 22, 63, good to some 10 %.

    Where ozone is not tied to its own spectrum (``"dobson"``), this is a prior on the sum over the wavelengths.
    """
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 180 and 1 <= day_of_year <= 366):
        raise FitError(
            f"prior: ozone: got latitude {latitude_deg}, longitude {longitude_deg}, day {day_of_year}; expected degrees from "
            "-90 to 90 and -180 to 180, and a day from 1 to 366"
        )
    north = latitude_deg >= 0
    a, b, c, f, g, h = (150, 1.28, 40, -30, 20, 3) if north else (100, 1.5, 30, 152.625, 20, 2)
    i = (20 if longitude_deg > 0 else 0) if north else -75
    season = c * math.sin(math.radians(0.9865 * (day_of_year + f)))
    around = g * math.sin(math.radians(h * (longitude_deg + i)))
    column = 235 + (a + season + around) * math.sin(math.radians(b * latitude_deg)) ** 2
    return [Prior("ozone_column", column, 0.1, True, "Van Heuklon 1979")]


AEROSOLS = {
    "continental clean": (0.972, 0.709, 1.42),
    "continental average": (0.925, 0.703, 1.42),
    "continental polluted": (0.892, 0.698, 1.45),
    "urban": (0.817, 0.689, 1.43),
    "desert": (0.888, 0.729, 0.17),
    "maritime clean": (0.997, 0.772, 0.08),
    "maritime polluted": (0.975, 0.756, 0.35),
    "maritime tropical": (0.998, 0.774, 0.04),
    "arctic": (0.887, 0.721, 0.89),
    "antarctic": (1.000, 0.784, 0.73),
}
"""Single scattering albedo and asymmetry at 550 nm, Ångström exponent from 500 to 800 nm; humidity 80 % (Hess et al. 1998)."""


def aerosol(kind: str, parameters: Parameters) -> list[Prior]:
    """An aerosol of a type of OPAC (Hess, Koepke & Schult 1998, Bull. Amer. Meteor. Soc. 79, 831, table 4).

    As far as these vary in the fit: single scattering albedo ± 0.04 (at each wavelength, unless it is one number), asymmetry
    ± 0.04, Ångström exponent ± 0.3, by which the types differ among themselves and with humidity.
    """
    if kind not in AEROSOLS:
        raise FitError(f"prior: aerosol: got {kind!r}, expected one of {', '.join(AEROSOLS)}")
    albedo, asymmetry, exponent = AEROSOLS[kind]
    source = f"Hess et al. 1998, {kind}"
    wanted = [
        Prior(_once("mie_single_scattering_albedo", parameters), albedo, 0.04, source=source),
        Prior("mie_g", asymmetry, 0.04, source=source),
        Prior("mie_angstrom_exponent", exponent, 0.3, source=source),
    ]
    return _known(wanted, [*parameters.fields, *parameters.derived], parameters)


def typical(parameters: Parameters, *, pressure_error: float = 0.08) -> list[Prior]:
    """A clear sky of Earth, of which nothing is known but that it is one.

    The aerosol is any of :data:`AEROSOLS`, and so are its errors (Hess, Koepke & Schult 1998, table 4); its scale height is
    that of a boundary layer, within a factor of 1.6; ozone is its mean over Earth and seasons (Van Heuklon 1979), the ground
    anything between the sea and dry sand. Air is that of the start, ``pressure_error`` of the logarithm for the altitude.
    """
    albedo, asymmetry, exponent = (np.array(column) for column in zip(*AEROSOLS.values(), strict=True))
    opac, init = "Hess et al. 1998, all types", parameters.init
    middle = _middle(parameters)
    air = spectral_name("rayleigh_optical_depth", float(init.wavelengths[middle]))
    wanted = [
        Prior(
            _once("mie_single_scattering_albedo", parameters), float(albedo.mean()), float(albedo.std()), source=opac
        ),
        Prior("mie_g", float(asymmetry.mean()), 0.06, source=f"{opac}, as one Henyey-Greenstein"),
        Prior("mie_angstrom_exponent", float(exponent.mean()), float(exponent.std()), source=opac),
        Prior("mie_scale_height", 1.5, 0.5, True, "a boundary layer"),
        Prior("ozone_column", 300.0, 0.15, True, "Van Heuklon 1979"),
        Prior(_once("ground_albedo", parameters), 0.15, 0.7, True, "sea to sand"),
        Prior(air, float(init.rayleigh_optical_depth[middle]), pressure_error, True, "pressure at the place"),
    ]
    return _known(wanted, varying(parameters)[0], parameters)


def _known(wanted: Sequence[Prior], fields: Sequence[str], parameters: Parameters) -> list[Prior]:
    """Those of ``wanted`` that are of ``fields``."""
    every = quantities(fields, [float(nm) for nm in parameters.init.wavelengths])
    known = {name for one in every for name in (one.name, one.field)}
    return [prior for prior in wanted if prior.name in known]


def _middle(parameters: Parameters) -> int:
    return int(np.argmin(np.abs(np.asarray(parameters.init.wavelengths) - REFERENCE_NM)))


def _once(field: str, parameters: Parameters) -> str:
    """A spectral ``field``; or its number nearest to 550 nm where all vary as one, so that it counts once."""
    if not _together(field, parameters):
        return field
    return spectral_name(field, float(parameters.init.wavelengths[_middle(parameters)]))


def _together(field: str, parameters: Parameters) -> bool:
    """Whether the numbers of a ``field`` at several wavelengths vary as one: by a tie, or by something else they depend on."""
    slopes = np.asarray(outermost(_slopes)(parameters.start, parameters, field), dtype=np.float64)
    if len(slopes) < 2 or not np.isfinite(slopes).all():
        return False
    singular = np.linalg.svd(slopes, compute_uv=False)
    return bool(singular[0] > 0 and np.all(singular[1:] < ONE * singular[0]))


def _slopes(y: Coordinates, parameters: Parameters, field: str) -> Float[Array, "q n"]:
    return jax.jacfwd(lambda y: numbers(parameters.atmosphere(y), (field,)))(y)
