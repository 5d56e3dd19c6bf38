"""An atmosphere in the terms of other renderers: what they are given, what they cannot hold, and the way back.

What a renderer holds of an atmosphere is by definition what :func:`read` makes of what :func:`write` has written; all that
:func:`losses` and :func:`sky_losses` say follows from that.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.atmosphere import FILE_KEYS, Atmosphere, AtmosphereError
from diffatmo.compiling import outermost
from diffatmo.models import Moments
from diffatmo.numerics import gauss_legendre
from diffatmo.phase import PhaseTable
from diffatmo.presets import blender, bruneton, three_geospatial, unreal
from diffatmo.presets.fields import RED_GREEN_BLUE, PresetError, arranged

SUN_ZENITHS_DEG = (30.0, 60.0, 85.0)
ALTITUDE_KM = 0.1
ROWS, COLUMNS = 10, 10
"""Of the directions in which skies are compared: cosines of the zenith angle, azimuths on one side of the sun."""


class Target(NamedTuple):
    """A renderer's format."""

    dumps: Callable[[Atmosphere, str], str]
    loads: Callable[[str, Float[np.ndarray, " w"]], Atmosphere]
    title: str
    use: str
    """What to do with the file."""
    marks: str
    """What a text of this format contains, as a regular expression."""
    comment: str
    fixed: str
    """What becomes of a parameter that is not held."""
    three: bool
    """It has three channels, whose wavelengths it does not know."""
    holds_sun: bool
    beyond: str
    """What its own model of the sky adds to the differences stated."""


_BLENDER = "three densities, of air, aerosol and ozone, are all that can be set"

TARGETS: Mapping[str, Target] = {
    "unreal": Target(
        unreal.dumps, unreal.loads, "Unreal's SkyAtmosphere",
        "copy the text, and paste it into a level; a level has one SkyAtmosphere",
        r"SkyAtmosphereComponent", "//", "not within what the component holds", three=True, holds_sun=False,
        beyond="light scattered more than once after Hillaire 2020",
    ),
    "blender": Target(
        blender.dumps, blender.loads, "Blender's sky texture, Multiple Scattering (5.0 and later)",
        "run it in the Python console or the text editor",
        r"import bpy[\s\S]*MULTIPLE_SCATTERING", "#", _BLENDER, three=False, holds_sun=False,
        beyond="four wavelengths; light scattered more than once by a fit to the Earth's clear air",
    ),
    "blender-nishita": Target(
        blender.dumps_nishita, blender.loads_nishita,
        "Blender's sky texture, Nishita (2.90 to 4.5) or Single Scattering (5.0)",
        "run it in the Python console or the text editor",
        r"import bpy[\s\S]*(NISHITA|SINGLE_SCATTERING)", "#", _BLENDER, three=False, holds_sun=False,
        beyond="light scattered once only, and a black ground: too dark by a quarter to a half",
    ),
    "three-geospatial": Target(
        three_geospatial.dumps, three_geospatial.loads, "AtmosphereParameters of @takram/three-atmosphere",
        "import { atmosphere } from it, and pass it to PrecomputedTexturesGenerator and the effects",
        r"AtmosphereParameters", "//", "not a parameter", three=True, holds_sun=True,
        beyond="Bruneton's tables",
    ),
    "bruneton": Target(
        bruneton.dumps, bruneton.loads, "Bruneton's precomputed_atmospheric_scattering",
        "#include it, and pass its constants to the constructor of atmosphere::Model",
        r"kRayleighScattering", "//", "not a parameter", three=False, holds_sun=True,
        beyond="Bruneton's tables; the demo evaluates spectra at 680, 550 and 440 nm",
    ),
}  # fmt: skip


class Loss(NamedTuple):
    """One parameter that a target does not hold as it is."""

    key: str
    """As in the atmosphere file, with its unit."""
    given: tuple[float, ...] | str
    held: tuple[float, ...] | str
    why: str

    def __str__(self) -> str:
        return f"{self.key}: {_shown(self.given)} -> {_shown(self.held)} ({self.why})"


