"""Several observations in arrays of one shape, so that one program sees them all."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

from diffatmo.camera import Camera
from diffatmo.numerics import array
from fitting._errors import FitError
from fitting.nuisances import (
    AEROSOL,
    FOCAL,
    OFFSETS,
    POSE,
    SHADING,
    SUN,
    Nuisances,
    displace,
    gather,
    rotate,
    shading,
    sun_axes,
)
from fitting.observation import FIXED, Observation

PIXEL_FIELDS = ("directions", "measured", "used", "shading")
"""What a :class:`Batch` has for every pixel."""

NOISE_FIELDS = ("noise", "noise_shot", "noise_floor")
"""What a :class:`Batch` has for every pixel, unless it is the same in all of an image."""

TILE = 8192
"""Pixels of a tile at most: their derivatives with respect to ten parameters take some hundred megabytes."""


class Views(NamedTuple):
    """Where the images are taken from, under which sun, where their pixels look, and through how much more aerosol."""

    altitude: Float[Array, " image"]
    sun: Float[Array, "image 3"]
    directions: Float[Array, "image pixel part 3"]
    aerosol: Float[Array, " image"] | None
    """Logarithm of the factor; None if it is 1 for all."""
    response: Float[Array, "image channel w"] | None
    """What the channels see of the wavelengths; None if they are the wavelengths."""


class Batch(eqx.Module):
    """Several observations in arrays of one shape; ``pixel`` runs over those shown, padded with unused ones."""

    altitude: Float[Array, " image"]
    sun: Float[Array, "image 3"]
    directions: Float[Array, "image pixel part 3"]
    """One direction for each pixel, or four that have the mean and the variance of those it is the mean of."""
    measured: Float[Array, "image pixel w"]
    used: Bool[Array, "image pixel"]
    noise: Float[Array, "image #pixel w"]
    noise_shot: Float[Array, "image #pixel w"]
    noise_floor: Float[Array, "image #pixel w"]
    shading: Float[Array, "image pixel w s"]
    """Columns of the free coefficients of shading, in their order among the offsets."""
    exposure_value: Float[Array, " image"]
    nuisances: Nuisances
    sun_axes: Float[Array, "image 2 3"]
    cameras: tuple[Camera | None, ...]
    """Those whose focal length is free; empty if none is."""
    response: Float[Array, "image channel w"] | None = None
    tiles: int = eqx.field(static=True, default=1)
    """Into how many tiles the pixels of an image go, on each device."""
    mesh: Mesh | None = eqx.field(static=True, default=None)
    """The devices that share out the pixels, if there are several."""

    @property
    def pixel_fields(self) -> list[str]:
        """Names of what there is for every pixel."""
        return [*PIXEL_FIELDS, *(name for name in NOISE_FIELDS if getattr(self, name).shape[1] > 1)]

    def exposure(self, linear: Float[Array, " k"]) -> Float[Array, "image 1 w"]:
        """What radiance is multiplied by."""
        return self.exposure_value[:, None, None] * self.nuisances.factor(linear)

    def modulation(self, moved: Float[Array, "image moving"]) -> Float[Array, "image pixel w"]:
        """What vignetting and tone make of the light."""
        own = np.flatnonzero([SHADING.start <= component < SHADING.stop for component in self.nuisances.moving])
        return jnp.exp(jnp.einsum("ipws,is->ipw", self.shading, moved[:, own], precision="highest"))

    def views(self, moved: Float[Array, "image moving"]) -> Views:
        """The views of the images with their free offsets ``moved``."""
        moving = self.nuisances.moving
        if not moving:
            return Views(self.altitude, self.sun, self.directions, None, self.response)
        by = jnp.zeros((len(self.sun), len(OFFSETS)), moved.dtype).at[:, np.array(moving)].set(moved)
        directions = self.directions
        if FOCAL in moving:
            zoomed = [
                seen
                if camera is None
                else camera.zoomed(jnp.exp(log)).directions_at(*jnp.moveaxis(camera.pixels(seen), -1, 0))
                for camera, seen, log in zip(self.cameras, directions, by[:, FOCAL], strict=True)
            ]
            directions = jnp.stack(zoomed)
        return Views(
            self.altitude,
            displace(self.sun, self.sun_axes, by[:, SUN]),
            rotate(directions, by[:, None, None, POSE]),
            by[:, AEROSOL] if AEROSOL in moving else None,
            self.response,
        )


def stack(observations: Sequence[Observation], wavelengths: Sequence[float], mesh: Mesh | None = None) -> Batch:
    """The observations as one batch, for the devices of ``mesh``; raises :class:`FitError` if they do not go together."""
    if not observations:
        raise FitError("no observation was given")
    seen = Counter(observation.name for observation in observations)
    for name, count in seen.items():
        if count > 1:
            raise FitError(
                f"{name}: the name of {count} observations, expected different ones, see fitting.observe(name=…)"
            )
    for observation in observations:
        _check_channels(observation, observations[0], wavelengths)
    most, devices = max(int(observation.shown.sum()) for observation in observations), 1 if mesh is None else mesh.size
    tiles = math.ceil(most / (devices * TILE))
    each = math.ceil(most / (devices * tiles))
    # Among several devices, some would have nothing but what is added.
    size = devices * tiles * (rounded(each) if devices == 1 else each)

    def padded(field: str | Sequence[np.ndarray], fill: Any) -> np.ndarray:
        values = [getattr(o, field) for o in observations] if isinstance(field, str) else field
        rows = np.full((len(observations), size, *values[0].shape[2:]), fill, values[0].dtype)
        for row, value, observation in zip(rows, values, observations, strict=True):
            row[: observation.shown.sum()] = value[observation.shown]
        return rows

    def noise(field: str, fill: float) -> Array:
        values = [getattr(observation, field) for observation in observations]
        if all(np.all(value == value[:1, :1]) for value in values):
            return number(np.stack([value[0, :1] for value in values]))
        return number(padded(field, np.float32(fill)))

    def number(value: Any) -> Array:
        value = np.asarray(value)
        return array(value, bool if value.dtype == bool else None)

    # On NumPy's arrays: of JAX's, every operation would compile a program for every shape.
    directions = padded("directions", np.array([0, 0, 1], dtype=np.float32))[..., None, :]
    if any(observation.block > 1 for observation in observations):
        first, second = np.moveaxis(padded("spread", np.float32(0)), -2, 0)[..., None, :]
        signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], first.dtype)[..., None]
        directions = directions + signs[:, 0] * first + signs[:, 1] * second
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    seeing = [observation.bands.response for observation in observations if observation.bands is not None]
    nuisances = gather(observations, wavelengths)[1]
    components = [OFFSETS[n] for n in nuisances.moving if SHADING.start <= n < SHADING.stop]
    shaded = [
        np.stack([shading(o, *component) for component in components], axis=-1)
        if components
        else np.zeros((*o.image.shape, 0), np.float32)
        for o in observations
    ]
    cameras = tuple(None if observation.focal == FIXED else observation.camera for observation in observations)
    return Batch(
        altitude=number([observation.altitude for observation in observations]),
        sun=number(np.stack([observation.sun for observation in observations])),
        directions=number(directions),
        # Pixels that are not finite are shown and counted but never used (fitting.observation); 0 * NaN would be NaN.
        measured=number(np.nan_to_num(padded("image", np.float32(0)), copy=False, posinf=0.0, neginf=0.0)),
        used=number(padded("used", False)),
        noise=noise("noise", 0.0),
        noise_shot=noise("noise_shot", 0.0),
        noise_floor=noise("noise_floor", 1.0),
        shading=number(padded(shaded, np.float32(0))),
        exposure_value=number([observation.exposure_value for observation in observations]),
        nuisances=nuisances,
        sun_axes=number(np.stack([sun_axes(observation.sun) for observation in observations])),
        cameras=cameras if any(cameras) else (),
        response=number(np.stack(seeing)) if seeing else None,
        tiles=tiles,
        mesh=mesh,
    )


def rounded(count: int) -> int:
    """The next of 2, 8, 32, 128, 512, 2048, beyond that of four sizes to an octave.

    A program is for one size of its arrays. The next photo has other clouds and another number of pixels; that its fit needs no
    other program spares far more than pixels cost that are not used: the sky is solved whatever their number.
    """
    if count <= 2048:
        return next(size for size in (2, 8, 32, 128, 512, 2048) if size >= count)
    step = 1 << (count - 1).bit_length() - 3
    return -(-count // step) * step


def _check_channels(observation: Observation, first: Observation, wavelengths: Sequence[float]) -> None:
    """Refuse an image whose channels are neither the wavelengths nor bands of them, or are unlike those of the ``first``."""
    given, bands = ", ".join(f"{nm:g}" for nm in wavelengths), observation.bands
    channels = observation.image.shape[-1]
    if (bands is None) != (first.bands is None):
        raise FitError(f"{observation.name}: bands: expected all images to have them, or none")
    if channels != first.image.shape[-1]:
        raise FitError(f"{observation.name}: the image has {channels} channels, {first.name} {first.image.shape[-1]}")
    if bands is None and channels != len(wavelengths):
        raise FitError(
            f"{observation.name}: the image has {channels} channels, expected {len(wavelengths)}, one for each "
            f"wavelength of the atmosphere ({given} nm)"
        )
    if bands is not None and not (len(bands.nodes) == len(wavelengths) and np.allclose(bands.nodes, wavelengths)):
        nodes = ", ".join(f"{nm:g}" for nm in bands.nodes)
        raise FitError(f"{observation.name}: bands: they are of {nodes} nm, the atmosphere has {given} nm")
