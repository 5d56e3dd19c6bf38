"""Several exposures of one view, read from their files, as one picture: ``file = [...]`` in a scene file, ``--bracket``.

:mod:`diffatmo.brackets` merges them; here is what has to be known for it, where it comes from, and whether the files can be
exposures of one view at all.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from diffatmo.cli.common import InputError
from diffatmo.cli.keys import flag_of

if TYPE_CHECKING:
    import numpy as np

    from diffatmo.exif import Exif
    from diffatmo.imageio import Image

OWN_KEYS = ("exposure_s", "noise_shot", "noise_floor", "saturation")
"""Options that say something of the files, and nothing of the merged picture any more."""

COMPASS_DEG, PLACE_DEG, TIME = 2.0, 1e-3, timedelta(minutes=5)
"""By how much compass, latitude and longitude may differ, and the times: the sun moves by a degree meanwhile."""

MOST_APART = 2.0
"""Factor between what two exposures say of one light, beyond which exposures or pictures are mistaken."""

LOWEST, HIGHEST = 0.05, 0.9
"""Of what a pixel can hold: where two exposures are compared."""

PARTS, PART_SIZE = 8, 100
"""From dark to bright they are compared in so many parts at most, of so many pixels at least."""


class Agreement(NamedTuple):
    """How well two exposures agree on the light, where they do worst: medians over pixels that are about as bright."""

    apart: float
    """Logarithm of the ratio of what they say of it."""
    exponent: float
    """Error of the exponent of a transfer function, if that is why."""


class Merged(NamedTuple):
    """A bracket as one picture."""

    image: "Image"
    """Light per unit of exposure, with its noise; a pixel that is clipped in all files is at ``image.saturation``."""
    told: str
    """What was merged, in words."""
    exponent_error: float | None
    """What the exponent of the transfer function that was undone may be off by; None if the exposures do not tell."""


def merge(
    files: Sequence[Path],
    images: "Sequence[Image]",
    options: Mapping[str, Any],
    known: Sequence[float] | None = None,
) -> Merged:
    """Merge what was read from ``files`` by the exposures that are stated, else those ``known``, else those of Exif.

    Raises :class:`InputError` where the files are not exposures of one view, or it is not known how they were exposed or where
    they are clipped.
    """
    import numpy as np

    from diffatmo import brackets

    for file, image in zip(files[1:], images[1:], strict=True):
        _check_same(files[0], images[0], file, image)
    exposures = options.get("exposure_s", known) or [
        _exposure(file, image.exif) for file, image in zip(files, images, strict=True)
    ]
    white = options.get("saturation", images[0].saturation)
    if white is None:
        raise InputError(
            f"saturation: {files[0]} does not say at which value it is clipped; give {flag_of('saturation')}, or saturation in "
            "a scene file"
        )
    pictures = [image.pixels for image in images]
    try:
        light, noise = brackets.merge(
            pictures,
            exposures,
            saturation=white,
            shot=options.get("noise_shot", brackets.SHOT * white),
            floor=options.get("noise_floor", brackets.FLOOR * white),
        )
    except ValueError as error:
        raise InputError(f"{files[0]}: {error}") from error
    guessed = any(image.taken_as_linear for image in images)
    found = _check_exposures(files, pictures, exposures, white, guessed=guessed)
    # What is lost in the noise of the shortest exposure is far from its saturation.
    shortest = pictures[int(np.argmin(exposures))]
    brightest = white / min(exposures)
    clipped = np.isnan(light) & ~(shortest < white / 2)
    # Pixels without light are left out by the fit, whatever their noise, which has to be a number.
    image = images[0]._replace(
        pixels=np.where(clipped, np.float32(brightest), light), noise=np.nan_to_num(noise), saturation=float(brightest)
    )
    span = f"{min(exposures):g} to {max(exposures):g} s"
    agreement = f"; where two show the same, they agree to {100 * found.apart:.1f} %" if found else ""
    return Merged(image, f"merged from {len(files)} files, exposed {span}{agreement}", found and found.exponent)


def _check_same(first: Path, image: "Image", file: Path, other: "Image") -> None:
    """Refuse two files that cannot be exposures of one view."""

    def refuse(what: str, mine: str, its: str) -> None:
        raise InputError(f"{file}: {what} {its}, but {first} has {mine}; expected exposures of one view")

    def differ(what: str, of: "Callable[[Exif], Any]", within: Any = None, unit: str = "") -> None:
        mine, its = of(image.exif), of(other.exif)
        if mine is None or its is None:
            return
        if mine != its if within is None else abs(mine - its) > within:
            refuse(what, f"{mine}{unit}", f"{its}{unit}")

    sizes = ["{1} x {0} pixels of {2} channels".format(*picture.pixels.shape) for picture in (image, other)]
    if sizes[0] != sizes[1]:
        refuse("a picture of", *sizes)
    if image.wavelengths != other.wavelengths:
        refuse("wavelengths", str(image.wavelengths), str(other.wavelengths))
    if image.turned != other.turned:
        refuse("an orientation in Exif of", str(image.turned), str(other.turned))
    differ("camera", lambda exif: exif.model)
    differ("lens", lambda exif: exif.lens)
    differ("a focal length of", lambda exif: exif.focal_length_mm, 1e-3, " mm")
    differ("a focal length in 35 mm terms of", lambda exif: exif.focal_length_35mm_mm, 1e-3, " mm")
    differ("a latitude of", lambda exif: exif.latitude_deg, PLACE_DEG, "°")
    differ("a longitude of", lambda exif: exif.longitude_deg, PLACE_DEG, "°")
    differ("the time", lambda exif: exif.time, TIME)
    differ("the time", lambda exif: exif.local_time, TIME)
    mine, its = image.exif.compass_deg, other.exif.compass_deg
    if mine is not None and its is not None and abs((its - mine + 180) % 360 - 180) > COMPASS_DEG:
        refuse("a compass bearing of", f"{mine:g}°", f"{its:g}°")


def _exposure(file: Path, exif: "Exif") -> float:
    """By the camera's own notes."""
    from diffatmo.brackets import exposure_of

    found = exposure_of(exif)
    if found is None:
        raise InputError(
            f"exposure_s: {file} does not say its exposure time, ISO and f-number; give {flag_of('exposure_s')}, or exposure_s "
            "in a scene file, for all files"
        )
    return found