class SkyLoss(NamedTuple):
    """What the losses do to the sky: relative differences of radiance, zenith to horizon, under one sun."""

    sun_zenith_deg: float
    rms: float
    largest: float
    """By absolute value, with its sign."""

    def __str__(self) -> str:
        sun = f"sky, sun at {self.sun_zenith_deg:g} deg from the zenith"
        return f"{sun}: {100 * self.rms:.2g} % RMS, {100 * self.largest:+.2g} % at most"


def _shown(value: tuple[float, ...] | str) -> str:
    return value if isinstance(value, str) else ", ".join(f"{item:.6g}" for item in value)


def _target(name: str) -> Target:
    if name not in TARGETS:
        raise PresetError(f"{name}: no such target; known are {', '.join(TARGETS)}")
    return TARGETS[name]


def write(atmosphere: Atmosphere, target: str, *, remarks: Sequence[str] = ()) -> str:
    """``atmosphere`` in the format of ``target``, one of :data:`TARGETS`, with lines of ``remarks`` as comments.

    Raises :class:`PresetError` for an unknown target, or wavelengths that Blender's ozone is not known at.
    """
    chosen = _target(target)
    comments = [f"An atmosphere for {chosen.title}: {chosen.use}.", *remarks]
    lines = "".join(f"{chosen.comment} {line}\n" for line in comments)
    try:
        return chosen.dumps(arranged(atmosphere, three=chosen.three), lines)
    except PresetError:
        raise
    except ValueError as error:
        raise PresetError(f"{target}: {error}") from error


def read(
    text: str, target: str | None = None, *, wavelengths: Sequence[float] | None = None, source: str = "preset"
) -> Atmosphere:
    """The atmosphere in a preset of ``target``, by default the one it looks like.

    ``wavelengths``, nm, are those of the channels, red first, where the format does not say them (680, 550, 440); the solar
    irradiance is 1 where it is not said. Raises :class:`PresetError` naming ``source`` and the key.
    """
    likely = next((name for name, entry in TARGETS.items() if re.search(entry.marks, text)), None)
    chosen = target or likely
    try:
        if chosen is None:
            raise PresetError(f"not a preset that can be read; known are those of {', '.join(TARGETS)}")
        entry = _target(chosen)
        if not re.search(entry.marks, text):
            raise PresetError(f"not a preset of {chosen}" + (f"; it looks like one of {likely}" if likely else ""))
        channels = RED_GREEN_BLUE if wavelengths is None else tuple(wavelengths)
        if entry.three and len(channels) != 3:
            raise PresetError(f"wavelengths_nm: got {len(channels)}, expected three, for red, green and blue")
        return entry.loads(text, np.asarray(channels))
    except (PresetError, AtmosphereError) as error:
        raise PresetError(f"{source}: {error}") from error
    except ValueError as error:
        raise PresetError(f"{source}: cannot be read: {error}") from error


def _given_and_held(atmosphere: Atmosphere, target: str) -> tuple[Atmosphere, Atmosphere]:
    """The atmosphere from red to blue, at the bands of the target; and what is left of it there."""
    given = arranged(atmosphere, three=_target(target).three)
    return given, read(write(given, target), target, wavelengths=np.asarray(given.wavelengths).tolist())


