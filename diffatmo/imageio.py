"""Reading and writing pictures, never silently non-linear.

A picture is read as linear float32 (height, width, channels). EXR and Radiance files are linear by definition. PNG and
TIFF with 16 bits a channel are taken as linear unless they say otherwise; eight bits, or a file that says that it is
encoded, are refused until the caller states the transfer function. Whatever is wrong with a file ends in
:class:`ImageError`, one line that names the file.
"""

import os
import re
import struct
import sys
import uuid
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import OpenEXR
import tifffile
from jaxtyping import Float
from PIL import Image as Pillow

from diffatmo import codecs, color

TRANSFERS = ("linear", "srgb")
"""Transfer functions that a caller may state."""

MAX_PIXELS = 200_000_000
"""Pictures with more pixels than this are refused before memory is asked for."""

WAVELENGTHS = "wavelengths_nm"
"""Header attribute of an EXR with the wavelength of every channel, in the order of the array."""

Attribute = str | int | float


class ImageError(ValueError):
    """A picture cannot be read or written; the message names the file, what is wrong and what would be right."""


class Image(NamedTuple):
    """A picture as it was read."""

    pixels: Float[np.ndarray, "height width channels"]
    """Linear, float32; not-finite pixels are left as they are."""
    metadata: dict[str, Attribute]
    """Texts and numbers from the header of an EXR; empty for other formats."""
    wavelengths: tuple[float, ...] | None
    """Wavelength of every channel, nm, where the file gives it."""


def read_image(path: str | Path, *, transfer: str | None = None) -> Image:
    """Read EXR, Radiance, PNG, TIFF or JPEG, told apart by content; ``transfer`` states how pixels were encoded."""
    path = Path(path)
    if transfer not in (None, *TRANSFERS):
        raise ImageError(f"{path}: transfer = {transfer!r}, expected {' or '.join(TRANSFERS)}")
    try:
        data = path.read_bytes()
    except IsADirectoryError:
        raise ImageError(f"{path}: is a folder, expected an image file") from None
    except OSError as error:
        raise ImageError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ImageError(f"{str(path)!r}: not a file name: {error}") from None
    if not data:
        raise ImageError(f"{path}: the file is empty")
    decode = next((reader for magic, reader in _READERS.items() if data.startswith(magic)), None)
    if decode is None:
        raise ImageError(f"{path}: not an image of a known format, expected EXR, Radiance, PNG, TIFF or JPEG")
    try:
        image = decode(path, data, transfer)
    except ImageError:
        raise
    except ValueError as error:
        raise ImageError(f"{path}: {error}") from error
    if not np.isfinite(image.pixels).any():
        raise ImageError(f"{path}: not one pixel is a finite number")
    return image


def _check_size(height: int, width: int) -> None:
    if height < 1 or width < 1:
        raise ValueError(f"the picture has {width} x {height} pixels, expected at least one")
    if height * width > MAX_PIXELS:
        raise ValueError(f"the header claims {width} x {height} pixels, more than the {MAX_PIXELS:,} that are accepted")


def _linear(codes: np.ndarray, transfer: str | None, said: str | None) -> Image:
    """Code values as linear light; ``said`` is what the file itself says of its transfer function."""
    if codes.dtype not in (np.uint8, np.uint16, np.float16, np.float32, np.float64):
        raise ValueError(f"pixels of type {codes.dtype}, expected 8 or 16 bits or floating point")
    state = 'state transfer = "srgb" or "linear"'
    if transfer is None and said not in (None, "linear"):
        raise ValueError(f"the file says that it is encoded with {said}, not linear; {state}")
    if transfer is None and codes.dtype == np.uint8 and said is None:
        raise ValueError(f"8 bits a channel, which is as a rule not linear; {state}")
    white = 1 if codes.dtype.kind == "f" else np.iinfo(codes.dtype).max
    values = codes.astype(np.float32) / np.float32(white)
    if transfer == "srgb":
        values = np.asarray(color.srgb_decode(jnp.asarray(values)))
    return Image(np.atleast_3d(values), {}, None)


def _refuse_transfer(transfer: str | None) -> None:
    if transfer not in (None, "linear"):
        raise ValueError(f"transfer = {transfer!r} contradicts the file format, which is linear by definition")


@contextmanager
def _quiet() -> Iterator[None]:
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


