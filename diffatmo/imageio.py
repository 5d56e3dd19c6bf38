"""Reading and writing pictures, never silently non-linear.

A picture is read as linear float32 (height, width, channels), the right way up. EXR, Radiance and camera RAW are linear by
definition. PNG and TIFF with 16 bits a channel are taken as linear unless they say otherwise; eight bits, as in JPEG and HEIF,
or a file that says that it is encoded, are refused until the caller states the transfer function. Whatever is wrong with a
file ends in :class:`ImageError`, one line that names the file; one that claims more pixels than it can hold, or than are
accepted, is refused before memory is asked for.
"""

import math
import mmap
import os
import re
import stat
import uuid
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import OpenEXR
import tifffile
from jaxtyping import Float
from PIL import Image as Pillow

from diffatmo import codecs, color, exif, raw
from diffatmo.exif import Exif

TRANSFERS = ("linear", "srgb")
"""Transfer functions that a caller may state."""

MAX_PIXELS = 160_000_000
"""Pictures with more pixels than this are refused before memory is asked for; the largest sensors have 151 million."""

SUSPECT_PIXELS, SUSPECT_RATIO = 2**26, 32
"""So are those that have more than this and, in the file, less than one byte for so many pixels: decompression bombs."""

MAX_BYTES = 12 * MAX_PIXELS
"""So are those whose channels take more than this, and files that are larger."""

WAVELENGTHS = "wavelengths_nm"
"""Header attribute of an EXR with the wavelength of every channel, in the order of the array."""

Attribute = str | int | float


class ImageError(ValueError):
    """A picture cannot be read or written; the message names the file, what is wrong and what would be right."""


class EncodedError(ImageError):
    """A picture is not linear, and its transfer function is not stated."""


class _Encoded(ValueError):
    """The same before the name of the file is known."""


class Image(NamedTuple):
    """A picture as it was read."""

    pixels: Float[np.ndarray, "height width channels"]
    """Linear, float32; not-finite pixels are left as they are."""
    metadata: dict[str, Attribute]
    """Texts and numbers from the header of an EXR; empty for other formats."""
    wavelengths: tuple[float, ...] | None
    """Wavelength of every channel, nm, where the file gives it."""
    exif: Exif = Exif()
    """How it was taken; empty for EXR and Radiance. The orientation is that of ``pixels``: 1 where the file states one."""
    to_xyz: Float[np.ndarray, "3 3"] | None = None
    """From the RGB of a RAW to CIE XYZ; see :class:`diffatmo.raw.Raw`."""
    white_balance: tuple[float, float, float] | None = None
    """As-shot multipliers of a RAW; its pixels are without."""
    saturation: float | None = None
    """What a channel that is clipped has; None if unknown."""
    noise: Float[np.ndarray, "height width channels"] | None = None
    """Relative standard deviation of every value, where it is known: of merged exposures."""
    turned: int = 1
    """Exif's orientation of the stored picture, which ``pixels`` are turned by."""
    taken_as_linear: bool = False
    """Whether neither the file nor the caller says so: of integers of 16 bits."""


def read_image(path: str | Path, *, transfer: str | None = None) -> Image:
    """Read EXR, Radiance, PNG, TIFF, JPEG, HEIF or camera RAW, told apart by content.

    ``transfer`` states how pixels were encoded. HEIF needs the extra ``heif``, camera RAW the extra ``raw``. Raises
    :class:`ImageError`.
    """
    path = Path(path)
    name = str(path) if str(path).isprintable() else repr(str(path))
    if transfer not in (None, *TRANSFERS):
        raise ImageError(f"{name}: transfer = {transfer!r}, expected {' or '.join(TRANSFERS)}")
    try:
        image = _reader(path)(path, transfer)
    except OSError as error:
        raise ImageError(f"{name}: cannot be read: {error.strerror or error}") from None
    except _Encoded as error:
        raise EncodedError(f"{name}: {error}") from error
    except ValueError as error:
        raise ImageError(f"{name}: {error}") from error
    if not np.isfinite(image.pixels).any():
        raise ImageError(f"{name}: not one pixel is a finite number")
    return image


