"""Measured spectra of the sky: an instrument that looks one way after another.

A file of a scan is NumPy's ``.npz`` with the arrays

===================  ===================  ====================================================
``wavelength_nm``    (channels)           means over bands about these
``radiance``         (samples, channels)  W m^-2 sr^-1 nm^-1
``view_zenith_deg``  (samples)
``view_azimuth_deg`` (samples)            clockwise from north
``sun_zenith_deg``   (samples), or one    where the sun was
``sun_azimuth_deg``  (samples), or one
===================  ===================  ====================================================

and, if there are, ``valid`` (samples), ``solar_irradiance`` (channels) at the time, or ``earth_sun_au`` and, instead of a
standard spectrum of the sun, ``solar_irradiance_1au``; ``grass_albedo`` or ``ground_albedo`` with its wavelengths,
``fov_deg``; or a CSV with a row for each sample: columns of the same names as far as they have a number for each sample, and
``radiance_<nm>`` for every channel.
"""

import csv
import io
import lzma
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import spectrum
from diffatmo._types import Direction, Scalar
from diffatmo.camera import Camera, CameraError

FOV_DEG = 1.0
"""Of an instrument that does not say."""

MOST = 20_000_000
"""Numbers in a file at most."""


_DAMAGE = (
    *(ValueError, TypeError, OSError, EOFError, KeyError, RuntimeError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, tokenize.TokenError),
)
"""What NumPy and the libraries under it raise for a damaged archive; encrypted ones are a RuntimeError, and arrays that only
claim to be large a MemoryError."""


class ScanError(ValueError):
    """A scan that cannot be read; the message names the file and what is wrong."""


def _array(value: float | np.ndarray) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


class Scan(Camera):
    """A camera whose picture is one row of pixels, each looking its own way; ``yaw`` turns all of them clockwise.

    ``fov`` is the diameter, rad, of what a pixel sees. Between pixels there is nothing: points are those of the nearest.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    zenith: Float[Array, " n"]
    azimuth: Float[Array, " n"]
    fov: Scalar
    yaw: Scalar
    pitch: Scalar
    roll: Scalar

    def __init__(
        self,
        zenith: Float[np.ndarray, " n"],
        azimuth: Float[np.ndarray, " n"],
        *,
        fov: float = math.radians(FOV_DEG),
        yaw: float = 0.0,
        pitch: float = 0.0,
        roll: float = 0.0,
        height: int = 1,
        width: int | None = None,
    ) -> None:
        self.zenith, self.azimuth, self.fov = (_array(value) for value in (zenith, azimuth, fov))
        self.yaw, self.pitch, self.roll = (_array(value) for value in (yaw, pitch, roll))
        self.height, self.width = height, self.zenith.size if width is None else width
        if (self.height, self.width) != (1, self.azimuth.size) or self.zenith.shape != self.azimuth.shape:
            raise CameraError(
                f"a scan of {self.zenith.shape} zenith angles and {self.azimuth.shape} azimuths, expected as many"
            )

    @property
    def pixel_angle(self) -> float | Scalar:
        """The field of view."""
        return self.fov

    def zoomed(self, factor: float | Scalar) -> "Scan":
        """See :class:`Camera`."""
        raise CameraError("a scan has no focal length, expected a fisheye's or a pinhole camera's")

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        index = jnp.clip(jnp.round(x).astype(int), 0, self.width - 1)
        zenith, azimuth = self.zenith[index], self.azimuth[index]
        sine = jnp.sin(zenith)
        return jnp.stack([sine * jnp.sin(azimuth), sine * jnp.cos(azimuth), jnp.cos(zenith)], axis=-1)

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        own = self._rays(jnp.arange(self.width), jnp.zeros(self.width))
        cosine = jnp.matmul(rays, own.T, precision="highest")
        nearest = jnp.argmax(cosine, axis=-1)
        seen = jnp.max(cosine, axis=-1) >= jnp.cos(self.fov / 2)
        x = jnp.where(seen, nearest, -2).astype(rays.dtype)
        return x, jnp.zeros_like(x)

    def _solid_angles(self) -> Float[Array, "height width"]:
        return jnp.broadcast_to(2 * np.pi * (1 - jnp.cos(self.fov / 2)), (1, self.width))


class Spectra(NamedTuple):
    """A scan as it was read; samples that are not valid are left out."""

    wavelengths: Float[np.ndarray, " channel"]
    """nm."""
    radiance: Float[np.ndarray, "sample channel"]
    """W m^-2 sr^-1 nm^-1."""
    view_zenith: Float[np.ndarray, " sample"]
    """rad, as are all angles; azimuths are clockwise from north."""
    view_azimuth: Float[np.ndarray, " sample"]
    sun_zenith: Float[np.ndarray, " sample"]
    sun_azimuth: Float[np.ndarray, " sample"]
    irradiance: Float[np.ndarray, " channel"]
    """Of the sun above the atmosphere at the time, W m^-2 nm^-1."""
    own_sun: bool
    """Whether the file says that irradiance, or it is that of the standard spectrum."""
    albedo: Float[np.ndarray, "2 n"] | None
    """Wavelengths of the ground's albedo, nm, and the albedo."""
    fov: float
    """Diameter of what a sample sees, rad."""