def _read_exr(path: Path, _: bytes, transfer: str | None) -> Image:
    _refuse_transfer(transfer)
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            header = dict(file.header())  # closing empties it
    except (RuntimeError, ValueError):
        raise ValueError("the EXR header is damaged or cut short") from None
    (left, top), (right, bottom) = header["dataWindow"]
    _check_size(int(bottom) - int(top) + 1, int(right) - int(left) + 1)
    if not np.array_equal(header["dataWindow"], header["displayWindow"]):
        raise ValueError("the EXR holds a crop (data window differs from display window), expected the whole picture")
    try:
        with _quiet(), OpenEXR.File(str(path), separate_channels=True) as file:
            count = len(file.parts)
            planes = {name: channel.pixels for name, channel in file.channels().items()} if count == 1 else {}
    except (RuntimeError, ValueError, MemoryError):
        count = 0
    if count == 0:
        raise ValueError("the EXR is cut short or damaged: not all pixels can be read")
    if count > 1:
        raise ValueError(f"the EXR holds {count} pictures, expected one")
    metadata = {name: value for name, value in header.items() if isinstance(value, Attribute) and name not in _LAYOUT}
    names, wavelengths = _channels(planes, metadata.get(WAVELENGTHS))
    shapes = {planes[name].shape for name in names}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise ValueError("the EXR has channels of different sizes or deep pixels, expected flat ones of one size")
    return Image(np.stack([planes[name] for name in names], axis=-1).astype(np.float32), metadata, wavelengths)


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


def _read_radiance(_: Path, data: bytes, transfer: str | None) -> Image:
    _refuse_transfer(transfer)
    _check_size(*codecs.radiance_size(data)[1:3])
    return Image(codecs.radiance(data), {}, None)


def _read_png(_: Path, data: bytes, transfer: str | None) -> Image:
    parts = codecs.png_chunks(data)
    _check_size(parts.height, parts.width)
    codes = codecs.png(parts)
    return _linear(codes[..., : 3 if parts.channels > 2 else 1], transfer, parts.transfer)


_BAD_TIFF = (tifffile.TiffFileError, RuntimeError, LookupError, OSError, struct.error, ValueError)


def _read_tiff(path: Path, _: bytes, transfer: str | None) -> Image:
    try:
        with _quiet(), tifffile.TiffFile(path) as file:
            page = file.pages.first
            size, axes, profile = (page.imagelength, page.imagewidth), page.axes, "InterColorProfile" in page.tags
    except _BAD_TIFF:
        raise ValueError("the TIFF header is damaged or cut short") from None
    _check_size(*size)
    try:
        with _quiet():
            codes: np.ndarray = tifffile.imread(path, key=0)
    except _BAD_TIFF as error:
        raise ValueError(f"the TIFF cannot be decoded: {str(error).splitlines()[0]}") from None
    codes = np.moveaxis(codes, 0, -1) if axes == "SYX" else codes
    if axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"the TIFF has the axes {axes}, expected one picture")
    codes = np.atleast_3d(codes)
    return _linear(codes[..., : 3 if codes.shape[-1] > 2 else 1], transfer, "a colour profile" if profile else None)


def _read_jpeg(path: Path, _: bytes, transfer: str | None) -> Image:
    try:
        with warnings.catch_warnings(action="ignore"), Pillow.open(path) as file:
            _check_size(file.height, file.width)
            codes = np.asarray(file.convert("RGB"))
    except (OSError, SyntaxError, Pillow.DecompressionBombError) as error:
        raise ValueError(f"the JPEG is damaged: {error}") from error
    return _linear(codes, transfer, None)


_READERS = {
    b"\x76\x2f\x31\x01": _read_exr,
    b"#?": _read_radiance,
    b"\x89PNG\r\n\x1a\n": _read_png,
    b"II*\0": _read_tiff,
    b"MM\0*": _read_tiff,
    b"\xff\xd8\xff": _read_jpeg,
}
"""First bytes of a file -> its reader."""


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
    with atomic_write(path, overwrite=overwrite) as temporary, _quiet():
        OpenEXR.File(header, channels).write(str(temporary))


def write_png(path: str | Path, rgb: Float[np.ndarray, "height width 3"], *, overwrite: bool = False) -> None:
    """Write code values in [0, 1], as :func:`diffatmo.color.display` gives them, as 8-bit PNG; NaN becomes black."""
    codes = np.nan_to_num(np.asarray(rgb, dtype=np.float32), nan=0.0)
    if codes.ndim != 3 or codes.shape[-1] != 3 or 0 in codes.shape:
        raise ImageError(f"{path}: pixels of shape {codes.shape}, expected (height, width, 3)")
    with atomic_write(path, overwrite=overwrite) as temporary:
        Pillow.fromarray(np.round(255 * np.clip(codes, 0, 1)).astype(np.uint8)).save(temporary, format="PNG")
