"""One photographed sky: an image with its camera, place, sun, noise, mask and nuisances, ready to be fitted.

:func:`observe` checks and prepares a single image; :mod:`fitting.batch` puts several into arrays of one shape.

*Noise.* A pixel of signal S (in the image's own units) has the variance ``(noise S)² + shot S + floor²``. Where S
comes from is the business of :mod:`fitting.solve`; taking the noisy pixel itself would weight low outliers more than
high ones.

*Large images* are averaged in square blocks until at most ``max_pixels`` remain; a block has the mean radiance and
the mean direction of its unmasked pixels, and the noise of that mean. The radiance of the mean direction differs from
the mean radiance by about (block width)² / 24 times the second derivative, which matters close to the sun and the
horizon only.
"""

import difflib
import math
from collections.abc import Callable, Mapping
from numbers import Integral
from typing import Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo.bands import Bands
from diffatmo.camera import Camera, CameraError
from fitting._errors import FitError, is_number

FIXED = "fixed"
FREE = "free"
PER_CHANNEL = "-per-channel"
UNNAMED = "image"

NOISE = 0.01
MAX_PIXELS = 20_000
SUN_EXCLUSION = math.radians(2.0)

BAND = 500_000
"""Pixels that are averaged at once, in about."""

NEGATIVE = 5.0
"""Standard deviations of a dark pixel below zero down to which a pixel is dark, and not broken."""

SUN_OFFSET_ERROR = math.radians(0.5)
POSE_ERROR = math.radians(2.0)
FOCAL_ERROR = 0.05
VIGNETTING_ERROR = 0.5
TONE_ERROR = 0.15
CHROMA_ERROR = 0.2
AEROSOL_ERROR = 0.3
AEROSOL_MEMORY_H = 6.0


class Observation(eqx.Module):
    """An image to be fitted, on its (possibly coarser) pixel grid; made by :func:`observe`."""

    name: str = eqx.field(static=True)
    exposure: str = eqx.field(static=True)
    white_balance: str = eqx.field(static=True)
    pedestal: str = eqx.field(static=True)
    sun_offset: str = eqx.field(static=True)
    pose: str = eqx.field(static=True)
    focal: str = eqx.field(static=True)
    vignetting: str = eqx.field(static=True)
    tone: str = eqx.field(static=True)
    chroma: str = eqx.field(static=True)
    aerosol: str = eqx.field(static=True)
    sun_offset_error: float
    pose_error: float
    heading_error: float | None
    focal_error: float
    vignetting_error: float
    tone_error: float
    chroma_error: float
    aerosol_error: float
    aerosol_memory_h: float
    time_h: float | None
    exposure_value: float
    altitude: float
    sun: Float[np.ndarray, "3"]
    image: Float[np.ndarray, "height width w"]
    directions: Float[np.ndarray, "height width 3"]
    radius: Float[np.ndarray, "height width"]
    """Distance from the centre of the picture, in units of its half diagonal."""
    white: float
    """The largest value a pixel can have, or has."""
    spread: Float[np.ndarray, "height width 2 3"]
    """Standard deviations of the directions that a pixel is the mean of, along their two axes; zero for a single one."""
    shown: Bool[np.ndarray, "height width"]
    used: Bool[np.ndarray, "height width"]
    noise: Float[np.ndarray, "height width w"]
    noise_shot: Float[np.ndarray, "height width w"]
    noise_floor: Float[np.ndarray, "height width w"]
    masked: dict[str, int] = eqx.field(static=True)
    block: int = eqx.field(static=True)
    camera: Camera
    bands: Bands | None
    """What its channels see of the spectrum; None if each is one of the atmosphere's wavelengths."""
    merged: int = eqx.field(static=True, default=1)
    """Pictures that it was made from."""


