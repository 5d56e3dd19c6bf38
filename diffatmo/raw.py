"""Camera RAW as linear light: what the sensor counted, less its black level, as a fraction of what it can hold.

No white balance, no tone curve, no gamma, no colours of a neighbour: LibRaw decodes the file, and each 2 x 2 cell of the Bayer
pattern becomes one pixel, its green the mean of two. Needs the extra ``raw``.
"""

import mmap
from datetime import datetime
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from diffatmo import color, exif
from diffatmo.codecs import decoding
from diffatmo.exif import Exif


class Raw(NamedTuple):
    """A RAW as it was read."""

    pixels: Float[np.ndarray, "height width 3"]
    """Red, green and blue of the sensor, float32, the right way up; 0 is black and 1 saturated."""
    to_xyz: Float[np.ndarray, "3 3"] | None
    """From the camera's RGB, without white balance, to CIE XYZ, up to a common factor; by its maker, for daylight (D65)."""
    white_balance: tuple[float, float, float] | None
    """What the camera would have multiplied red, green and blue by; green is 1."""
    exif: Exif
    turned: int
    """Exif's orientation of the stored picture, which ``pixels`` are turned by."""


_DAMAGED = "the RAW is damaged"

_SIGNATURES = (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FOVb", b"\0MRM")
"""Of Fujifilm, Olympus, Panasonic, Sigma and Minolta. Others have the structure of a TIFF, or of MP4 (Canon's CR3)."""

_PHOTOMETRIC, _SUB_IFDS, _DNG_VERSION = 0x106, 0x14A, 0xC612
_SENSOR = (32803, 34892)
"""Photometric interpretations: a colour filter array, and linear RGB of a sensor."""


def is_raw(data: exif.Bytes) -> bool:
    """Whether a file is camera RAW, by what it begins with, and by the directories of a TIFF."""
    if data[4:12] == b"ftypcrx " or any(data[: len(signature)] == signature for signature in _SIGNATURES):
        return True
    first = exif.fields(data, (_PHOTOMETRIC, _SUB_IFDS, _DNG_VERSION))
    if _DNG_VERSION in first or (first and data[8:10] == b"CR"):
        return True
    offsets = first.get(_SUB_IFDS, ())
    directories = [first, *(exif.fields(data, (_PHOTOMETRIC,), int(at)) for at in offsets if not isinstance(at, str))]
    return any(directory.get(_PHOTOMETRIC, (0,))[0] in _SENSOR for directory in directories)


def read(path: Path, max_pixels: int) -> Raw:
    """Read a RAW of at most so many pixels.

    Raises ``ValueError`` where rawpy is missing, the file is damaged, or the sensor is not one of red, green and blue.
    """
    rawpy = _rawpy()
    with rawpy.RawPy() as file:
        with decoding(_DAMAGED):
            file.open_file(str(path))
            sizes = file.sizes
        if min(sizes.raw_height, sizes.raw_width, sizes.height, sizes.width) < 2:
            raise ValueError(f"the RAW has {sizes.width} x {sizes.height} pixels, expected at least 2 x 2")
        if sizes.raw_height * sizes.raw_width > max_pixels:
            claim = f"{sizes.raw_width} x {sizes.raw_height} pixels"
            raise ValueError(f"the header claims {claim}, more than the {max_pixels:,} that are accepted")
        with decoding(_DAMAGED):
            file.unpack()
        # What decoding by LibRaw changes is asked before.
        to_xyz, white_balance, notes = _to_xyz(file), _white_balance(file), _exif(path, file)
        pixels = _bayer(file) if _is_bayer(file, rawpy) else _other_sensor(file, rawpy)
    orientation = _ORIENTATIONS.get(sizes.flip, 1)
    pixels = np.ascontiguousarray(exif.upright(pixels, orientation))
    return Raw(pixels, to_xyz, white_balance, notes._replace(orientation=1, size=pixels.shape[:2]), orientation)


def _rawpy() -> ModuleType:
    try:
        import rawpy
    except ImportError:
        raise ValueError("camera RAW needs rawpy: pip install 'diffatmo[raw]'") from None
    return rawpy


_ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}
"""LibRaw's flip (1 left and right, 2 top and bottom, 4 rows and columns, in that order of bits) as Exif's orientation."""