def read(path: str | Path) -> Spectra:
    """Read a scan; raises :class:`ScanError` for what cannot be one."""
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ScanError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        columns = _of_npz(data) if data.startswith(b"PK") else _of_csv(data)
        return _checked(columns)
    except ScanError as error:
        raise ScanError(f"{path}: {error}") from None


def _of_npz(data: bytes) -> dict[str, np.ndarray]:
    try:
        archive = np.load(io.BytesIO(data), allow_pickle=False)
        size = sum(info.file_size for info in archive.zip.infolist())
        if size > 8 * MOST:
            raise ScanError(f"holds {size:,} bytes, more than the {8 * MOST:,} that are accepted")
        return {name: np.asarray(archive[name]) for name in archive}
    except ScanError:
        raise
    except _DAMAGE:
        raise ScanError("not an .npz of plain arrays, or one that is damaged") from None


def _of_csv(data: bytes) -> dict[str, np.ndarray]:
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise ScanError(f"not a CSV file: {error}") from None
    rows = [row for row in rows if row and not row[0].startswith("#")]
    if len(rows) < 2:
        raise ScanError("expected a row of names and a row for every sample")
    names, body = [name.strip() for name in rows[0]], rows[1:]
    if len(set(names)) != len(names):
        raise ScanError("two columns have the same name")
    columns: dict[str, np.ndarray] = {}
    for number, name in enumerate(names):
        try:
            columns[name] = np.array([float(row[number]) for row in body])
        except (ValueError, IndexError):
            raise ScanError(f"column {name}: expected a number in every row") from None
    bands = [name for name in names if name.startswith("radiance_")]
    try:
        columns["wavelength_nm"] = np.array([float(name.removeprefix("radiance_")) for name in bands])
    except ValueError:
        raise ScanError(f"columns {', '.join(bands)}: expected radiance_<wavelength in nm>") from None
    if bands:
        columns["radiance"] = np.stack([columns[name] for name in bands], axis=-1)
    return columns