def observe(
    pixels: Float[np.ndarray, "height width w"],
    *,
    camera: Camera,
    altitude: float,
    sun: Float[np.ndarray, "3"],
    noise: float | np.ndarray = NOISE,
    noise_shot: float | np.ndarray = 0.0,
    noise_floor: float | np.ndarray | None = None,
    mask: Bool[np.ndarray, "height width"] | Mapping[str, Bool[np.ndarray, "height width"]] | None = None,
    saturation: float | None = None,
    sun_exclusion: float = SUN_EXCLUSION,
    view_zenith_max: float = math.pi / 2,
    horizon_exclusion: float = 0.0,
    exposure: str = FIXED,
    white_balance: str = FIXED,
    pedestal: str = FIXED,
    sun_offset: str = FIXED,
    pose: str = FIXED,
    focal: str = FIXED,
    vignetting: str = FIXED,
    tone: str = FIXED,
    chroma: str = FIXED,
    aerosol: str = FIXED,
    sun_offset_error: float = SUN_OFFSET_ERROR,
    pose_error: float = POSE_ERROR,
    heading_error: float | None = None,
    focal_error: float = FOCAL_ERROR,
    vignetting_error: float = VIGNETTING_ERROR,
    tone_error: float = TONE_ERROR,
    chroma_error: float = CHROMA_ERROR,
    aerosol_error: float = AEROSOL_ERROR,
    aerosol_memory_h: float = AEROSOL_MEMORY_H,
    time_h: float | None = None,
    exposure_value: float = 1.0,
    max_pixels: int = MAX_PIXELS,
    bands: Bands | None = None,
    merged: int = 1,
    name: str = UNNAMED,
) -> Observation:
    """Prepare one image for fitting; raises :class:`FitError` for anything that cannot be right.

    Args:
        pixels: Linear radiance times exposure.
        camera: Where each pixel looks.
        altitude: Of the camera above the ground, km.
        sun: Unit vector towards the sun.
        noise: Standard deviation relative to the signal; a number, or one per channel, pixel, or both. It must not depend on
            the error of the pixel itself: the path tracer's standard error of each pixel is small where too little light was
            found, and weighs those pixels most. Its RMS over the picture is right. Channels count as independent; those of one
            trace share their paths, so that a picture whose noise is mostly the Monte Carlo's has too small error bars.
        noise_shot: Variance per unit of signal (photon noise), like ``noise``.
        noise_floor: Standard deviation of a dark pixel, like ``noise``; default 1e-4 of the image's median, with a free
            pedestal of what that is above its darkest pixels.
        mask: True where the pixel may be used; or, by reason, where it may not.
        saturation: Pixels with a channel at or above this value are not used.
        sun_exclusion: Radius, in radians, of the disc around the sun that is not used.
        view_zenith_max: Largest view zenith angle used, radians: π/2 for the sky alone, π for the ground too.
        horizon_exclusion: Elevations closer to 0 than this, radians, are not used.
        exposure: ``"fixed"``, ``"free"`` (a factor of this image's own), or the name of a group of images that share
            one factor; with ``-per-channel`` appended (``"free-per-channel"``) there is one for each channel.
        white_balance: ``"fixed"``, ``"free"``, or the name of a group of images that share one: a factor for each channel but
            the middle one by wavelength, besides the exposure.
        pedestal: What is added to the light, in units of the image, as a black level that was not subtracted is: ``"fixed"`` at
            0, ``"free"`` (one number for this image), or the name of a group of images that share one; with ``-per-channel``
            appended there is one for each channel. With a free one, all negative pixels are used; else those that
            ``noise_floor`` explains.
        sun_offset: Whether the sun may be elsewhere than ``sun`` says: ``"fixed"``, ``"free"``, or the name of a group of
            images that share two small angles: the growth of the sun's zenith angle, and the way along its
            horizon circle, clockwise.
        pose: Whether the camera may be turned: ``"fixed"``, ``"free"``, or the name of a group of images that share one
            rotation, a vector in the local frame (east, north, up). Pixels that may cross the horizon, or come from behind
            what hides them, must be left out: the edge has no derivative.
        focal: Whether the focal length may differ from the camera's, by a factor: ``"fixed"``, ``"free"``, or the name of a
            group. Not for equirectangular pictures, which have none.
        vignetting: Whether the lens may darken the picture towards its corners: ``"fixed"``, ``"free"``, or the name of a group
            that shares two coefficients, of the square and of the fourth power of the distance from the centre (1 in the
            corners), in the logarithm of the light.
        tone: Whether pixels may have been through another tone curve than the one that was undone: ``"fixed"``, ``"free"``, or
            the name of a group that shares the three coefficients of a smooth curve. White is ``saturation``, or else the
            brightest pixel.
        chroma: Whether the colours of the picture may have been made purer or paler, as by other primaries: ``"fixed"``,
            ``"free"``, or the name of a group that shares one coefficient. For channels red, green, blue.
        aerosol: Whether there may be more or less aerosol than the atmosphere's, by a factor: ``"fixed"``, ``"free"``, or the
            name of a group. Each such image costs the solution of a sky of its own.
        sun_offset_error: Standard deviation of each of the sun's two angles before the image is looked at, rad.
        pose_error: The same of each component of the rotation, rad.
        heading_error: The same of the turn about the vertical, if that is less well known, as from a compass.
        focal_error: The same of the logarithm of the focal length.
        vignetting_error: The same of each coefficient of the vignetting.
        tone_error: The same of each coefficient of the tone curve.
        chroma_error: The same of the coefficient of the chroma.
        aerosol_error: The same of the logarithm of the factor of the aerosol.
        aerosol_memory_h: Hours in which the aerosol changes: factors of images taken Δt apart are correlated by
            exp(-Δt / ``aerosol_memory_h``).
        time_h: When the image was taken, in hours from any time that all images share; None if the aerosol of an image says
            nothing about that of the next.
        exposure_value: The exposure as far as it is known: pixels = exposure_value × free factor × radiance.
        max_pixels: Average blocks of pixels until no more than this many are used. The model is averaged over four
            directions in each block.
        bands: What the channels see of the spectrum; its nodes must be the wavelengths of the atmosphere, whose sun must have
            the irradiance 1. None if every channel is one of the wavelengths.
        merged: How many exposures the picture was merged from (:mod:`diffatmo.brackets`), for the report.
        name: Of the image, in messages, tables and file names. A fit of several without one numbers them.
    """
    refuse = _Refusal(name)
    refuse.unless(isinstance(name, str), "name", name, "a text")
    image = np.asarray(pixels)
    if image.ndim != 3 or 0 in image.shape or image.dtype.kind not in "iuf":
        refuse(
            f"pixels: got shape {image.shape} of {image.dtype}, expected real numbers in the shape (height, width, channels)"
        )
    image = image.astype(np.float32)
    refuse.unless(isinstance(camera, Camera), "camera", camera, "a camera, like diffatmo.Fisheye(256, 256)")
    refuse.unless(bands is None or isinstance(bands, Bands), "bands", bands, "diffatmo.bands.Bands")
    if bands is not None and len(bands.names) != image.shape[-1]:
        refuse(
            f"bands: {len(bands.names)} of them ({', '.join(bands.names)}), but the image has {image.shape[-1]} channels"
        )
    directions = np.asarray(camera.directions(), dtype=np.float32)
    if directions.shape[:2] != image.shape[:2]:
        size = "{1} x {0}".format(*directions.shape[:2])
        refuse(f"pixels: the image is {image.shape[1]} x {image.shape[0]} (width x height) and the camera {size}")
    toward_sun = refuse.numbers("sun", sun, "a unit vector towards the sun")
    if toward_sun.shape != (3,) or not np.all(np.isfinite(toward_sun)) or abs(np.linalg.norm(toward_sun) - 1) > 1e-3:
        refuse(f"sun: got {toward_sun.tolist()}, expected a unit vector towards the sun")
    refuse.number("altitude", altitude, lambda km: 0 <= km < math.inf, "kilometres >= 0")
    refuse.number("sun_exclusion", sun_exclusion, lambda a: 0 <= a < math.pi, "radians from 0 to less than π")
    refuse.number("view_zenith_max", view_zenith_max, lambda a: 0 < a <= math.pi, "radians, more than 0 and up to π")
    refuse.number(
        "horizon_exclusion", horizon_exclusion, lambda a: 0 <= a < math.pi / 2, "radians from 0 to less than π/2"
    )
    refuse.number("exposure_value", exposure_value, lambda e: 0 < e < math.inf, "a finite number > 0")
    if saturation is not None:
        refuse.number("saturation", saturation, lambda white: white > 0, "a number > 0")
    for key, pieces in (("max_pixels", max_pixels), ("merged", merged)):
        refuse.unless(isinstance(pieces, Integral) and pieces >= 1, key, pieces, "a whole number, at least 1")
    for key, value in (
        ("exposure", exposure),
        ("pedestal", pedestal),
        ("white_balance", white_balance),
        ("sun_offset", sun_offset),
        ("pose", pose),
        ("focal", focal),
        ("vignetting", vignetting),
        ("tone", tone),
        ("chroma", chroma),
        ("aerosol", aerosol),
    ):
        _check_choice(refuse, key, value)
    for key, error in (
        ("sun_offset_error", sun_offset_error),
        ("pose_error", pose_error),
        ("heading_error", pose_error if heading_error is None else heading_error),
        ("focal_error", focal_error),
        ("vignetting_error", vignetting_error),
        ("tone_error", tone_error),
        ("chroma_error", chroma_error),
        ("aerosol_error", aerosol_error),
    ):
        radians = " rad" if key in ("sun_offset_error", "pose_error", "heading_error") else ""
        refuse.number(key, error, lambda error: 0 < error <= 1, f"more than 0 and at most 1{radians}")
    refuse.number("aerosol_memory_h", aerosol_memory_h, lambda h: 0 < h < math.inf, "a finite number of hours > 0")
    if time_h is not None:
        refuse.number("time_h", time_h, math.isfinite, "a finite number of hours")
    if focal != FIXED:
        try:
            camera.zoomed(1.0)
        except CameraError as error:
            refuse(f"focal: {error}")
    if exposure.endswith(PER_CHANNEL) and white_balance != FIXED:
        refuse(f"exposure: {exposure!r} has a factor for each channel already, expected white_balance fixed beside it")

    for given in map(np.asarray, mask.values() if isinstance(mask, Mapping) else () if mask is None else (mask,)):
        if given.shape != image.shape[:2] or given.dtype.kind not in "biu":
            refuse(
                f"mask: got shape {given.shape} of {given.dtype}, expected {image.shape[:2]} of bool, like the image"
            )
    left_out = exclusions(
        image,
        camera=camera,
        sun=toward_sun,
        mask=mask,
        saturation=saturation,
        sun_exclusion=sun_exclusion,
        view_zenith_max=view_zenith_max,
        horizon_exclusion=horizon_exclusion,
        pedestal=pedestal,
        noise_floor=_per_pixel(refuse, "noise_floor", 0.0 if noise_floor is None else noise_floor, image.shape),
    )
    masked = {reason: int(bad.sum()) for reason, bad in left_out.items()}
    none = np.zeros(image.shape[:2], dtype=bool)
    used = ~np.any([none, *left_out.values()], axis=0)
    shown = np.asarray(camera.valid(), dtype=bool) & ~_beyond(directions, view_zenith_max)
    if not used.any():
        why = ", ".join(f"{count} {reason}" for reason, count in masked.items())
        refuse(f"no pixel is left to fit: of {used.size} pixels {why}")

    floor = 1e-4 * np.median(light_of(image[used], pedestal)) if noise_floor is None else noise_floor
    noises = {
        "noise": _per_pixel(refuse, "noise", noise, image.shape),
        "noise_shot": _per_pixel(refuse, "noise_shot", noise_shot, image.shape),
        "noise_floor": _per_pixel(refuse, "noise_floor", floor, image.shape),
    }
    if np.any(np.all([value == 0 for value in noises.values()], axis=0) & used[..., None]):
        refuse("noise: it is zero for some pixels, expected a standard deviation > 0")
    block = math.ceil(math.sqrt(used.sum() / max_pixels))
    fields: dict[str, Any] = {"image": image, "directions": directions, "shown": shown, "used": used, **noises}
    fields["radius"] = _radius(*image.shape[:2])
    white = float(np.max(image[used])) if saturation is None else float(saturation)
    single = np.zeros((*image.shape[:2], 2, 3), dtype=np.float32)
    return Observation(
        name=name,
        exposure=exposure,
        white_balance=white_balance,
        pedestal=pedestal,
        sun_offset=sun_offset,
        pose=pose,
        focal=focal,
        vignetting=vignetting,
        tone=tone,
        chroma=chroma,
        aerosol=aerosol,
        sun_offset_error=float(sun_offset_error),
        pose_error=float(pose_error),
        heading_error=None if heading_error is None else float(heading_error),
        focal_error=float(focal_error),
        vignetting_error=float(vignetting_error),
        tone_error=float(tone_error),
        chroma_error=float(chroma_error),
        aerosol_error=float(aerosol_error),
        aerosol_memory_h=float(aerosol_memory_h),
        time_h=None if time_h is None else float(time_h),
        exposure_value=float(exposure_value),
        altitude=float(altitude),
        sun=toward_sun / np.linalg.norm(toward_sun),
        masked=masked,
        block=block,
        camera=camera,
        bands=bands,
        merged=merged,
        white=max(white, 1e-30),
        **(fields | {"spread": single} if block == 1 else _bin(fields, block, raised=pedestal != FIXED)),
    )