def _reader(path: Path) -> "_Reader":
    try:
        status = path.stat()
    except ValueError as error:
        raise ValueError(f"not a file name: {error}") from None
    if stat.S_ISDIR(status.st_mode):
        raise ValueError("is a folder, expected an image file")
    if not stat.S_ISREG(status.st_mode):
        raise ValueError("is not a file, expected an image file")
    if not status.st_size:
        raise ValueError("the file is empty")
    if status.st_size > MAX_BYTES:
        raise ValueError(f"the file has {status.st_size:,} bytes, more than the {MAX_BYTES:,} that are accepted")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if raw.is_raw(data):
            return _read_raw
        for (start, magic), reader in _READERS.items():
            if data[start : start + len(magic)] == magic:
                return reader
    raise ValueError("not an image of a known format, expected EXR, Radiance, PNG, TIFF, JPEG, HEIF or camera RAW")


def _check_size(path: Path, height: int, width: int, bytes_a_pixel: int = 12) -> None:
    if height < 1 or width < 1:
        raise ValueError(f"the picture has {width} x {height} pixels, expected at least one")
    if height * width > MAX_PIXELS:
        raise ValueError(f"the header claims {width} x {height} pixels, more than the {MAX_PIXELS:,} that are accepted")
    if height * width * bytes_a_pixel > MAX_BYTES:
        claim = f"{width} x {height} pixels of {bytes_a_pixel:,} bytes"
        raise ValueError(f"the header claims {claim}, more than the {MAX_BYTES:,} bytes that are accepted")
    stored = path.stat().st_size
    if height * width > max(SUSPECT_PIXELS, SUSPECT_RATIO * stored):
        raise ValueError(
            f"the header claims {width} x {height} pixels, and the file has {stored:,} bytes: not a photograph"
        )


def _linear(codes: np.ndarray, transfer: str | None, said: str | None, notes: Exif) -> Image:
    """Code values as linear light, the right way up; ``said`` is what the file itself says of its transfer function."""
    if codes.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise ValueError(f"pixels of type {codes.dtype}, expected 8 or 16 bits or floating point")
    state = 'state transfer = "srgb" or "linear"'
    if transfer is None and said not in (None, "linear"):
        raise _Encoded(f"the file says that it is encoded with {said}, not linear; {state}")
    if transfer is None and codes.dtype == np.uint8 and said is None:
        raise _Encoded(f"8 bits a channel, which is as a rule not linear; {state}")
    codes, turned = exif.upright(codes, notes.orientation), notes.orientation or 1
    notes = notes._replace(orientation=notes.orientation and 1, size=codes.shape[:2])
    if codes.dtype.kind == "f":
        return Image(_light(codes.astype(np.float32), transfer), {}, None, notes, turned=turned)
    white = np.iinfo(codes.dtype).max
    table = _light(np.arange(white + 1, dtype=np.float32) / np.float32(white), transfer)
    values = np.empty(codes.shape, np.float32)
    for row, light in zip(codes, values, strict=True):
        light[:] = table[row]
    silent = transfer is None and said is None
    return Image(values, {}, None, notes, saturation=1.0, turned=turned, taken_as_linear=silent)


def _light(values: np.ndarray, transfer: str | None) -> np.ndarray:
    return np.asarray(color.srgb_decode(jnp.asarray(values))) if transfer == "srgb" else values


def _refuse_transfer(transfer: str | None) -> None:
    if transfer not in (None, "linear"):
        raise ValueError(f"transfer = {transfer!r} contradicts the file format, which is linear by definition")


def _read_exr(path: Path, transfer: str | None) -> Image:
    _refuse_transfer(transfer)
    try:
        with codecs.quiet(), OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            header = dict(file.header())  # closing empties it
            channels = len(header["channels"])
    except (RuntimeError, ValueError, LookupError, MemoryError, TypeError):
        raise ValueError("the EXR header is damaged or cut short") from None
    (left, top), (right, bottom) = header["dataWindow"]
    _check_size(path, int(bottom) - int(top) + 1, int(right) - int(left) + 1, 4 * channels)
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise ValueError("the EXR holds a crop (data window differs from display window), expected the whole picture")
    try:
        with codecs.quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            count = len(file.parts)
            planes = {name: channel.pixels for name, channel in file.channels().items()} if count == 1 else {}
    except (RuntimeError, ValueError, LookupError, MemoryError, TypeError):
        count = 0
    file = None  # which else keeps the planes
    if count == 0:
        raise ValueError("the EXR is cut short or damaged: not all pixels can be read")
    if count > 1:
        raise ValueError(f"the EXR holds {count} pictures, expected one")
    metadata = {name: value for name, value in header.items() if isinstance(value, Attribute) and name not in _LAYOUT}
    names, wavelengths = _channels(planes, metadata.get(WAVELENGTHS))
    shapes = {planes[name].shape for name in names}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError("the EXR has channels of different sizes or deep pixels, expected flat ones of one size")
    pixels = np.empty((*next(iter(shapes)), len(names)), np.float32)
    for index, name in enumerate(names):
        pixels[..., index] = planes.pop(name)
    return Image(pixels, metadata, wavelengths)