def _checked(columns: Mapping[str, np.ndarray]) -> Spectra:
    needed = ("wavelength_nm", "radiance", "view_zenith_deg", "view_azimuth_deg", "sun_zenith_deg", "sun_azimuth_deg")
    for name in needed:
        if name not in columns or columns[name].size == 0:
            raise ScanError(f"{name} is missing, expected {', '.join(needed)}")
    try:
        numbers = {name: value.astype(float, casting="same_kind") for name, value in columns.items()}
    except TypeError:
        raise ScanError("expected arrays of numbers") from None
    wavelengths, radiance = numbers["wavelength_nm"], numbers["radiance"]
    lower, upper = spectrum.WAVELENGTH_RANGE
    if wavelengths.ndim != 1 or radiance.ndim != 2 or radiance.shape[1] != wavelengths.size:
        raise ScanError(
            f"radiance: got shape {radiance.shape} for {wavelengths.size} wavelengths, expected (samples, wavelengths)"
        )
    if not np.all(np.isfinite(wavelengths)) or np.any(np.diff(wavelengths) <= 0):
        raise ScanError("wavelength_nm: expected finite numbers that rise")
    samples = len(radiance)
    angles: dict[str, np.ndarray] = {}
    for name in needed[2:]:
        limit = 180.0 if "zenith" in name else 720.0
        value = numbers[name].ravel()
        if value.size not in (1, samples):
            raise ScanError(f"{name}: got shape {numbers[name].shape}, expected one for each of {samples} samples")
        lowest = 0.0 if "zenith" in name else -limit
        if not np.all(np.isfinite(value)) or np.any((value < lowest) | (value > limit)):
            raise ScanError(f"{name}: expected finite angles from {lowest:g} to {limit:g}")
        angles[name] = np.radians(np.broadcast_to(value, samples))
    flags = numbers.get("valid", np.ones(samples))
    if flags.shape != (samples,):
        raise ScanError(f"valid: got shape {flags.shape}, expected one for each of {samples} samples")
    if not np.isin(flags, (0, 1)).all():
        raise ScanError("valid: expected 0 or 1 for each sample")
    valid: Bool[np.ndarray, " sample"] = flags > 0
    known = (wavelengths >= lower) & (wavelengths <= upper)
    if not valid.any() or not known.any():
        raise ScanError(f"no valid sample, or no wavelength from {lower:g} to {upper:g} nm")
    irradiance = _irradiance(numbers, wavelengths, known)
    fov = _single(numbers, "fov_deg", FOV_DEG)
    if not 0 < fov <= 30:
        raise ScanError(f"fov_deg: got {fov:g}, expected more than 0 and at most 30")
    return Spectra(
        wavelengths[known],
        radiance[np.ix_(valid, known)],
        angles["view_zenith_deg"][valid],
        angles["view_azimuth_deg"][valid],
        angles["sun_zenith_deg"][valid],
        angles["sun_azimuth_deg"][valid],
        irradiance[known],
        any(name in numbers for name in ("solar_irradiance", "solar_irradiance_1au")),
        _albedo(numbers),
        math.radians(fov),
    )


def _single(numbers: Mapping[str, np.ndarray], name: str, default: float) -> float:
    """A number of the whole scan, which may be there for each sample."""
    given = np.unique(numbers.get(name, np.array(default)))
    if given.size != 1:
        raise ScanError(f"{name}: expected one number")
    return float(given[0])


def _irradiance(
    numbers: Mapping[str, np.ndarray], wavelengths: np.ndarray, known: Bool[np.ndarray, " channel"]
) -> Float[np.ndarray, " channel"]:
    distance = _single(numbers, "earth_sun_au", 1.0)
    if not 0.5 < distance < 2:
        raise ScanError(f"earth_sun_au: got {distance:g}, expected about 1")
    if "solar_irradiance" in numbers:
        value = numbers["solar_irradiance"]
    elif "solar_irradiance_1au" in numbers:
        value = numbers["solar_irradiance_1au"] / distance**2
    else:
        value = np.full(wavelengths.shape, np.nan)
        value[known] = np.asarray(spectrum.solar_irradiance(wavelengths[known])) / distance**2
    if value.shape != wavelengths.shape or not np.all(value[known] > 0) or not np.all(np.isfinite(value[known])):
        raise ScanError("solar_irradiance: expected a positive number for each wavelength")
    return value


def _albedo(numbers: Mapping[str, np.ndarray]) -> Float[np.ndarray, "2 n"] | None:
    for name in ("ground_albedo", "grass_albedo"):
        if name in numbers:
            at = numbers.get(f"{name}_wavelength_nm", numbers["wavelength_nm"])
            value = numbers[name]
            rises = np.all(np.isfinite(at)) and np.all(np.diff(at) > 0)
            if at.shape != value.shape or at.ndim != 1 or not rises:
                raise ScanError(f"{name}: expected a number for each of its wavelengths, which rise")
            if not np.all((value >= 0) & (value <= 1)):
                raise ScanError(f"{name}: expected numbers from 0 to 1")
            return np.stack([at, value])
    return None
