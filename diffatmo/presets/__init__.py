"""An atmosphere in the terms of other renderers: what they are given, what they cannot hold, and the way back.

What a renderer holds of an atmosphere is by definition what :func:`read` makes of what :func:`write` has written; all that
:func:`losses` and :func:`sky_losses` say follows from that.
"""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo.atmosphere import FILE_KEYS, Atmosphere
from diffatmo.compiling import outermost
from diffatmo.models import Model, Moments, RayMarch
from diffatmo.numerics import gauss_legendre
from diffatmo.phase import PhaseTable
from diffatmo.presets import blender, bruneton, three_geospatial, unreal
from diffatmo.presets.fields import RED_GREEN_BLUE, PresetError, Wavelengths, arranged

SUN_ZENITHS_DEG = (30.0, 60.0, 85.0)
ALTITUDE_KM = 0.1
ROWS, COLUMNS = 10, 10
"""Of the directions in which skies are compared: cosines of the zenith angle, azimuths on one side of the sun."""


class Target(NamedTuple):
    """A renderer's format."""

    dumps: Callable[[Atmosphere, str], str]
    loads: Callable[[str, Wavelengths], dict[str, Any]]
    """The fields of an :class:`Atmosphere`."""
    title: str
    use: str
    """What to do with the file."""
    marks: str
    """What a text of this format contains, as a regular expression."""
    comment: str
    why: Mapping[str, str]
    """Why a field is not held, where there is more to say than that it is fixed."""
    beyond: str
    """What its own model of the sky adds to the differences stated."""
    channels: bool = False
    """It has three channels."""
    says_wavelengths: bool = False
    says_sun: bool = False
    scatters_once: bool = False
    """Its sky is single scattering."""


_G = "that of the other phase function, for the same mean cosine"
_DENSITIES = {
    "rayleigh_scattering": "one density of air",
    "mie_scattering": "one density of aerosol",
    "mie_absorption": "one density of aerosol",
    "ozone_absorption": "one density of ozone",
}
_RUN = "run it in the Python console or the text editor"

TARGETS: Mapping[str, Target] = {
    "unreal": Target(
        unreal.dumps,
        unreal.loads,
        "Unreal's SkyAtmosphere",
        "copy the text, and paste it into a level in place of its SkyAtmosphere",
        r"SkyAtmosphereComponent",
        "//",
        {
            "ground_albedo": "8 bits in sRGB",
            "mie_g": f"from 0 to {unreal.LARGEST_G}; {_G}",
            "rayleigh_scale_height": f"at least {unreal.LEAST_SCALE_HEIGHT} km",
            "mie_scale_height": f"at least {unreal.LEAST_SCALE_HEIGHT} km",
            "solar_irradiance": "that of the directional light, whose colour it is",
        },
        "light scattered more than once after Hillaire 2020",
        channels=True,
    ),
    "blender": Target(
        blender.dumps,
        blender.loads,
        "Blender's sky texture, Multiple Scattering (5.0 and later)",
        _RUN,
        r"import bpy[\s\S]*MULTIPLE_SCATTERING",
        "#",
        _DENSITIES,
        "four wavelengths, and light scattered more than once as fitted to the Earth's clear air",
    ),
    "blender-nishita": Target(
        blender.dumps_nishita,
        blender.loads_nishita,
        "Blender's sky texture, Nishita (2.90 to 4.5) or Single Scattering (5.0)",
        _RUN,
        r"import bpy[\s\S]*(NISHITA|SINGLE_SCATTERING)",
        "#",
        _DENSITIES,
        "its coarse integrals; that light is scattered once only is in them",
        scatters_once=True,
    ),
    "three-geospatial": Target(
        three_geospatial.dumps,
        three_geospatial.loads,
        "AtmosphereParameters of @takram/three-atmosphere",
        "import { atmosphere } from it, and pass it on to PrecomputedTexturesGenerator and the materials",
        r"AtmosphereParameters",
        "//",
        {"mie_g": _G},
        "Bruneton's tables",
        channels=True,
        says_sun=True,
    ),
    "bruneton": Target(
        bruneton.dumps,
        bruneton.loads,
        "Bruneton's precomputed_atmospheric_scattering",
        "#include it, and pass its constants to the constructor of atmosphere::Model",
        r"kRayleighScattering",
        "//",
        {"mie_g": _G},
        "its tables, and that its demo evaluates spectra at 680, 550 and 440 nm",
        says_wavelengths=True,
        says_sun=True,
    ),
}