def losses(atmosphere: Atmosphere, target: str) -> list[Loss]:
    """Every parameter of ``atmosphere`` that ``target`` does not hold to the last digit, at the target's bands."""
    chosen = _target(target)
    given, held = _given_and_held(atmosphere, target)
    found = []
    wavelengths = _numbers(np.sort(np.asarray(atmosphere.wavelengths))[::-1])
    if chosen.three and len(wavelengths) != 3:
        why = "three channels: spectra are interpolated"
        found.append(Loss("wavelengths_nm", wavelengths, RED_GREEN_BLUE, why))
    elif not chosen.title.startswith("Bruneton") and wavelengths != RED_GREEN_BLUE:
        found.append(Loss("wavelengths_nm", wavelengths, RED_GREEN_BLUE, "not said; what is read back is taken to be at these"))
    for name, key in FILE_KEYS.items():
        before, after = getattr(given, name), getattr(held, name)
        if name == "mie_phase":
            if before != after:
                shown = "a table" if isinstance(before, PhaseTable) else before
                found.append(Loss(key, shown, str(after), "the mean cosine is kept"))
        elif name == "wavelengths" or np.array_equal(before, after):
            continue
        elif name == "solar_irradiance" and not chosen.holds_sun:
            found.append(Loss(key, _numbers(before), _numbers(after), "that of the renderer's own sun"))
        else:
            found.append(Loss(key, _numbers(before), _numbers(after), _why(chosen, name, given, held)))
    return found


def _why(target: Target, name: str, given: Atmosphere, held: Atmosphere) -> str:
    if name == "mie_g" and given.mie_phase != held.mie_phase and not target.title.startswith("Blender"):
        return "of the other phase function"
    if name == "ground_albedo" and target.dumps is unreal.dumps:
        return "8 bits in sRGB"
    return target.fixed


def _numbers(value: object) -> tuple[float, ...]:
    return tuple(float(str(item)) for item in np.atleast_1d(np.asarray(value)))


def sky_losses(atmosphere: Atmosphere, target: str) -> list[SkyLoss]:
    """How the sky of what ``target`` holds differs from that of ``atmosphere``, at the target's bands.

    Both by :class:`~diffatmo.models.Moments`, under the same sun, 100 m above the ground, at 100 directions from the zenith
    to the horizon that weigh as solid angle; what the target's own model of the sky adds is not in it.
    """
    given, held = _given_and_held(atmosphere, target)
    held = dataclasses.replace(held, solar_irradiance=jnp.ones_like(given.solar_irradiance))
    given = dataclasses.replace(given, solar_irradiance=jnp.ones_like(given.solar_irradiance))
    if not losses(given, target):
        return [SkyLoss(zenith, 0.0, 0.0) for zenith in SUN_ZENITHS_DEG]
    mu, weights = gauss_legendre(ROWS, 0.0, 1.0)
    azimuths = np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    views = _directions(mu[:, None], azimuths)
    suns = _directions(np.cos(np.radians(SUN_ZENITHS_DEG)), np.zeros(len(SUN_ZENITHS_DEG)))
    before, after = (np.asarray(outermost(_skies)(air, jnp.asarray(views), jnp.asarray(suns))) for air in (given, held))
    difference = after / before - 1
    squares = np.mean(difference**2, axis=(2, 3)) @ weights / weights.sum()
    found = []
    for zenith, square, values in zip(SUN_ZENITHS_DEG, squares, difference, strict=True):
        found.append(SkyLoss(zenith, float(np.sqrt(square)), float(values.flat[np.argmax(np.abs(values))])))
    return found


def _directions(mu: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Unit vectors, azimuth from the sun's."""
    mu, azimuth = np.broadcast_arrays(mu, azimuth)
    sine = np.sqrt(1 - mu**2)
    return np.stack([sine * np.sin(azimuth), sine * np.cos(azimuth), mu], axis=-1)


def _skies(air: Atmosphere, views: Array, suns: Array) -> Float[Array, "sun row column w"]:
    sky = Moments().sky(air)
    shape = (suns.shape[0], *views.shape)
    sun = jnp.broadcast_to(suns[:, None, None, :], shape)
    view = jnp.broadcast_to(views, shape)
    return sky.radiance(altitude=jnp.asarray(ALTITUDE_KM), view=view, sun=sun).radiance


__all__ = [
    "RED_GREEN_BLUE",
    "SUN_ZENITHS_DEG",
    "TARGETS",
    "Loss",
    "PresetError",
    "SkyLoss",
    "Target",
    "losses",
    "read",
    "sky_losses",
    "write",
]
