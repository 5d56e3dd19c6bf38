"""A photograph reduced to what tells sky from what is not: log luminance, log red/blue, and how rough they are."""

from typing import NamedTuple

import numpy as np

WORKING_SIZE = 1024
"""Pixels of the longer side that the picture is reduced to; the mask is enlarged again."""

LOW = np.radians(20.0)
"""Elevation below which haze lies in layers."""


class MaskError(ValueError):
    """A picture cannot be masked; the message says what would be right."""


class Small(NamedTuple):
    """The picture at its working size; one that is a full turn goes on beyond its seam."""

    pixels: np.ndarray
    clipped: np.ndarray
    elevation: np.ndarray | None
    from_sun: np.ndarray | None
    turns: bool


class Features(NamedTuple):
    """A picture reduced to what is asked of it, all (rows, columns)."""

    luminance: np.ndarray
    """Mean log of the channels."""
    ratio: np.ndarray
    """Log of the first channel, red, over the last, blue."""
    roughness: np.ndarray
    """Root mean square of what a median over 5 × 5 pixels takes away from both."""
    lit: np.ndarray
    """Where there is light to take a logarithm of."""


def checked(pixels: np.ndarray) -> np.ndarray:
    """Pixels in single precision; raises :class:`MaskError` unless they are (rows, columns, 3)."""
    pixels = np.asarray(pixels, dtype=np.float32)
    if pixels.ndim != 3 or pixels.shape[-1] != 3 or 0 in pixels.shape:
        raise MaskError(f"pixels of shape {pixels.shape}, expected (height, width, 3)")
    return pixels


def factor_of(pixels: np.ndarray) -> int:
    """By which a picture has to be reduced to its working size."""
    return -(-max(pixels.shape[:2]) // WORKING_SIZE)


def reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over squares of ``factor`` pixels, the last row and column repeated where the sides are no multiples of it."""
    if factor == 1:
        return np.asarray(image, dtype=np.float32)
    height, width = image.shape[:2]
    pad = [(0, -height % factor), (0, -width % factor)] + [(0, 0)] * (image.ndim - 2)
    full = np.pad(np.asarray(image, dtype=np.float32), pad, mode="edge")
    tiles = full.reshape(full.shape[0] // factor, factor, full.shape[1] // factor, factor, *full.shape[2:])
    return tiles.mean(axis=(1, 3))


def light_of(pixels: np.ndarray, factor: int) -> np.ndarray:
    """The picture at its working size, 1 at most; NaN where a pixel is not finite."""
    finite = np.isfinite(pixels).all(axis=-1, keepdims=True)
    peak = pixels.max(initial=0, where=finite)
    return reduced(np.where(finite, pixels / (peak if peak > 0 else 1), np.nan), factor)


def is_panorama(elevation: np.ndarray) -> bool:
    """Whether the picture is a full turn about the vertical: rows of one elevation that reach up to the zenith."""
    height, width = elevation.shape
    return width >= 2 * height and bool(np.ptp(elevation, axis=1).max() < 1e-3) and elevation.max() > np.radians(80)


def wrapped(image: np.ndarray, turns: bool) -> np.ndarray:
    """The picture, if it ``turns`` with an eighth of its columns repeated beyond either side."""
    if not turns:
        return image
    columns = image.shape[1] // 8
    return np.concatenate([image[:, image.shape[1] - columns :], image, image[:, :columns]], axis=1)


def blurred(image: np.ndarray, sigma: float | tuple[float, float]) -> np.ndarray:
    """Mean of the picture's neighbourhood, weighted by a Gaussian of ``sigma`` pixels."""
    from skimage import filters

    return filters.gaussian(image.astype(np.float32), sigma=sigma, mode="nearest", preserve_range=True)


def dilated(mask: np.ndarray, radius: float) -> np.ndarray:
    """What lies within ``radius`` pixels of the mask."""
    from skimage import morphology

    return morphology.isotropic_dilation(mask, radius) if mask.any() else mask


def features(small: Small) -> Features:
    """What tells sky from what is not; holes are filled with what is around them."""
    from skimage import filters, morphology

    finite = np.isfinite(small.pixels).all(axis=-1)
    light = np.where(finite[..., None], small.pixels, 0)
    mean = light.mean(axis=-1)
    typical = np.median(mean[mean > 0]) if (mean > 0).any() else 1.0
    lit = finite & (light > 1e-6 * typical).all(axis=-1)
    logs = np.log(np.maximum(light, 1e-6 * typical))
    # A hole, and the ground where it is known to begin, have no edge.
    known = lit if small.elevation is None else lit & (small.elevation >= 0)
    coarse = max(lit.shape) < WORKING_SIZE / 2
    share = blurred(known, 3)
    square = morphology.footprint_rectangle((3, 3) if coarse else (5, 5))
    maps, rough = [], []
    for image in (logs.mean(axis=-1), logs[..., 0] - logs[..., 2]):
        near = blurred(np.where(known, image, 0), 3) / np.maximum(share, 1e-6)
        filled = np.where(known | (share < 1e-3), image, near).astype(np.float32)
        fine = filled - filters.median(filled, square, mode="nearest")
        maps.append(filled)
        rough.append((fine - layers(fine, small, known)) ** 2)
    luminance, ratio = maps
    return Features(luminance, ratio, np.sqrt(blurred(rough[0] + rough[1], 0.8 if coarse else 1.5)), lit)


def layers(image: np.ndarray, small: Small, where: np.ndarray, share: float = 50.0) -> np.ndarray:
    """What lies in layers: the median by elevation over the lowest 20 degrees, fading out above 15."""
    if small.elevation is None:
        return np.zeros_like(image)
    low = where & (small.elevation >= 0) & (small.elevation < LOW)
    number = (small.elevation[low] / np.radians(0.5)).astype(int)
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    groups = [group for group in np.split(order, starts)[1:] if group.size >= 20]
    if not groups:
        return np.zeros_like(image)
    nodes = [float(small.elevation[low][group].mean()) for group in groups]
    medians = np.array([float(np.percentile(image[low][group], share)) for group in groups])
    fade = np.clip((LOW - np.array(nodes)) / np.radians(5), 0, 1)
    return np.interp(small.elevation, nodes, medians * fade).astype(np.float32)
