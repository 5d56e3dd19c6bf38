"""What a camera notes about a picture: when, where, in which direction, with which lens and exposure.

Exif (CIPA DC-008) is a TIFF file without pixels that other formats carry along; TIFF, DNG and most camera RAW hold the same
fields themselves. Cameras leave fields out, fill them with zeros, and editors damage them: whatever is missing, malformed or
impossible is None here, never an error and never a wrong number. Only the fields that are wanted are read, and no more than
a few bytes of each, so that a hostile header costs neither time nor memory; libraries read all of them, in full.
"""

import math
import mmap
import struct
from collections.abc import Container, Mapping
from datetime import UTC, datetime, timedelta, timezone
from typing import NamedTuple

import numpy as np

Bytes = bytes | mmap.mmap
Field = str | tuple[float, ...]


class Exif(NamedTuple):
    """What is known of how a picture was taken; None is unknown."""

    orientation: int | None = None
    """1 to 8: how the stored picture is to be turned; 1 is as it is."""
    size: tuple[int, int] | None = None
    """Height and width of the picture the right way up."""
    focal_length_mm: float | None = None
    focal_length_35mm_mm: float | None = None
    """Of the lens that sees as much on 36 mm x 24 mm, by the diagonal."""
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    time: datetime | None = None
    """When it was taken, with its offset from UTC."""
    local_time: datetime | None = None
    """The time on the camera's clock where its offset from UTC is unknown; None where ``time`` is known."""
    latitude_deg: float | None = None
    """North is positive."""
    longitude_deg: float | None = None
    """East is positive."""
    altitude_m: float | None = None
    """Above sea level."""
    compass_deg: float | None = None
    """Azimuth of the optical axis, clockwise from north."""
    compass_is_magnetic: bool | None = None
    """Whether that is from magnetic north, not from true north."""
    make: str | None = None
    model: str | None = None
    lens: str | None = None


FULL_FRAME_DIAGONAL_MM = math.hypot(36, 24)


def fov_deg(exif: Exif) -> tuple[float, float] | None:
    """Vertical and horizontal field of view of the picture the right way up, degrees; None if unknown.

    The focal length in 35 mm terms is that of the lens whose 43.27 mm diagonal sees as much as the picture's (CIPA DC-008),
    without distortion.
    """
    if exif.focal_length_35mm_mm is None or exif.size is None:
        return None
    focal = exif.focal_length_35mm_mm * math.hypot(*exif.size) / FULL_FRAME_DIAGONAL_MM  # in pixels
    vertical, horizontal = (2 * math.degrees(math.atan(side / (2 * focal))) for side in exif.size)
    return vertical, horizontal


def vertical_fov_deg(exif: Exif) -> float | None:
    """Angle from the top edge to the bottom edge, degrees; see :func:`fov_deg`."""
    fov = fov_deg(exif)
    return fov[0] if fov else None


def upright(pixels: np.ndarray, orientation: int | None) -> np.ndarray:
    """The picture the right way up: a view of ``pixels`` (height, width, …)."""
    if orientation in (2, 3, 7, 8):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4, 6, 7):
        pixels = pixels[::-1]
    return pixels.swapaxes(0, 1) if orientation in (5, 6, 7, 8) else pixels


# --- The fields of a TIFF

_FORMATS = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h", 9: "i", 10: "ii", 11: "f", 12: "d"}
_FORMATS |= {13: "I", 129: "s"}
"""Types of TIFF 6.0, and those that Exif 3.0 and TIFF's supplements add."""

_TEXT_AT_MOST, _NUMBERS_AT_MOST = 256, 16