def _check_exposures(
    files: Sequence[Path],
    pictures: "Sequence[np.ndarray]",
    exposures: Sequence[float],
    white: float,
    *,
    guessed: bool,
) -> Agreement | None:
    """How well neighbouring exposures agree on the light; None if no pixel is exposed well in both of two.

    ``guessed`` are pictures that were taken as linear although they do not say so.

    Raises :class:`InputError` where they do not at all.
    """
    import numpy as np

    order = np.argsort(exposures)
    found = []
    for shorter, longer in pairwise(order):
        low, high = pictures[shorter] / white, pictures[longer] / white
        both = (low > LOWEST) & (high > LOWEST) & (low < HIGHEST) & (high < HIGHEST)
        if not both.any():
            continue
        stated = exposures[longer] / exposures[shorter]
        ratio = (high[both] / low[both])[np.argsort(high[both])]
        if not 1 / MOST_APART < np.median(ratio) / stated < MOST_APART:
            raise InputError(
                f"{files[longer]}: {np.median(ratio):.3g} times as bright as {files[shorter]}, where both are exposed well, "
                f"but by their exposures it would be {stated:.3g} times; expected the exposures in the order of the files"
                + guessed
                * ", or --transfer srgb if they were developed for a screen"
            )
        parts = np.array_split(ratio, min(PARTS, max(ratio.size // PART_SIZE, 1)))
        apart = max(abs(math.log(np.median(part) / stated)) for part in parts)
        found.append(Agreement(apart, apart / math.log(stated)))
    return Agreement(*map(max, zip(*found, strict=True))) if found else None