class Loss(NamedTuple):
    """One parameter that a target does not hold as it is."""

    key: str
    """As in the atmosphere file, with its unit."""
    given: tuple[float, ...] | str
    held: tuple[float, ...] | str
    why: str

    @property
    def before(self) -> str:
        """What is given, as text."""
        return _shown(self.given)

    @property
    def after(self) -> str:
        """What is held, as text."""
        return _shown(self.held)

    def __str__(self) -> str:
        return f"{self.key}: {self.before} -> {self.after} ({self.why})"


class SkyLoss(NamedTuple):
    """What the losses do to the sky: relative differences of radiance, zenith to horizon, under one sun."""

    sun_zenith_deg: float
    rms: float
    largest: float
    """By absolute value, with its sign."""

    def __str__(self) -> str:
        sun = f"sky, sun {self.sun_zenith_deg:g} degrees from the zenith"
        # Two digits, but 100 and not 1e+02.
        rms, largest = (float(f"{100 * value:.2g}") for value in (self.rms, self.largest))
        return f"{sun}: {rms:g} % RMS, {largest:+g} % at most"


def _shown(value: tuple[float, ...] | str) -> str:
    return value if isinstance(value, str) else ", ".join(f"{item:.6g}" for item in value)


def summary(target: str, lost: Sequence[Loss], skies: Sequence[SkyLoss]) -> list[str]:
    """What becomes of the sky, in words."""
    if not lost and not any(sky.rms for sky in skies):
        return [f"All parameters are held as they are. Not counted: {_target(target).beyond}."]
    return [*map(str, skies), f"Not counted: {_target(target).beyond}."]


def remarks(target: str, lost: Sequence[Loss], skies: Sequence[SkyLoss]) -> list[str]:
    """All of it, in words, for :func:`write`."""
    return [*map(str, lost), *summary(target, lost, skies)]


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
        return chosen.dumps(arranged(atmosphere, three=chosen.channels), lines)
    except ValueError as error:
        raise PresetError(f"{target}: {error}") from error


def target_of(text: str) -> str | None:
    """The target whose preset ``text`` looks like, or None."""
    return next((name for name, target in TARGETS.items() if re.search(target.marks, text)), None)


def read(
    text: str, target: str | None = None, *, wavelengths: Sequence[float] | None = None, source: str = "preset"
) -> Atmosphere:
    """The atmosphere in a preset of ``target``, by default the one it looks like.

    ``wavelengths``, nm, are those of the channels, red first, where the format does not say them (680, 550, 440); the solar
    irradiance is 1 where it is not said. Raises :class:`PresetError` naming ``source`` and the key.
    """
    likely = target_of(text)
    name = target or likely
    try:
        if name is None:
            raise PresetError(f"not a preset that can be read; known are those of {', '.join(TARGETS)}")
        chosen = _target(name)
        if not re.search(chosen.marks, text):
            raise PresetError(f"not a preset of {name}" + (f"; it looks like one of {likely}" if likely else ""))
        if wavelengths is not None and chosen.says_wavelengths:
            raise PresetError(f"wavelengths: given, but a preset of {name} says its own")
        channels = RED_GREEN_BLUE if wavelengths is None else tuple(wavelengths)
        if chosen.channels and len(channels) != 3:
            raise PresetError(f"wavelengths: got {len(channels)}, expected three, for red, green and blue")
        return Atmosphere(**chosen.loads(text, np.asarray(channels)))
    except ValueError as error:
        raise PresetError(f"{source}: {error}") from error