def _radius(height: int, width: int) -> Float[np.ndarray, "height width"]:
    """Distance of every pixel from the centre of the picture, 1 in its corners."""
    y, x = (2 * np.arange(size) + 1 - size for size in (height, width))
    return (np.hypot(y[:, None], x) / math.hypot(height, width)).astype(np.float32)


class _Refusal(NamedTuple):
    """Raises errors that begin with the image's name."""

    name: str

    def __call__(self, message: str) -> None:
        raise FitError(f"{self.name}: {message}")

    def unless(self, good: bool, key: str, value: Any, expected: str) -> None:
        if not good:
            self(f"{key}: got {repr(value) if isinstance(value, str) else value}, expected {expected}")

    def number(self, key: str, value: Any, good: Callable[[float], bool], expected: str) -> None:
        """Refuse what is no number, and what is not ``good``."""
        self.unless(is_number(value) and good(float(value)), key, value, expected)

    def numbers(self, key: str, value: Any, expected: str) -> Float[np.ndarray, "..."]:
        """``value`` as an array."""
        try:
            return np.asarray(value, dtype=np.float32)
        except (TypeError, ValueError):
            raise FitError(f"{self.name}: {key}: got {value!r}, expected {expected}") from None


def _check_choice(refuse: _Refusal, key: str, value: Any) -> None:
    """Refuse what is no choice, and what is nearly ``fixed`` or ``free``: misspelt, it would be the name of a group."""
    expected = '"fixed", "free" or a name' + ", a number that is known is exposure_value" * (key == "exposure")
    refuse.unless(isinstance(value, str) and value != FIXED + PER_CHANNEL, key, value, expected)
    name = value.removesuffix(PER_CHANNEL) if key in ("exposure", "pedestal") else value
    refuse.unless(bool(name) and not name.endswith(PER_CHANNEL), key, value, expected)
    near = difflib.get_close_matches(name.lower(), (FIXED, FREE), n=1, cutoff=0.8)
    if near and name not in near:
        refuse(f"{key}: got {value!r}, did you mean {near[0]!r}? As the name of a group it is too much like it")