def _is_bayer(file: Any, rawpy: ModuleType) -> bool:
    return file.raw_type == rawpy.RawType.Flat and file.raw_pattern is not None and file.raw_pattern.shape == (2, 2)


def _bayer(file: Any) -> np.ndarray:
    """The mean of each colour in each 2 x 2 cell; saturated where one of them is."""
    names = file.color_desc.decode("latin-1")
    cell = file.raw_colors_visible[:2, :2]
    counts = file.raw_image_visible
    height, width = counts.shape[0] // 2, counts.shape[1] // 2
    black, white = _levels(file)
    planes: dict[str, list[np.ndarray]] = {}
    for y, x in np.ndindex(2, 2):
        index = int(cell[y, x])
        plane = counts[y::2, x::2][:height, :width].astype(np.float32)
        planes.setdefault(names[index], []).append((plane - black[index]) / (white[index] - black[index]))
    if set(planes) != set("RGB"):
        raise ValueError(f"a sensor with the colours {', '.join(sorted(planes))}, expected R, G and B")
    pixels = np.empty((height, width, 3), np.float32)
    for channel, name in enumerate("RGB"):
        mean, most = np.mean(planes[name], axis=0), np.max(planes[name], axis=0)
        pixels[..., channel] = np.where(most >= 1, most, mean)
    return pixels


def _levels(file: Any) -> tuple[np.ndarray, np.ndarray]:
    """Counts at which each colour is black, and saturated."""
    black = np.asarray(file.black_level_per_channel, np.float32)
    white = np.full_like(black, file.white_level)
    own = file.camera_white_level_per_channel
    if own is not None:
        white = np.where(np.asarray(own) > black, np.asarray(own, np.float32), white)
    if not np.all(white > black):
        raise ValueError(f"the RAW has a black level of {black.max():g} and a white level of {white.min():g}")
    return black, white


def _other_sensor(file: Any, rawpy: ModuleType) -> np.ndarray:
    """By LibRaw's own averaging at half the size, its integers of 16 bits."""
    with decoding(_DAMAGED):
        codes = file.postprocess(
            half_size=True,
            output_color=rawpy.ColorSpace.raw,
            output_bps=16,
            gamma=(1, 1),
            user_wb=[1, 1, 1, 1],
            no_auto_bright=True,
            adjust_maximum_thr=0,
            user_flip=0,
        )
    if codes.ndim != 3 or codes.shape[-1] != 3:
        raise ValueError(f"the RAW decodes to pixels of shape {codes.shape}, expected (height, width, 3)")
    return codes.astype(np.float32) / np.float32(65535)


def _to_xyz(file: Any) -> np.ndarray | None:
    """LibRaw has either the matrix from XYZ to the camera, or that from the camera balanced for D65 to linear sRGB."""
    from_xyz = np.asarray(file.rgb_xyz_matrix, float)[:3]
    if np.any(from_xyz) and abs(np.linalg.det(from_xyz)) > 1e-6:
        return np.linalg.inv(from_xyz)
    to_rgb, daylight = np.asarray(file.color_matrix, float)[:, :3], np.asarray(file.daylight_whitebalance, float)[:3]
    if not (np.all(np.isfinite(to_rgb)) and np.any(to_rgb) and np.all(daylight > 0)):
        return None
    return np.linalg.inv(color.XYZ_TO_SRGB) @ to_rgb * daylight


def _white_balance(file: Any) -> tuple[float, float, float] | None:
    red, green, blue = (float(factor) for factor in file.camera_whitebalance[:3])
    good = np.isfinite([red, green, blue]).all() and min(red, green, blue) > 0
    return (red / green, 1.0, blue / green) if good else None


def _exif(path: Path, file: Any) -> Exif:
    """From the file where it has the structure of a TIFF or a preview with an Exif block, else what LibRaw found."""
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        preview = data.find(b"Exif\0\0", 0, 2**20)
        tiff = data[:2] in (b"II", b"MM") or preview < 0
        found = exif.parse(data if tiff else data[preview : preview + 2**16])
    if found != Exif():
        return found
    other = file.other
    taken = other.timestamp
    return Exif(
        focal_length_mm=other.focal_length or None,
        exposure_s=other.shutter_speed or None,
        f_number=other.aperture or None,
        iso=other.iso_speed or None,
        local_time=taken if isinstance(taken, datetime) and taken.year > 1990 else None,
    )