def _given_and_held(atmosphere: Atmosphere, target: str) -> tuple[Atmosphere, Atmosphere]:
    """The atmosphere from red to blue, at the bands of the target; and what is left of it there."""
    chosen = _target(target)
    given = arranged(atmosphere, three=chosen.channels)
    wavelengths = None if chosen.says_wavelengths else np.asarray(given.wavelengths).tolist()
    return given, read(write(given, target), target, wavelengths=wavelengths)


def losses(atmosphere: Atmosphere, target: str) -> list[Loss]:
    """Every parameter of ``atmosphere`` that ``target`` does not hold to the last digit, at the target's bands."""
    chosen = _target(target)
    given, held = _given_and_held(atmosphere, target)
    found = []
    wavelengths = tuple(sorted(_numbers(atmosphere.wavelengths), reverse=True))
    if not chosen.says_wavelengths and wavelengths != RED_GREEN_BLUE:
        interpolated = chosen.channels and len(wavelengths) != 3
        why = "three channels, interpolated" if interpolated else "not said; read back as these unless told otherwise"
        found.append(Loss(FILE_KEYS["wavelengths"], wavelengths, RED_GREEN_BLUE, why))
    for name, key in FILE_KEYS.items():
        before, after = getattr(given, name), getattr(held, name)
        if name == "mie_phase":
            if before != after:
                found.append(Loss(key, "a table" if isinstance(before, PhaseTable) else before, str(after), "fixed"))
        elif not np.array_equal(before, after):
            found.append(Loss(key, _numbers(before), _numbers(after), chosen.why.get(name, "fixed")))
    return found


def _numbers(value: object) -> tuple[float, ...]:
    return tuple(float(str(item)) for item in np.atleast_1d(np.asarray(value)))


def sky_losses(atmosphere: Atmosphere, target: str, *, model: Model | None = None) -> list[SkyLoss]:
    """How the sky of what ``target`` holds differs from that of ``atmosphere``, at the target's bands.

    Both by ``model``, :class:`~diffatmo.models.Moments` by default (what Blender's old model holds by single scattering, as it
    does it), under the same sun, 100 m above the ground, at 100 directions from the zenith to the horizon that weigh as solid
    angle. What else the target's own model of the sky adds is not in it.
    """
    model = Moments() if model is None else model
    its_model = RayMarch() if _target(target).scatters_once else model
    given, held = (_under_white_sun(air) for air in _given_and_held(atmosphere, target))
    if its_model is model and not losses(given, target):
        return [SkyLoss(zenith, 0.0, 0.0) for zenith in SUN_ZENITHS_DEG]
    mu, weights = gauss_legendre(ROWS, 0.0, 1.0)
    views = _directions(mu[:, None], np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS)
    suns = _directions(np.cos(np.radians(SUN_ZENITHS_DEG)), np.zeros(len(SUN_ZENITHS_DEG)))
    before, after = (
        np.asarray(outermost(_skies)(its, air, jnp.asarray(views), jnp.asarray(suns)))
        for its, air in ((model, given), (its_model, held))
    )
    # A band in which nothing scatters is black before and after.
    difference = np.divide(after, before, out=np.ones_like(before), where=before > 0) - 1
    squares = np.mean(difference**2, axis=(2, 3)) @ weights / weights.sum()
    largest = [float(values.flat[np.argmax(np.abs(values))]) for values in difference]
    return [SkyLoss(*row) for row in zip(SUN_ZENITHS_DEG, np.sqrt(squares).tolist(), largest, strict=True)]


def _under_white_sun(air: Atmosphere) -> Atmosphere:
    return dataclasses.replace(air, solar_irradiance=jnp.ones_like(air.wavelengths))


def _directions(mu: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Unit vectors, azimuth from the sun's."""
    mu, azimuth = np.broadcast_arrays(mu, azimuth)
    sine = np.sqrt(1 - mu**2)
    return np.stack([sine * np.sin(azimuth), sine * np.cos(azimuth), mu], axis=-1)


def _skies(model: Model, air: Atmosphere, views: Array, suns: Array) -> Float[Array, "sun row column w"]:
    sky = model.sky(air)
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
    "remarks",
    "sky_losses",
    "summary",
    "target_of",
    "write",
]