def fields(data: Bytes, wanted: Container[int], offset: int | None = None) -> dict[int, Field]:
    """The wanted fields of a TIFF's directory: a text, or numbers. Without ``offset`` it is the first directory.

    Damaged ones are left out; numbers may be infinite or NaN. Of a text there are 256 characters at most, of numbers 16.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None or len(data) < 8:
        return {}
    if offset is None:
        (offset,) = struct.unpack(order + "I", data[4:8])
    if offset < 8 or offset + 2 > len(data):
        return {}
    (count,) = struct.unpack(order + "H", data[offset : offset + 2])
    found: dict[int, Field] = {}
    directory = data[offset + 2 : offset + 2 + 12 * count]
    for tag, kind, length, inline in struct.iter_unpack(order + "HHI4s", directory[: len(directory) // 12 * 12]):
        if tag in wanted and tag not in found and kind in _FORMATS and length:
            value = _value(data, order, _FORMATS[kind], length, inline)
            if value is not None:
                found[tag] = value
    return found


def _value(data: Bytes, order: str, form: str, length: int, inline: bytes) -> Field | None:
    length = min(length, _TEXT_AT_MOST if form == "s" else _NUMBERS_AT_MOST)
    size = length * struct.calcsize("=" + form)
    if size > 4:
        (start,) = struct.unpack(order + "I", inline)
        stored = data[start : start + size]
    else:
        stored = inline[:size]
    if len(stored) < size:
        return None
    if form == "s":
        return stored.decode("latin-1")
    numbers = struct.unpack(order + form * length, stored)
    if len(form) == 1:
        return numbers
    return tuple(a / b if b else math.nan for a, b in zip(numbers[::2], numbers[1::2], strict=True))


# --- The fields of Exif

_MAKE, _MODEL, _ORIENTATION, _EXIF, _GPS = 0x10F, 0x110, 0x112, 0x8769, 0x8825
_EXPOSURE, _F_NUMBER, _FOCAL, _FOCAL_35, _LENS = 0x829A, 0x829D, 0x920A, 0xA405, 0xA434
_ISO = (0x8827, 0x8833, 0x8832, 0x8831)
"""PhotographicSensitivity, and where to look when that has too few bits: ISO speed, recommended index, output sensitivity."""
_CLOCKS = ((0x9003, 0x9011), (0x9004, 0x9012))
"""When it was taken, when it was digitised, each with its offset from UTC. 0x132 is when the file was changed last."""
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT, _TIME, _DIR_REF, _DIR, _DATE = 1, 2, 3, 4, 5, 6, 7, 16, 17, 29

_IN_FIRST = {_MAKE, _MODEL, _ORIENTATION, _EXIF, _GPS}
_IN_EXIF = {_EXPOSURE, _F_NUMBER, _FOCAL, _FOCAL_35, _LENS, *_ISO, *(tag for pair in _CLOCKS for tag in pair)}
_IN_GPS = {_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT, _TIME, _DIR_REF, _DIR, _DATE}

_ALTITUDES_M = (-500.0, 100_000.0)
_LOCAL_MINUS_UTC = (timedelta(hours=-13), timedelta(hours=15))
"""All offsets there are, and an hour for the clock: beyond that the camera's clock and the satellites contradict each other."""


def parse(block: Bytes) -> Exif:
    """Read an Exif block, or a TIFF or a RAW with the structure of one; what cannot be read is None."""
    block = block[6:] if block[:6] == b"Exif\0\0" else block
    first = fields(block, _IN_FIRST)
    exif = fields(block, _IN_EXIF, _offset(first, _EXIF))
    gps = fields(block, _IN_GPS, _offset(first, _GPS))
    time, local_time = _times(exif, gps)
    latitude, longitude = _degrees(gps, _LAT, _LAT_REF, "NS", 90), _degrees(gps, _LON, _LON_REF, "EW", 180)
    if None in (latitude, longitude) or latitude == longitude == 0:  # receivers without a fix say 0, 0
        latitude = longitude = None
    compass = _number(gps, _DIR, 0, 360)
    iso = (_number(exif, tag, 1, 1e8) for tag in _ISO)
    orientation = _number(first, _ORIENTATION, 1, 8)
    return Exif(
        orientation=int(orientation) if orientation is not None and orientation.is_integer() else None,
        focal_length_mm=_number(exif, _FOCAL, 0.1, 1e4),
        focal_length_35mm_mm=_number(exif, _FOCAL_35, 1, 1e4),
        exposure_s=_number(exif, _EXPOSURE, 1e-7, 1e5),
        f_number=_number(exif, _F_NUMBER, 0.1, 1e3),
        iso=next((value for value in iso if value is not None and value != 65535), None),
        time=time,
        local_time=local_time,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=_altitude(gps),
        compass_deg=None if compass is None else compass % 360,
        compass_is_magnetic={"M": True, "T": False}.get(_text(gps, _DIR_REF) or "") if compass is not None else None,
        make=_text(first, _MAKE),
        model=_text(first, _MODEL),
        lens=_text(exif, _LENS),
    )