def _per_pixel(refuse: _Refusal, key: str, value: float | np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    expected = f"one number, or one per channel or pixel of {shape}"
    array = refuse.numbers(key, value, expected)
    if array.shape == shape[:2]:
        array = array[..., None]
    try:
        array = np.broadcast_to(array, shape)
    except ValueError:
        refuse(f"{key}: got shape {array.shape}, expected {expected}")
    if not np.all(np.isfinite(array)) or np.any(array < 0):
        refuse(f"{key}: expected finite numbers >= 0")
    return array


def exclusions(
    image: Float[np.ndarray, "height width w"],
    *,
    camera: Camera,
    sun: Float[np.ndarray, "3"],
    mask: Bool[np.ndarray, "height width"] | Mapping[str, Bool[np.ndarray, "height width"]] | None = None,
    saturation: float | None = None,
    sun_exclusion: float = SUN_EXCLUSION,
    view_zenith_max: float = math.pi / 2,
    horizon_exclusion: float = 0.0,
    pedestal: str = FIXED,
    noise_floor: float | np.ndarray = 0.0,
) -> dict[str, Bool[np.ndarray, "height width"]]:
    """The pixels of an image that :func:`observe` leaves out, by reason, with its arguments; without empty ones.

    Each pixel is under the first reason that holds for it.
    """
    directions = np.asarray(camera.directions(), dtype=np.float32)
    from_sun = np.arccos(np.clip(directions @ sun, -1, 1))
    steps: list[tuple[str, np.ndarray]] = [
        ("outside the camera's field of view", ~np.asarray(camera.valid(), dtype=bool)),
        (
            "below the horizon" if view_zenith_max == math.pi / 2 else "beyond the largest view zenith angle",
            _beyond(directions, view_zenith_max),
        ),
        ("not finite", ~np.all(np.isfinite(image), axis=-1)),
        # Noise alone makes the darkest of pixels negative; without them the others would be too bright.
        ("negative", np.any(image < -NEGATIVE * np.asarray(noise_floor), axis=-1) & (pedestal == FIXED)),
        ("black", np.all(image == 0, axis=-1)),
    ]
    if saturation is not None:
        steps.append(("saturated", np.any(image >= saturation, axis=-1)))
    steps += _reasons(mask).items()
    steps.append(("near the sun", from_sun < sun_exclusion))
    steps.append(("near the horizon", np.abs(math.pi / 2 - _zenith(directions)) < horizon_exclusion))
    used = np.ones(image.shape[:2], dtype=bool)
    found: dict[str, np.ndarray] = {}
    for reason, bad in steps:
        if np.any(used & bad):
            found[reason] = found[reason] | (used & bad) if reason in found else used & bad
        used &= ~bad
    return found


def _zenith(directions: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
    return np.arccos(np.clip(directions[..., 2], -1, 1))


def _beyond(
    directions: Float[np.ndarray, "height width 3"], view_zenith_max: float
) -> Bool[np.ndarray, "height width"]:
    """Where the view is lower than it may be; a pixel whose centre lies on the limit itself is not."""
    return _zenith(directions) > view_zenith_max + 1e-6


def _reasons(mask: np.ndarray | Mapping[str, np.ndarray] | None) -> Mapping[str, np.ndarray]:
    """What a mask leaves out, by reason."""
    if mask is None or isinstance(mask, Mapping):
        return {reason: np.asarray(bad, bool) for reason, bad in (mask or {}).items()}
    return {"masked by the user": ~np.asarray(mask, bool)}


def light_of(pixels: Float[np.ndarray, "pixel w"], pedestal: str = FREE) -> Float[np.ndarray, "pixel w"]:
    """About how much light there is in ``pixels`` before it is known how much of them is ``pedestal``.

    What is above the darkest percent of a channel, at least as much as in half of the pixels; of an image without contrast,
    its size.
    """
    if pedestal == FIXED:
        return pixels
    low, middle = np.quantile(pixels, (0.01, 0.5), axis=0)
    contrast = middle - low
    return np.where(contrast > 0, np.maximum(pixels - low, contrast), np.abs(middle))


def _bin(fields: dict[str, np.ndarray], block: int, *, raised: bool) -> dict[str, np.ndarray]:
    """Averages over ``block`` x ``block`` pixels, band after band of their rows: the memory is that of one."""
    height, width = fields["used"].shape
    rows = block * max(BAND // (block * width), 1)
    bands = [
        _bin_band({key: value[first : first + rows] for key, value in fields.items()}, block, raised)
        for first in range(0, height, rows)
    ]
    return {key: np.concatenate([band[key] for band in bands]) for key in bands[0]}


def _bin_band(fields: dict[str, np.ndarray], block: int, raised: bool) -> dict[str, np.ndarray]:
    """Averages over blocks of used pixels where the block has any, else of those shown.

    ``raised`` by an unknown pedestal, the light in a pixel is not known, and taken to be the same in all of a block.
    """

    def blocks(x: np.ndarray) -> np.ndarray:
        height, width = x.shape[:2]
        padding = [(0, -height % block), (0, -width % block)] + [(0, 0)] * (x.ndim - 2)
        x = np.pad(x, padding)
        rows, columns = x.shape[0] // block, x.shape[1] // block
        return x.reshape(rows, block, columns, block, *x.shape[2:]).swapaxes(1, 2)

    split = {key: blocks(value) for key, value in fields.items()}
    used, shown = np.any(split["used"], axis=(2, 3)), np.any(split["shown"], axis=(2, 3))
    chosen = np.where(used[..., None, None], split["used"], split["shown"])
    count = np.maximum(chosen.sum((2, 3)), 1)

    def mean(key: str) -> np.ndarray:
        alone = split[key].ndim == chosen.ndim
        finite = np.where(chosen if alone else chosen[..., None], np.nan_to_num(split[key]), 0)
        return finite.sum((2, 3), dtype=np.float64) / (count if alone else count[..., None])

    directions = mean("directions")
    apart = np.where(chosen[..., None], split["directions"] - directions[:, :, None, None], 0)
    squares = np.einsum("hwabi,hwabj->hwij", apart, apart, dtype=np.float64) / count[..., None, None]
    variances, axes = np.linalg.eigh(squares)
    spread = (np.sqrt(np.maximum(variances, 0))[..., None, :] * axes).swapaxes(-1, -2)[..., 1:, :]
    directions /= np.maximum(np.linalg.norm(directions, axis=-1, keepdims=True), 1e-6)
    directions[~shown], spread[~shown] = (0, 0, 1), 0
    # Variances of independent pixels add, those of their mean are divided by the number squared.
    light = np.ones_like(split["image"]) if raised else split["image"]
    signal = 1.0 if raised else np.maximum(mean("image"), 1e-30)
    squares = np.where(chosen[..., None], np.nan_to_num(split["noise"] * light), 0).astype(np.float64) ** 2
    relative = np.sqrt(squares.sum((2, 3))) / count[..., None] / signal
    dark = np.where(chosen[..., None], split["noise_floor"] ** 2, 0).sum((2, 3), dtype=np.float64)
    binned = {
        "image": mean("image"),
        "directions": directions,
        "radius": mean("radius"),
        "spread": spread,
        "noise": relative,
        "noise_shot": mean("noise_shot") / count[..., None],
        "noise_floor": np.sqrt(dark) / count[..., None],
    }
    return {key: value.astype(np.float32) for key, value in binned.items()} | {"used": used, "shown": shown}


class Noisy(Protocol):
    """What has a noise: an observation, or a batch of them."""

    @property
    def noise(self) -> Any:
        """Relative standard deviation."""

    @property
    def noise_shot(self) -> Any:
        """Variance per unit of signal."""

    @property
    def noise_floor(self) -> Any:
        """Standard deviation without signal."""


def sigma(of: Noisy, light: Float[Array, "*pixels w"] | np.ndarray) -> Float[Array, "*pixels w"]:
    """Standard deviation of pixels with the signal ``light``, which a pedestal is not part of."""
    # Of arrays of NumPy the result is one: every eager operation of JAX compiles a program for every shape.
    xp = jnp if isinstance(light, jax.Array) else np
    positive = xp.maximum(light, 0)
    return xp.sqrt((of.noise * positive) ** 2 + of.noise_shot * positive + of.noise_floor**2)


def unstack(observation: Observation, values: Float[np.ndarray, "pixel w"]) -> Float[np.ndarray, "height width w"]:
    """Values of the shown pixels of one observation on its grid, NaN elsewhere."""
    grid = np.full((*observation.shown.shape, values.shape[-1]), np.nan, dtype=np.float32)
    grid[observation.shown] = values[: int(observation.shown.sum())]
    return grid
