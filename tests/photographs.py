"""Photographs as cameras write them, of any content: files with Exif, and a camera RAW of known light."""

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pillow_heif
import tifffile
from PIL import Image as Pillow

_TYPES = {"B": 1, "s": 2, "H": 3, "I": 4, "2I": 5}

Entries = Mapping[int, tuple[str, object]]


def exif_block(first: Entries, camera: Entries | None = None, gps: Entries | None = None, order: str = "<") -> bytes:
    """An Exif block from tag -> (type, values); rationals are pairs, so that they may be what no number is."""
    subs = {0x8769: camera, 0x8825: gps}
    start, block = 8, b""
    pointers = {}
    for tag, entries in subs.items():
        if entries is not None:
            pointers[tag] = start + len(block)
            block += _directory(entries, start + len(block), order)
    main = {**first, **{tag: ("I", [at]) for tag, at in pointers.items()}}
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", start + len(block))
    return b"Exif\0\0" + head + block + _directory(main, start + len(block), order)


def _directory(entries: Entries, at: int, order: str) -> bytes:
    table, extra = b"", b""
    behind = at + 2 + 12 * len(entries) + 4
    for tag, (form, values) in sorted(entries.items()):
        if form == "s":
            stored, count = values, len(values)
        else:
            flat = np.ravel(values).tolist()
            stored = struct.pack(order + form[-1] * len(flat), *flat)
            count = len(flat) // (2 if form == "2I" else 1)
        if len(stored) > 4:
            inline = struct.pack(order + "I", behind + len(extra))
            extra += stored + b"\0" * (len(stored) % 2)
        else:
            inline = stored.ljust(4, b"\0")
        table += struct.pack(order + "HHI", tag, _TYPES[form], count) + inline
    return struct.pack(order + "H", len(entries)) + table + b"\0\0\0\0" + extra


CAMERA: dict[int, tuple[str, object]] = {
    0x829A: ("2I", [(1, 500)]),
    0x829D: ("2I", [(28, 10)]),
    0x8827: ("H", [200]),
    0x9003: ("s", b"2024:06:21 12:30:15\0"),
    0x9011: ("s", b"+02:00\0"),
    0x920A: ("2I", [(55, 10)]),
    0xA405: ("H", [26]),
    0xA434: ("s", b"A lens\0"),
}
GPS: dict[int, tuple[str, object]] = {
    1: ("s", b"S\0"),
    2: ("2I", [(33, 1), (51, 1), (3000, 100)]),
    3: ("s", b"W\0"),
    4: ("2I", [(70, 1), (30, 1), (0, 1)]),
    5: ("B", [1]),
    6: ("2I", [(125, 10)]),
    7: ("2I", [(10, 1), (30, 1), (12, 1)]),
    16: ("s", b"T\0"),
    17: ("2I", [(3505, 10)]),
    29: ("s", b"2024:06:21\0"),
}
FIRST: dict[int, tuple[str, object]] = {0x10F: ("s", b"A maker\0"), 0x110: ("s", b"A camera\0"), 0x112: ("H", [1])}


def jpeg(path: Path, codes: np.ndarray, block: bytes = b"", **options: object) -> Path:
    Pillow.fromarray(codes).save(path, format="JPEG", quality=95, exif=block, **options)
    return path


def heif(path: Path, codes: np.ndarray, block: bytes = b"") -> Path:
    picture = pillow_heif.from_pillow(Pillow.fromarray(codes))
    picture.save(path, quality=-1, chroma=444, exif=block or None)
    return path


XYZ_TO_CAMERA = np.array([[0.9, -0.3, -0.1], [-0.4, 1.2, 0.2], [0.0, 0.1, 0.6]])


def dng(
    path: Path,
    counts: np.ndarray,
    *,
    black: Sequence[int] = (100, 110, 120, 130),
    white: int = 4000,
    pattern: bytes = bytes([0, 1, 1, 2]),
    neutral: Sequence[float] = (0.5, 1.0, 0.625),
    orientation: int = 1,
    without: Sequence[int] = (),
    **options: object,
) -> Path:
    """A DNG without compression: a Bayer pattern of counts (height, width), or linear RGB (height, width, 3)."""
    pairs = lambda numbers: [x for number in np.ravel(numbers) for x in (round(10000 * number), 10000)]
    bayer = counts.ndim == 2
    tags = [
        (0x10F, "s", 0, "A maker", True),
        (0x110, "s", 0, "A camera", True),
        (0x112, "H", 1, orientation, True),
        (0xC612, "B", 4, bytes([1, 4, 0, 0]), True),
        (0xC614, "s", 0, "A maker's camera", True),
        (0xC621, "2i", 9, pairs(XYZ_TO_CAMERA), True),
        (0xC628, "2I", 3, pairs(neutral), True),
        (0xC65A, "H", 1, 21, True),  # for daylight, D65
        (0xC61D, "I", 1 if bayer else 3, white if bayer else (white,) * 3, True),
    ]
    if bayer:
        tags += [
            (0x828D, "H", 2, (2, 2), True),
            (0x828E, "B", 4, pattern, True),
            (0xC619, "H", 2, (2, 2), True),
            (0xC61A, "H", 4, tuple(black), True),
        ]
    tifffile.imwrite(
        path,
        counts,
        photometric=32803 if bayer else 34892,
        metadata=None,
        software=False,
        extratags=[tag for tag in tags if tag[0] not in without],
        rowsperstrip=len(counts),
        **options,
    )
    return path