def _offset(found: Mapping[int, Field], tag: int) -> int:
    """Of a directory; 0, where there is none, if it is not known."""
    value = _number(found, tag, 0, 2**32)
    return int(value) if value is not None else 0


def _number(found: Mapping[int, Field], tag: int, least: float, most: float) -> float | None:
    values = found.get(tag)
    if not isinstance(values, tuple) or not least <= values[0] <= most:
        return None
    return float(values[0])


def _text(found: Mapping[int, Field], tag: int) -> str | None:
    value = found.get(tag)
    if not isinstance(value, str):
        return None
    printable = "".join(c if c.isprintable() else " " for c in value.split("\0")[0])
    return " ".join(printable.split()) or None


def _triple(found: Mapping[int, Field], tag: int, limits: tuple[float, float, float]) -> tuple[float, ...] | None:
    """Three numbers from 0 to below their limits: hours or degrees, minutes, seconds."""
    values = found.get(tag)
    if not isinstance(values, tuple) or len(values) != 3:
        return None
    good = all(0 <= value < limit for value, limit in zip(values, limits, strict=True))
    return values if good else None


def _degrees(gps: Mapping[int, Field], tag: int, reference: int, signs: str, most: float) -> float | None:
    parts, sign = _triple(gps, tag, (most + 1, 60, 60)), _text(gps, reference)
    if parts is None or sign is None or sign not in signs:
        return None
    angle = parts[0] + parts[1] / 60 + parts[2] / 3600
    return None if angle > most else angle if sign == signs[0] else -angle


def _altitude(gps: Mapping[int, Field]) -> float | None:
    height, below = _number(gps, _ALT, 0, _ALTITUDES_M[1]), _number(gps, _ALT_REF, 0, 1)
    if height is None or below not in (0, 1):
        return None
    height = -height if below else height
    return height if height >= _ALTITUDES_M[0] else None


def _times(exif: Mapping[int, Field], gps: Mapping[int, Field]) -> tuple[datetime | None, datetime | None]:
    """(with its offset from UTC, without): one of them, or neither."""
    clock, offset = None, None
    for tag, offset_tag in _CLOCKS:
        if clock is None:
            clock, offset = _parsed(_text(exif, tag), "%Y:%m:%d %H:%M:%S"), _text(exif, offset_tag)
    zone = _zone(offset)
    if clock is not None and zone is not None:
        return clock.replace(tzinfo=zone), None
    satellites = _satellite_time(gps)
    if satellites is not None and clock is not None:
        least, most = _LOCAL_MINUS_UTC
        if not least <= clock - satellites.replace(tzinfo=None) <= most:
            satellites = None
    return (satellites, None) if satellites else (None, clock)


def _satellite_time(gps: Mapping[int, Field]) -> datetime | None:
    day, time = _parsed(_text(gps, _DATE), "%Y:%m:%d"), _triple(gps, _TIME, (24, 60, 60))
    if day is None or time is None or day.year < 1990:  # receivers without a fix count from their epoch in 1980
        return None
    hours, minutes, seconds = time
    return day.replace(tzinfo=UTC) + timedelta(hours=hours, minutes=minutes, seconds=seconds)


def _parsed(text: str | None, form: str) -> datetime | None:
    try:
        return datetime.strptime(text or "", form)
    except ValueError:
        return None


def _zone(text: str | None) -> timezone | None:
    parsed = _parsed(text, "%z")
    offset = parsed.utcoffset() if parsed else None
    least, most = _LOCAL_MINUS_UTC
    return timezone(offset) if offset is not None and least < offset < most else None