_LAYOUT = ("pixelAspectRatio", "screenWindowWidth", "name", "view")
"""Attributes of every EXR that say nothing about the picture."""

_SPECTRAL_NAME = re.compile(r"S0\.(\d+,\d+)nm")


def _spectral_name(wavelength: float) -> str:
    # Fichet, Pacanowski & Wilkie 2021, "An OpenEXR Layout for Spectral Images", with its decimal comma.
    return f"S0.{wavelength:.6f}nm".replace(".", ",").replace("S0,", "S0.")


def _channels(planes: Mapping[str, np.ndarray], listed: Attribute | None) -> tuple[list[str], tuple[float, ...] | None]:
    """Names of the channels in the order of the array, and their wavelengths."""
    try:
        wavelengths = tuple(float(item) for item in str(listed).split()) if listed is not None else None
    except ValueError:
        raise ValueError(f"{WAVELENGTHS} = {listed!r} in the header, expected numbers") from None
    spectral = {name: float(match[1].replace(",", ".")) for name in planes if (match := _SPECTRAL_NAME.fullmatch(name))}
    if spectral:
        names = sorted(spectral, key=lambda name: spectral[name])
    elif {"R", "G", "B"} <= set(planes):
        names = ["B", "G", "R"]
    elif "Y" in planes:
        names = ["Y"]
    else:
        raise ValueError(f"channels {', '.join(sorted(planes))}, expected R, G, B or Y or S0.<wavelength>nm")
    if wavelengths is None and spectral:
        wavelengths = tuple(spectral[name] for name in names)
    elif wavelengths is None:
        names.reverse()
    elif len(wavelengths) != len(names):
        raise ValueError(f"{len(wavelengths)} wavelengths in the header for {len(names)} channels")
    else:
        # Channels were named by rising wavelength, blue first; put them back into the order of the header.
        names = [names[rank] for rank in np.argsort(np.argsort(wavelengths, kind="stable"), kind="stable")]
    return names, wavelengths


def _read_radiance(path: Path, transfer: str | None) -> Image:
    _refuse_transfer(transfer)
    data = path.read_bytes()
    _check_size(path, *codecs.radiance_size(data)[1:3])
    return Image(codecs.radiance(data), {}, None)


def _read_png(path: Path, transfer: str | None) -> Image:
    parts = codecs.png_chunks(path.read_bytes())
    _check_size(path, parts.height, parts.width)
    codes = codecs.png(parts)
    return _linear(codes[..., : 3 if parts.channels > 2 else 1], transfer, parts.transfer, exif.parse(parts.exif))


_TIFF_COMPRESSIONS = {1: 1, 5: 1400, 8: 1032, 32773: 64, 32946: 1032}
"""None, LZW, deflate, PackBits, deflate by its old number: at most so many bytes from one."""

_DEFLATE = (8, 32946)

_STRIPS_AT_MOST = 100_000


