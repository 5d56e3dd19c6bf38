"""Decoders for two formats that no library at hand reads in full: Radiance pictures and PNG with 16 bits a channel.

Neither asks for memory before it knows that the file is long enough for the pixels that its header claims.

Both take the bytes of a file and raise ``ValueError`` with one line on what is wrong with them; :func:`decoding` makes other
libraries do so.
"""

import os
import re
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import NamedTuple

import numpy as np
from PIL import Image as Pillow

_TRUNCATED = "the file ends before the last pixel"


@contextmanager
def quiet() -> Iterator[None]:
    """Keep a library from writing to the terminal, by Python or past it, what its exceptions say anyway."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = os.dup(1), os.dup(2)
    with open(os.devnull, "w", encoding="utf-8") as sink:
        try:
            for number in (1, 2):
                os.dup2(sink.fileno(), number)
            with redirect_stdout(sink), redirect_stderr(sink):
                yield
        finally:
            for number, copy in zip((1, 2), saved, strict=True):
                os.dup2(copy, number)
                os.close(copy)


class DamagedError(ValueError):
    """What :func:`decoding` makes of whatever a library raises."""


@contextmanager
def decoding(what: str) -> Iterator[None]:
    """Call a library quietly: a damaged file makes it raise nearly anything, which becomes one line that begins ``what``."""
    try:
        with quiet(), warnings.catch_warnings(action="ignore"):
            yield
    except Pillow.DecompressionBombError as error:
        raise DamagedError(f"the header claims too many pixels: {error}") from error
    except MemoryError as error:
        raise DamagedError(f"{what}: it asks for more memory than there is") from error
    except Exception as error:
        said = error.args[0] if error.args else ""
        text = said.decode("utf-8", "replace") if isinstance(said, bytes) else str(error)  # LibRaw's are bytes
        line = next(iter(text.splitlines()), "") or type(error).__name__
        raise DamagedError(f"{what}: {line}") from error


def radiance_size(data: bytes) -> tuple[int, int, int, np.ndarray]:
    """(offset of the pixels, height, width, factor to divide the pixels by) from the header of a Radiance picture."""
    header, blank, rest = data.partition(b"\n\n")
    if not data.startswith(b"#?") or not blank:
        raise ValueError("the Radiance header does not end")
    factor = np.ones(3)
    for line in header.decode("latin-1").split("\n")[1:]:
        key, _, value = (part.strip() for part in line.partition("="))
        if key == "FORMAT" and value != "32-bit_rle_rgbe":
            raise ValueError(f"pixel format {value!r}, expected '32-bit_rle_rgbe'")
        if key == "GAMMA" and _factors(key, value).tolist() != [1]:
            raise ValueError(f"GAMMA={value} in the header, expected linear pixels")
        if key in ("EXPOSURE", "COLORCORR"):
            factor = factor * _factors(key, value)
    resolution, newline, _ = rest.partition(b"\n")
    match = re.fullmatch(rb"-Y (\d+) \+X (\d+)", resolution.strip())
    if not match or not newline:
        raise ValueError(f"resolution line {resolution[:40].decode('latin-1')!r}, expected '-Y height +X width'")
    return len(header) + 2 + len(resolution) + 1, int(match[1]), int(match[2]), factor


def _factors(key: str, value: str) -> np.ndarray:
    try:
        factors = np.array(value.split(), dtype=float)
    except ValueError:
        factors = np.zeros(1)
    if factors.size not in (1, 3) or not np.all((factors > 1e-9) & (factors < 1e9)):
        raise ValueError(f"{key}={value[:40]} in the header, expected a positive number, or three")
    return factors


def radiance(data: bytes) -> np.ndarray:
    """Linear float32 (height, width, 3) of a Radiance picture (Ward 1991, "Real Pixels"); its exposure is undone."""
    position, height, width, factor = radiance_size(data)
    compressed = 8 <= width < 32768 and data[position : position + 2] == b"\x02\x02"
    # A row has a mark of four bytes, then two for every 127 pixels of each channel.
    if len(data) - position < height * (4 + 8 * -(-width // 127) if compressed else 4 * width):
        raise ValueError(_TRUNCATED)
    # The format drops the fraction of the mantissa, so the middle of its interval is meant; exponent 0 is black.
    unit = np.ldexp(np.float32(1), np.arange(256) - 136)
    unit[0] = 0
    divisor = factor.astype(np.float32)
    pixels = np.empty((height, width, 3), np.float32)
    for row in pixels:
        if compressed:
            if data[position : position + 4] != b"\x02\x02" + struct.pack(">H", width):
                raise ValueError(_TRUNCATED if len(data) < position + 4 else "a row does not start where it should")
            components, position = _run_lengths(data, position + 4, width)
            codes = np.frombuffer(components, np.uint8).reshape(4, width).T
        else:
            codes = np.frombuffer(data, np.uint8, 4 * width, position).reshape(width, 4)
            position += 4 * width
        row[:] = (codes[:, :3] + np.float32(0.5)) * unit[codes[:, 3:]] / divisor
    return pixels


def _run_lengths(data: bytes, position: int, width: int) -> tuple[bytearray, int]:
    """Decode one row, component after component; and where the next one starts."""
    row = bytearray()
    for end in range(width, 4 * width + 1, width):
        while len(row) < end:
            if position + 1 >= len(data):
                raise ValueError(_TRUNCATED)
            count = data[position]
            if count > 128:
                count -= 128
                row += data[position + 1 : position + 2] * count
                position += 2
            else:
                row += data[position + 1 : position + 1 + count]
                position += 1 + count
            if position > len(data):
                raise ValueError(_TRUNCATED)
            if count == 0 or len(row) > end:
                raise ValueError("a run of pixels goes past the end of its row")
    return row, position


class Png(NamedTuple):
    """What the header of a PNG says, and its compressed rows."""

    height: int
    width: int
    bits: int
    channels: int
    """Samples per pixel, alpha included."""
    transfer: str | None
    """``"linear"``, or in words what else the file says of its transfer function; None if it says nothing."""
    exif: bytes
    """Empty if there is none."""
    rows: bytes


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}


def png_chunks(data: bytes) -> Png:
    """Take a PNG file apart (ISO/IEC 15948) without decompressing it."""
    parts: dict[bytes, list[bytes]] = {}
    position = len(_SIGNATURE)
    while b"IEND" not in parts:
        if len(data) < position + 12:
            raise ValueError(_TRUNCATED)
        (length,) = struct.unpack_from(">I", data, position)
        name, body = data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        if len(data) < position + 12 + length:
            raise ValueError(_TRUNCATED)
        if zlib.crc32(name + body) != struct.unpack_from(">I", data, position + 8 + length)[0]:
            raise ValueError(f"checksum of part {name.decode('latin-1')!r} is wrong: the file is damaged")
        parts.setdefault(name, []).append(body)
        position += 12 + length
    chunks = {name: b"".join(bodies) for name, bodies in parts.items()}
    if len(chunks.get(b"IHDR", b"")) != 13:
        raise ValueError("the PNG header is missing")
    width, height, bits, kind, _, _, interlace = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    if kind not in _CHANNELS or bits not in (8, 16):
        raise ValueError("indexed colours or fewer than 8 bits a channel, expected grey or RGB with 16 bits")
    if interlace:
        raise ValueError("interlaced PNG, expected one that is not")
    return Png(
        height, width, bits, _CHANNELS[kind], _png_transfer(chunks), chunks.get(b"eXIf", b""), chunks.get(b"IDAT", b"")
    )


def _png_transfer(chunks: dict[bytes, bytes]) -> str | None:
    # In the order of precedence of the standard's third edition. The second byte of cICP is 8 for linear.
    if b"cICP" in chunks:
        return "linear" if chunks[b"cICP"][1:2] == b"\x08" else "a non-linear transfer function (cICP)"
    if b"iCCP" in chunks:
        return "a colour profile (iCCP)"
    if b"sRGB" in chunks:
        return "sRGB"
    if b"gAMA" in chunks:
        gamma = int.from_bytes(chunks[b"gAMA"], "big") / 1e5
        return "linear" if gamma == 1 else f"gamma {gamma:g}"
    return None


_BYTES_AS: dict[int, tuple[str, ...]] = {1: ("L",), 2: ("LA",), 3: ("RGB",), 4: ("RGBA",)}
_BYTES_AS |= {6: ("RGB;16B", "RGB;16L"), 8: ("RGBA;16B", "RGBA;16L")}
"""Bytes of a pixel -> how Pillow decodes them: as so many channels of 8 bits, all at once, or the high and the low ones."""

_RATIO = 1032
"""Deflate makes at most so many bytes of one (RFC 1951: 258 of two bits)."""


def png(parts: Png) -> np.ndarray:
    """Code values (height, width, channels) of a PNG, uint8 or uint16.

    Pillow has no mode for 16 bits in several channels, but its decoder knows the layout and gives either half of them.
    """
    height, width, bits, channels = parts[:4]
    pixel = channels * bits // 8
    size = height * (1 + width * pixel)
    if size > _RATIO * len(parts.rows):
        raise ValueError(_TRUNCATED)
    try:
        halves = [
            Pillow.frombytes(layout.split(";")[0], (width, height), parts.rows, "zip", (layout, 0))
            for layout in _BYTES_AS[pixel]
        ]
    except ValueError:
        raise ValueError(_png_damage(parts.rows, size)) from None
    if len(halves) == 1:
        codes = np.asarray(halves[0]).reshape(height, width, pixel)
        return codes if bits == 8 else codes.view(">u2").astype(np.uint16)
    codes = np.asarray(halves[0]).astype(np.uint16) << 8
    codes |= np.asarray(halves[1])
    return codes


def _png_damage(rows: bytes, size: int) -> str:
    try:
        raw = zlib.decompressobj().decompress(rows, size)
    except zlib.error as error:
        return f"the compressed pixels are damaged: {error}"
    return _TRUNCATED if len(raw) < size else "the compressed pixels are damaged: unknown row filter, or no end"
