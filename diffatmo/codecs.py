"""Decoders for two formats that no library at hand reads in full: Radiance pictures and PNG with 16 bits a channel.

Both take the bytes of a file and raise ``ValueError`` with one line on what is wrong with them.
"""

import re
import struct
import zlib
from typing import NamedTuple

import numpy as np

_TRUNCATED = "the file ends before the last pixel"


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
        if key == "GAMMA" and float(value) != 1:
            raise ValueError(f"GAMMA={value} in the header, expected linear pixels")
        if key in ("EXPOSURE", "COLORCORR"):
            factor = factor * np.array(value.split(), dtype=float)
    resolution, newline, _ = rest.partition(b"\n")
    match = re.fullmatch(rb"-Y (\d+) \+X (\d+)", resolution.strip())
    if not match or not newline:
        raise ValueError(f"resolution line {resolution[:40].decode('latin-1')!r}, expected '-Y height +X width'")
    return len(header) + 2 + len(resolution) + 1, int(match[1]), int(match[2]), factor


def radiance(data: bytes) -> np.ndarray:
    """Linear float32 (height, width, 3) of a Radiance picture (Ward 1991, "Real Pixels"); its exposure is undone."""
    start, height, width, factor = radiance_size(data)
    pixels = np.empty((height, width, 4), np.uint8)
    position = start
    if 8 <= width < 32768 and data[start : start + 2] == b"\x02\x02":
        for row in pixels:
            if data[position : position + 4] != b"\x02\x02" + struct.pack(">H", width):
                raise ValueError(_TRUNCATED if len(data) < position + 4 else "a row does not start where it should")
            position = _run_lengths(data, position + 4, row)
    else:
        if len(data) < start + pixels.size:
            raise ValueError(_TRUNCATED)
        pixels[:] = np.frombuffer(data, np.uint8, pixels.size, start).reshape(pixels.shape)
    mantissa, exponent = pixels[..., :3].astype(np.float32), pixels[..., 3:].astype(np.int32)
    # The format drops the fraction of the mantissa, so the middle of its interval is meant; exponent 0 is black.
    return np.where(exponent > 0, np.ldexp(mantissa + 0.5, exponent - 136), 0) / factor.astype(np.float32)


def _run_lengths(data: bytes, position: int, row: np.ndarray) -> int:
    """Decode one row, component after component, and return where the next one starts."""
    width = len(row)
    for channel in range(4):
        x = 0
        while x < width:
            if position + 1 >= len(data):
                raise ValueError(_TRUNCATED)
            count = data[position]
            repeat = count > 128
            count -= 128 if repeat else 0
            if count == 0 or x + count > width:
                raise ValueError("a run of pixels goes past the end of its row")
            if repeat:
                row[x : x + count, channel] = data[position + 1]
                position += 2
            else:
                values = np.frombuffer(data[position + 1 : position + 1 + count], np.uint8)
                if values.size < count:
                    raise ValueError(_TRUNCATED)
                row[x : x + count, channel] = values
                position += 1 + count
            x += count
    return position


class Png(NamedTuple):
    """What the header of a PNG says, and its compressed rows."""

    height: int
    width: int
    bits: int
    channels: int
    """Samples per pixel, alpha included."""
    transfer: str | None
    """``"linear"``, or in words what else the file says of its transfer function; None if it says nothing."""
    rows: bytes


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}


def png_chunks(data: bytes) -> Png:
    """Take a PNG file apart (ISO/IEC 15948) without decompressing it."""
    chunks: dict[bytes, bytes] = {}
    position = len(_SIGNATURE)
    while b"IEND" not in chunks:
        if len(data) < position + 12:
            raise ValueError(_TRUNCATED)
        (length,) = struct.unpack_from(">I", data, position)
        name, body = data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        if len(data) < position + 12 + length:
            raise ValueError(_TRUNCATED)
        if zlib.crc32(name + body) != struct.unpack_from(">I", data, position + 8 + length)[0]:
            raise ValueError(f"checksum of part {name.decode('latin-1')!r} is wrong: the file is damaged")
        chunks[name] = chunks.get(name, b"") + body
        position += 12 + length
    if len(chunks.get(b"IHDR", b"")) != 13:
        raise ValueError("the PNG header is missing")
    width, height, bits, kind, _, _, interlace = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    if kind not in _CHANNELS or bits not in (8, 16):
        raise ValueError("indexed colours or fewer than 8 bits a channel, expected grey or RGB with 16 bits")
    if interlace:
        raise ValueError("interlaced PNG, expected one that is not")
    return Png(height, width, bits, _CHANNELS[kind], _png_transfer(chunks), chunks.get(b"IDAT", b""))


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


def png(parts: Png) -> np.ndarray:
    """Code values (height, width, channels) of a PNG, uint8 or uint16."""
    height, width, bits, channels = parts[:4]
    pixel = channels * bits // 8
    size = height * (1 + width * pixel)
    try:
        raw = zlib.decompressobj().decompress(parts.rows, size)
    except zlib.error as error:
        raise ValueError(f"the compressed pixels are damaged: {error}") from error
    if len(raw) < size:
        raise ValueError(_TRUNCATED)
    rows = np.frombuffer(raw, np.uint8).reshape(height, 1 + width * pixel)
    if rows[:, 0].max() > 4:
        raise ValueError("the compressed pixels are damaged: unknown row filter")
    samples = _unfilter(rows[:, 0], rows[:, 1:].reshape(height, width, pixel))
    return samples if bits == 8 else samples.reshape(height, width, channels, 2).view(">u2")[..., 0].astype(np.uint16)


def _unfilter(filters: np.ndarray, filtered: np.ndarray) -> np.ndarray:
    """Undo PNG's prediction of every byte from its neighbours to the left (a), above (b) and above left (c).

    Pixels on one anti-diagonal depend on earlier ones only, so that each diagonal is one vector operation.
    """
    height, width, pixel = filtered.shape
    out = np.zeros((height + 1, width + 1, pixel), np.int16)
    for diagonal in range(height + width - 1):
        y = np.arange(max(0, diagonal - width + 1), min(height, diagonal + 1))
        x = diagonal - y
        a, b, c = out[y + 1, x], out[y, x + 1], out[y, x]
        pa, pb, pc = abs(b - c), abs(a - c), abs(a + b - 2 * c)
        paeth = np.where((pa <= pb) & (pa <= pc), a, np.where(pb <= pc, b, c))
        predicted = np.choose(filters[y, None], (0 * a, a, b, (a + b) // 2, paeth))
        out[y + 1, x + 1] = (filtered[y, x] + predicted) & 0xFF
    return np.ascontiguousarray(out[1:, 1:]).astype(np.uint8)