def _read_tiff(path: Path, transfer: str | None) -> Image:
    try:
        with codecs.decoding("header"), tifffile.TiffFile(path) as file:
            page = file.pages.first
            axes, height, width = page.axes, int(page.imagelength), int(page.imagewidth)
            itemsize = np.dtype(page.dtype).itemsize
            size = math.prod(page.shape) * itemsize
            compression, profile = int(page.compression), "InterColorProfile" in page.tags
            parts = list(zip(page.dataoffsets, page.databytecounts, strict=True))
            expected = math.prod(page.chunks) * itemsize
    except codecs.DamagedError:
        raise ValueError("the TIFF header is damaged or cut short") from None
    _check_size(path, height, width, -(-size // max(1, height * width)))
    if axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"the TIFF has the axes {axes}, expected one picture")
    if compression not in _TIFF_COMPRESSIONS:
        raise ValueError(f"the TIFF has the compression {compression}, expected none, deflate, LZW or PackBits")
    _check_strips(path, parts, size, _TIFF_COMPRESSIONS[compression], expected if compression in _DEFLATE else None)
    with codecs.decoding("the TIFF cannot be decoded"), tifffile.TiffFile(path) as file:
        codes = np.asarray(file.pages.first.asarray(maxworkers=1))
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        notes = exif.parse(data)
    codes = np.atleast_3d(np.moveaxis(codes, 0, -1) if axes == "SYX" else codes)
    return _linear(
        codes[..., : 3 if codes.shape[-1] > 2 else 1], transfer, "a colour profile" if profile else None, notes
    )


def _check_strips(path: Path, parts: list[tuple[int, int]], size: int, ratio: int, deflated: int | None) -> None:
    """Refuse strips (or tiles) that cannot hold ``size`` bytes of pixels, or that inflate to more than ``deflated`` each."""
    stored = sum(count for _, count in parts)
    if len(parts) > _STRIPS_AT_MOST:
        raise ValueError(
            f"the TIFF has {len(parts):,} strips or tiles, more than the {_STRIPS_AT_MOST:,} that are accepted"
        )
    if any(start + count > path.stat().st_size for start, count in parts) or stored * ratio < size:
        raise ValueError("the TIFF cannot be decoded: its strips are not as long as its pixels, or go beyond the file")
    if deflated is None:
        return
    with path.open("rb") as file:
        for start, count in parts:
            file.seek(start)
            try:
                inflated = zlib.decompressobj().decompress(file.read(count), deflated + 1)
            except zlib.error as error:
                raise ValueError(f"the TIFF cannot be decoded: {error}") from None
            if len(inflated) > deflated:
                raise ValueError("the TIFF cannot be decoded: a strip holds more than its pixels")


_JPEG_RATIO = 512
"""Pixels in a byte at most: a block of 64 takes one bit or more, of its mean alone."""

_SCANS_AT_MOST = 20 * MAX_PIXELS
"""Pixels times passes over the picture of a progressive JPEG; cameras make about ten passes."""


def _read_jpeg(path: Path, transfer: str | None) -> Image:
    with codecs.decoding("the JPEG is damaged"), Pillow.open(path, formats=("JPEG",)) as file:
        height, width, block = file.height, file.width, file.info.get("exif", b"")
    _check_size(path, height, width)
    data = path.read_bytes()
    if height * width > _JPEG_RATIO * len(data):
        raise ValueError("the JPEG is damaged: the file ends before the last pixel")
    scans = data.count(b"\xff\xda")
    if height * width * scans > _SCANS_AT_MOST and scans > 1:
        raise ValueError(f"the JPEG has {scans} scans of {width} x {height} pixels, which takes too long")
    with codecs.decoding("the JPEG is damaged"), Pillow.open(path, formats=("JPEG",)) as file:
        codes = np.asarray(file if file.mode == "RGB" else file.convert("RGB"))
    return _linear(codes, transfer, None, exif.parse(block))


def _read_heif(path: Path, transfer: str | None) -> Image:
    try:
        import pillow_heif
    except ImportError:
        raise ValueError("HEIF needs pillow-heif: pip install 'diffatmo[heif]'") from None
    with codecs.decoding("the HEIF is damaged"):
        file = pillow_heif.open_heif(path)
        (width, height), block = file.size, file.info.get("exif") or b""
    _check_size(path, height, width)
    with codecs.decoding("the HEIF is damaged"):
        codes = np.atleast_3d(np.asarray(file))
        width = file.size[0]
    codes = codes[:, :width, : 3 if codes.shape[-1] > 2 else 1]
    # HEIF turns its pictures itself; the orientation in the Exif block is a copy of that, and not to be followed again.
    notes = exif.parse(block)
    return _linear(codes, transfer, None, notes._replace(orientation=1))._replace(turned=notes.orientation or 1)


def _read_raw(path: Path, transfer: str | None) -> Image:
    _refuse_transfer(transfer)
    picture = raw.read(path, MAX_PIXELS)
    return Image(
        picture.pixels, {}, None, picture.exif, picture.to_xyz, picture.white_balance, 1.0, turned=picture.turned
    )


_Reader = Callable[[Path, str | None], Image]

_READERS: dict[tuple[int, bytes], _Reader] = {
    (0, b"\x76\x2f\x31\x01"): _read_exr,
    (0, b"#?"): _read_radiance,
    (0, b"\x89PNG\r\n\x1a\n"): _read_png,
    (0, b"II*\0"): _read_tiff,
    (0, b"MM\0*"): _read_tiff,
    (0, b"\xff\xd8\xff"): _read_jpeg,
    (4, b"ftyp"): _read_heif,
}
"""Where a file has which bytes -> its reader."""


@contextmanager
def atomic_write(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its place when the block ends well, and vanishes when it does not."""
    path = Path(path)
    if path.exists() and not overwrite:
        raise ImageError(f"{path}: exists already and is not overwritten unless asked")
    if not path.parent.is_dir():
        raise ImageError(f"{path}: there is no folder {path.parent}")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ImageError(f"{path}: cannot be written: {reason}") from None
    finally:
        temporary.unlink(missing_ok=True)


def write_exr(
    path: str | Path,
    pixels: Float[np.ndarray, "height width channels"],
    metadata: Mapping[str, Attribute] | None = None,
    *,
    wavelengths: Sequence[float] | np.ndarray | None = None,
    half: bool = False,
    overwrite: bool = False,
) -> None:
    """Write linear pixels as EXR of 32 bits a channel, or 16 (``half``), with texts and numbers in the header.

    One channel is written as Y, three as R, G, B (with ``wavelengths``: red is the longest), four without wavelengths as
    R, G, B, A, any other number under the names of the spectral layout of Fichet et al. 2021. :func:`read_image` gives the
    same array back, in the same order, but for the fourth of R, G, B, A. Numbers in the header have single precision; what
    must be exact goes in as text.
    """
    planes = np.asarray(pixels, dtype=np.float32)
    if planes.ndim != 3 or 0 in planes.shape:
        raise ImageError(f"{path}: pixels of shape {planes.shape}, expected (height, width, channels)")
    count = planes.shape[-1]
    if wavelengths is not None and len(wavelengths) != count:
        raise ImageError(f"{path}: {len(wavelengths)} wavelengths for {count} channels")
    if wavelengths is None and count not in (1, 3, 4):
        raise ImageError(f"{path}: {count} channels without wavelengths, expected 1, 3 or 4, or their wavelengths")
    header: dict[str, object] = dict(metadata or {})
    names = ["Y"] if count == 1 else ["R", "G", "B", "A"][:count]
    if wavelengths is not None:
        texts = [str(item) for item in np.asarray(wavelengths)]
        header[WAVELENGTHS] = " ".join(texts)
        if count == 3:
            names = [names[rank] for rank in np.argsort(np.argsort([-float(text) for text in texts]))]
        elif count > 1:
            names = [_spectral_name(float(text)) for text in texts]
    header |= {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stored = planes.astype(np.float16) if half else planes
    channels = {name: np.ascontiguousarray(stored[..., i]) for i, name in enumerate(names)}
    if len(channels) != count:
        raise ImageError(f"{path}: two channels have the same wavelength")
    with atomic_write(path, overwrite=overwrite) as temporary, codecs.quiet():
        OpenEXR.File(header, channels).write(str(temporary))


def write_png(path: str | Path, rgb: Float[np.ndarray, "height width 3"], *, overwrite: bool = False) -> None:
    """Write code values in [0, 1], as :func:`diffatmo.color.display` gives them, as 8-bit PNG; NaN becomes black."""
    codes = np.nan_to_num(np.asarray(rgb, dtype=np.float32), nan=0.0)
    if codes.ndim != 3 or codes.shape[-1] != 3 or 0 in codes.shape:
        raise ImageError(f"{path}: pixels of shape {codes.shape}, expected (height, width, 3)")
    with atomic_write(path, overwrite=overwrite) as temporary:
        Pillow.fromarray(np.round(255 * np.clip(codes, 0, 1)).astype(np.uint8)).save(temporary, format="PNG")
