"""What an image depends on besides the air, and is not known well enough: numbers that are fitted along with it.

==================  =====================================================  ==========================================  ======
kind                numbers                                                enters                                      known
==================  =====================================================  ==========================================  ======
``exposure``        a factor, or one for each channel                      light = value × factor × radiance           no
``white_balance``   a factor for each channel but the middle one           the same                                    no
``pedestal``        a number, or one for each channel, in image units      pixel = light + pedestal                    no
``sun_offset``      two angles in the tangent plane of the sun             the sun                                     0 ± 0.5°
``pose``            three components of a rotation vector                  the directions of the pixels                0 ± 2°
``focal``           the logarithm of a factor                              the directions, by the camera's projection  0 ± 5 %
``vignetting``      two coefficients v, of ρ² and ρ⁴                       light × exp(Σ v ρ^k)                        0 ± 0.5
``tone``            three coefficients of what a pixel itself says         light × exp(Σ t φ(pixel))                   0 ± 0.15
``chroma``          one coefficient s: colours are purer, or paler         light × exp(s (1 - Y/pixel))                0 ± 0.2
``aerosol``         the logarithm of a factor                              the aerosol of this image                   0 ± 30 %
==================  =====================================================  ==========================================  ======

Each is fixed, free for an image of its own, or shared by a named group of images.

The first three are *linear*: given the radiance, their optimum follows (:mod:`fitting.elimination`). The others are *offsets*:
they move the view of a sky that is solved once, but for the aerosol, with which every image has a sky of its own. An offset
touches one image, or those of its group, and images do not mix; so the components of :data:`OFFSETS` need as many tangents
at most, whatever the number of images. Those of *shading*, vignetting, tone and chroma, cost none: the logarithm of the light
is linear in them, with the columns of :func:`shading`.

*Time series.* The logarithms a of the aerosols of images at the times t are a stationary Ornstein-Uhlenbeck process, the
continuous autoregression of first order: ⟨a a'⟩ = σ² exp(-|t - t'| / T). It is Markovian, so what is known beforehand are
independent innovations (Gillespie 1996, Phys. Rev. E 54, 2084, eqs. 3.1, 3.5),

    a_1 / σ  and  (a_i - ρ a_{i-1}) / (σ √(1 - ρ²)),  ρ = exp(-(t_i - t_{i-1}) / T),  each 0 ± 1.

Rotation vector and tangent plane are smooth where angles are not: at no rotation, and with the sun at the zenith.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffatmo._types import Direction
from diffatmo.color import LUMINANCE
from diffatmo.numerics import array, safe_norm
from fitting._errors import FitError
from fitting.observation import FIXED, FREE, PER_CHANNEL, Observation

OFFSETS = (
    ("sun_offset", "zenith_deg"),
    ("sun_offset", "azimuth_deg"),
    ("pose", "east_deg"),
    ("pose", "north_deg"),
    ("pose", "up_deg"),
    ("focal", ""),
    ("vignetting", "2"),
    ("vignetting", "4"),
    ("tone", "1"),
    ("tone", "2"),
    ("tone", "3"),
    ("chroma", "saturation"),
    ("aerosol", ""),
)
"""Kind and component of all offsets of an image."""

EACH = "each"
"""Source of what is known of a kind of offset, whatever the image."""

SUN, POSE, FOCAL, SHADING, AEROSOL = slice(0, 2), slice(2, 5), 5, slice(6, 12), 12
"""Their places among the offsets of an image."""

KINDS = (
    "exposure",
    "white_balance",
    "pedestal",
    "sun_offset",
    "pose",
    "focal",
    "vignetting",
    "tone",
    "chroma",
    "aerosol",
)


DARKEST = 1e-3
"""Pixel over white below which a tone curve is not known to bend any further."""


class Label(NamedTuple):
    """What a nuisance is called, and the unit it is reported in."""

    name: str
    unit: str = ""


class Nuisances(eqx.Module):
    """The nuisances of a batch of images: first ``offsets`` coordinates, then ``linear`` ones.

    An offset is in units of what is known of it beforehand, ``unit``; factors are logarithms. -1 stands for what is fixed.
    """

    moving: tuple[int, ...] = eqx.field(static=True)
    """Which of :data:`OFFSETS` are free in any image."""
    offset_index: Int[Array, "image moving"]
    unit: Float[Array, " m"]
    """rad, or of a logarithm."""
    innovation: Float[Array, "m m"]
    """From the offsets, in their units, to what is known beforehand to be independent and 0 ± 1."""
    per_unit: Float[Array, " m"]
    """What an offset is multiplied by to be reported; 0 for one that is the logarithm of what is reported."""
    factor_index: Int[Array, "image w 2"]
    """Numbers of the factors of exposure and of white balance."""
    pedestal_index: Int[Array, "image w"]
    factors: int = eqx.field(static=True)
    pedestals: int = eqx.field(static=True)

    @property
    def offsets(self) -> int:
        """Number of offsets."""
        return self.unit.size

    @property
    def linear(self) -> int:
        """Number of factors and pedestals."""
        return self.factors + self.pedestals

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.offsets + self.linear

    def factor(self, linear: Float[Array, " k"]) -> Float[Array, "image 1 w"]:
        """The product of the free factors of each image and channel."""
        logs = jnp.append(linear[: self.factors], 0)
        return jnp.exp(jnp.sum(logs[self.factor_index], axis=-1))[:, None]

    def pedestal(self, linear: Float[Array, " k"]) -> Float[Array, "image 1 w"]:
        """What is added to the light of each image and channel."""
        return jnp.append(linear[self.factors :], 0)[self.pedestal_index][:, None]

    def moved(self, offsets: Float[Array, " m"]) -> Float[Array, "image moving"]:
        """The free components of each image, rad or the logarithm of a factor."""
        return jnp.append(offsets * self.unit, 0)[self.offset_index]

    def values(self, coordinates: Float[Array, " m+k"]) -> Float[Array, " m+k"]:
        """The numbers that are reported: degrees, factors, and units of the image."""
        offsets, linear = coordinates[: self.offsets] * self.unit, coordinates[self.offsets :]
        logarithm = self.per_unit == 0
        reported = jnp.where(logarithm, jnp.exp(jnp.where(logarithm, offsets, 0)), offsets * self.per_unit)
        return jnp.concatenate([reported, jnp.exp(linear[: self.factors]), linear[self.factors :]])


def group_of(observation: Observation, kind: str) -> str | None:
    """The image or the group that a nuisance of this kind belongs to; None if it is fixed."""
    choice: str = getattr(observation, kind)
    if choice == FIXED:
        return None
    group = choice.removesuffix(PER_CHANNEL)
    return observation.name if group == FREE else group


def channels(observation: Observation, wavelengths: Sequence[float]) -> list[str]:
    """What the channels of an image are called: their bands, or their wavelengths in nm."""
    return [f"{nm:g}" for nm in wavelengths] if observation.bands is None else list(observation.bands.names)


def channel_names(observation: Observation, kind: str, wavelengths: Sequence[float]) -> list[str | None]:
    """For each channel the name of its exposure, white balance or pedestal; None where that is fixed."""
    group, bands = group_of(observation, kind), observation.bands
    centres = np.asarray(wavelengths if bands is None else bands.centres)
    if group is None:
        return [None] * centres.size
    names: list[str | None] = [f"{kind}_{group}_{name}" for name in channels(observation, wavelengths)]
    if kind == "white_balance":
        names[int(np.argsort(centres)[(centres.size - 1) // 2])] = None
    elif not getattr(observation, kind).endswith(PER_CHANNEL):
        names = [f"{kind}_{group}"] * centres.size
    return names


def gather(observations: Sequence[Observation], wavelengths: Sequence[float]) -> tuple[list[Label], Nuisances]:
    """The nuisances of these images, and what they are called; raises :class:`FitError` for groups that cannot be."""
    for kind in KINDS:
        _check_groups(observations, kind)
    offsets, units, times = _Numbers(), list[float](), dict[int, list[float]]()
    of_offsets = np.full((len(observations), len(OFFSETS)), -1)
    for image, observation in enumerate(observations):
        for column, (kind, component) in enumerate(OFFSETS):
            if (group := group_of(observation, kind)) is None:
                continue
            of_offsets[image, column] = offsets.number(f"{kind}_{group}" + f"_{component}" * bool(component))
            error = error_of(observation, kind, component)
            units[len(units) :] = [error] * (len(offsets) - len(units))
            if units[of_offsets[image, column]] != error:
                key = "heading_error" if _is_heading(observation, kind, component) else f"{kind}_error"
                raise FitError(f"{observation.name}: {key}: got {error:g}, another image of {group!r} has another")
            if kind == "aerosol" and observation.time_h is not None:
                times.setdefault(int(of_offsets[image, column]), []).append(observation.time_h)
    factors, pedestals = _Numbers(), _Numbers()
    of_factors = np.stack(
        [
            [[factors.number(name) for name in channel_names(o, kind, wavelengths)] for o in observations]
            for kind in ("exposure", "white_balance")
        ],
        axis=-1,
    )
    of_pedestals = np.array(
        [[pedestals.number(name) for name in channel_names(o, "pedestal", wavelengths)] for o in observations]
    )
    moving = np.flatnonzero((of_offsets >= 0).any(axis=0))
    scales = [
        1.0 if name.startswith(("vignetting_", "tone_", "chroma_")) else 180 / math.pi * name.endswith("_deg")
        for name in offsets
    ]
    scales = [
        0.0 if name.startswith(("focal_", "aerosol_")) else scale for name, scale in zip(offsets, scales, strict=True)
    ]
    labels = [Label(name, "deg" if scale > 1 else "") for name, scale in zip(offsets, scales, strict=True)]
    return [*labels, *map(Label, [*factors, *pedestals])], Nuisances(
        moving=tuple(int(component) for component in moving),
        offset_index=array(of_offsets[:, moving], int),
        unit=array(units),
        innovation=array(_innovation(len(offsets), times, _memory(observations))),
        per_unit=array(scales),
        factor_index=array(of_factors, int),
        pedestal_index=array(of_pedestals, int),
        factors=len(factors),
        pedestals=len(pedestals),
    )


def _memory(observations: Sequence[Observation]) -> float:
    """The hours in which the aerosol of a time series changes; raises :class:`FitError` if its images say different ones."""
    series = [o for o in observations if group_of(o, "aerosol") is not None and o.time_h is not None]
    for observation in series:
        memory, other = observation.aerosol_memory_h, series[0].aerosol_memory_h
        if memory != other:
            raise FitError(
                f"{observation.name}: aerosol_memory_h: got {memory:g}, another image of the series has {other:g}"
            )
    return series[0].aerosol_memory_h if series else math.inf


def _innovation(size: int, times: dict[int, list[float]], memory: float) -> Float[np.ndarray, "m m"]:
    """What makes the aerosols of images taken at ``times`` (h), among ``size`` offsets, independent."""
    matrix = np.eye(size)
    # Images that share a factor say together when it was.
    moments = {number: sum(group) / len(group) for number, group in times.items()}
    for before, after in pairwise(sorted(moments, key=moments.__getitem__)):
        # Images of the same moment may still differ by what single precision can tell apart.
        correlation = math.exp(-max(moments[after] - moments[before], 1e-4 * memory) / memory)
        scale = math.sqrt(1 - correlation**2)
        matrix[after, after], matrix[after, before] = 1 / scale, -correlation / scale
    return matrix


class _Numbers(dict[str, int]):
    """Names in the order in which they are first asked for, each with its number."""

    def number(self, name: str | None) -> int:
        """That of ``name``; -1 for none."""
        return -1 if name is None else self.setdefault(name, len(self))


def _check_groups(observations: Sequence[Observation], kind: str) -> None:
    """Refuse an image with a nuisance of its own whose name is that of a group, which would then share it."""
    choices = [getattr(observation, kind).removesuffix(PER_CHANNEL) for observation in observations]
    own = {observation.name for observation, choice in zip(observations, choices, strict=True) if choice == FREE}
    if both := own & set(choices):
        raise FitError(f"{both.pop()}: an image with a free {kind} has the name of a group; rename the group")


def error_of(observation: Observation, kind: str, component: str) -> float:
    """What is known of an offset beforehand, rad or of a logarithm."""
    error: float = getattr(
        observation, "heading_error" if _is_heading(observation, kind, component) else f"{kind}_error"
    )
    return error


def _is_heading(observation: Observation, kind: str, component: str) -> bool:
    """Whether an offset is a turn about the vertical of which something else is known than of the others."""
    return (kind, component) == ("pose", "up_deg") and observation.heading_error is not None


def shading(observation: Observation, kind: str, component: str) -> Float[np.ndarray, "height width w"]:
    """What a coefficient of shading is multiplied by in the logarithm of the light; 0 where that image has none.

    Of *vignetting*, powers of the distance ρ from the centre, in units of the half diagonal. Of *tone*, where the curve that
    was undone may not have been the one that was applied: with u = ln(pixel / white), u, u²/3 and 2 pixel / white. Of *chroma*,
    where the difference of a channel to the luminance Y was enlarged: 1 - Y / channel, with the channels of the picture as
    they are.
    """
    if group_of(observation, kind) is None:
        return np.zeros_like(observation.image)
    if kind == "vignetting":
        return np.broadcast_to(observation.radius[..., None] ** int(component), observation.image.shape)
    relative = np.nan_to_num(observation.image / observation.white, posinf=1.0, neginf=0.0)
    if kind == "chroma":
        weights = (
            LUMINANCE if relative.shape[-1] == len(LUMINANCE) else np.full(relative.shape[-1], 1 / relative.shape[-1])
        )
        luminance = np.sum(relative * weights, axis=-1, keepdims=True)
        return np.asarray(
            1 - luminance / np.maximum(relative, DARKEST * np.maximum(luminance, DARKEST)), dtype=np.float32
        )
    logarithm = np.log(np.clip(relative, DARKEST, None))
    return np.asarray({"1": logarithm, "2": logarithm**2 / 3, "3": 2 * relative}[component], dtype=np.float32)


def assumed(observations: Sequence[Observation]) -> list[tuple[str, float, float, bool, str]]:
    """What is known of the offsets beforehand: name, value, error, whether it is one of the logarithm, and whose.

    In the units of :meth:`Nuisances.values`.
    """
    found: dict[tuple[str, float, float, bool, str], None] = {}
    for observation in observations:
        for kind, component in OFFSETS:
            if group_of(observation, kind) is None:
                continue
            error, in_degrees = error_of(observation, kind, component), component.endswith("_deg")
            factor = not component
            name = "pose_up_deg" if _is_heading(observation, kind, component) else kind + "_deg" * in_degrees
            found[name, float(factor), math.degrees(error) if in_degrees else error, factor, EACH] = None
    return list(found)


# The geometry -------------------------------------------------------------------------------------------------------


def rotate(vectors: Direction, by: Float[Array, "... 3"]) -> Direction:
    """``vectors`` turned about the axis ``by`` through the angle |``by``|, by the right-hand rule (Rodrigues 1840)."""
    angle = safe_norm(by)[..., None]
    along = jnp.sum(by * vectors, axis=-1, keepdims=True)
    # sin θ / θ and (1 - cos θ) / θ², smooth through θ = 0.
    sine, versine = jnp.sinc(angle / np.pi), jnp.sinc(angle / (2 * np.pi)) ** 2 / 2
    return vectors * jnp.cos(angle) + jnp.cross(by, vectors) * sine + by * along * versine


def sun_axes(sun: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Unit vectors in the tangent plane of the sun: to larger zenith angles, and clockwise along its horizon circle.

    A sun at the zenith has the azimuth 0.
    """
    east, north, up = sun
    level = math.hypot(east, north)
    sine, cosine = (east / level, north / level) if level > 0 else (0.0, 1.0)
    return np.array([[sine * up, cosine * up, -level], [cosine, -sine, 0.0]])


def displace(
    sun: Float[Array, "... 3"], axes: Float[Array, "... 2 3"], by: Float[Array, "... 2"]
) -> Float[Array, "... 3"]:
    """The sun at the end of the great circle that leaves it along ``axes`` · ``by``, |``by``| rad long."""
    angle = safe_norm(by)[..., None]
    along = axes[..., 0, :] * by[..., :1] + axes[..., 1, :] * by[..., 1:]
    return sun * jnp.cos(angle) + along * jnp.sinc(angle / np.pi)
