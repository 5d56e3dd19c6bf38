"""Pictures of one scene with different exposures, merged into one of more range than any of them.

A linear picture with the relative exposure t shows the scene's light L as v = t L + noise, where the variance of the noise is
``shot`` v for the photons and ``floor``² for reading them out. Each picture gives an estimate v / t of L with the variance
(shot t L + floor²) / t²; their mean with the inverse of these as weights has the smallest variance there is (Hasinoff, Durand &
Freeman 2010; Granados et al. 2010; before them Debevec & Malik 1997 and Robertson et al. 2003 with weights of other shapes).
The L in the weights is that of a first estimate from all pictures, not v / t: weights that know a pixel's own noise prefer
those that it made darker.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffatmo.exif import Exif


class Merged(NamedTuple):
    """Several exposures as one picture."""

    pixels: Float[np.ndarray, "height width channels"]
    """Light per unit of exposure, float32; NaN where every picture is clipped, or lost in the noise."""
    noise: Float[np.ndarray, "height width channels"]
    """Relative standard deviation of that; NaN likewise."""


SHOT, FLOOR = 5e-5, 3e-4
"""Of a sensor that holds 20 000 electrons, read with 6 of noise; in units of what it holds."""

_CLIPPED_WITHIN, _DARK_BELOW = 4.0, 3.0
"""Standard deviations from saturation, and of the dark noise, within which a value is not used."""

_PASSES = 3


def exposure_of(exif: Exif) -> float | None:
    """Relative exposure time · ISO / 100 / f-number², s; None where one of them is unknown."""
    if exif.exposure_s is None or exif.iso is None or exif.f_number is None:
        return None
    return exif.exposure_s * exif.iso / 100 / exif.f_number**2


def merge(
    images: Sequence[Float[np.ndarray, "height width channels"]],
    exposures_s: Sequence[float],
    *,
    saturation: float = 1.0,
    shot: float = SHOT,
    floor: float = FLOOR,
) -> Merged:
    """Merge linear pictures, each with its exposure, by inverse variance.

    Args:
        images: Black is 0. All of one size, taken from one place in one direction. NaN counts as clipped.
        exposures_s: Exposure times, or :func:`exposure_of` where ISO or aperture differ as well. The result is per unit of
            them.
        saturation: Value at which a pixel is clipped.
        shot: Variance per unit of signal of the photon noise.
        floor: Standard deviation of a dark pixel.

    Raises:
        ValueError: Fewer than two pictures, different sizes, exposures that are not positive or do not differ, or a noise
            that is not positive.
    """
    pictures = [np.asarray(image, dtype=np.float32) for image in images]
    exposures = np.asarray(exposures_s, dtype=float)
    _check(pictures, exposures)
    if not (0 < saturation < np.inf and 0 < shot < np.inf and 0 < floor < np.inf):
        raise ValueError(f"saturation = {saturation:g}, shot = {shot:g}, floor = {floor:g}, expected positive numbers")
    highest = saturation - _CLIPPED_WITHIN * np.sqrt(shot * saturation + floor**2)
    clipped = [~(picture < highest) for picture in pictures]
    light = np.zeros(pictures[0].shape)
    for number in range(_PASSES):
        total, weight = np.zeros_like(light), np.zeros_like(light)
        for picture, exposure, out in zip(pictures, exposures, clipped, strict=True):
            expected = exposure * light
            used = ~out if number == 0 else ~out & (expected > _DARK_BELOW * floor)
            w = np.where(used, exposure**2 / (shot * np.maximum(expected, 0) + floor**2), 0)
            total += w * np.where(used, picture / exposure, 0)
            weight += w
        light = np.divide(total, weight, out=np.full_like(light, np.nan), where=weight > 0)
    noise = np.divide(1, np.sqrt(weight) * light, out=np.full_like(light, np.nan), where=light > 0)
    return Merged(light.astype(np.float32), noise.astype(np.float32))


def _check(pictures: Sequence[np.ndarray], exposures: np.ndarray) -> None:
    if len(pictures) < 2:
        raise ValueError(f"{len(pictures)} pictures to merge, expected at least two")
    if exposures.shape != (len(pictures),):
        raise ValueError(f"{exposures.size} exposures for {len(pictures)} pictures, expected one for each")
    if not np.all((exposures > 0) & np.isfinite(exposures)):
        raise ValueError(f"exposures {_listed(exposures)}, expected positive numbers")
    if np.all(exposures == exposures[0]):
        raise ValueError(f"every picture has the exposure {exposures[0]:g}, expected different ones")
    sizes = {picture.shape for picture in pictures}
    if len(sizes) > 1 or pictures[0].ndim != 3:
        listed = ", ".join(str(size) for size in sorted(sizes))
        raise ValueError(f"pictures of shape {listed}, expected (height, width, channels), the same for all")


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:g}" for value in values)
