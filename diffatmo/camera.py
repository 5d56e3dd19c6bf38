"""Cameras: which direction does a pixel look in, and where in the picture is a direction.

A point of the picture is (x, y) = (column, row), whole numbers at pixel centres, row 0 at the top. In the camera's own
frame X points right, Y forward along the optical axis and Z up; the pose turns it into the local frame (x east, y
north, z up): ``yaw`` is the azimuth of the optical axis clockwise from north, ``pitch`` its elevation, ``roll`` a
clockwise turn of the camera about it, in radians. The rotation is made of sines and cosines only, so that its
derivative exists everywhere, also for a camera that looks straight up. Sizes are static; every angle may be
differentiated.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo._types import Direction, Scalar
from diffatmo.numerics import safe_divide, safe_norm


class CameraError(ValueError):
    """A camera's size or angle is out of range; the message says what would be right."""


def _array(value: Any) -> Array:
    return jnp.asarray(value, dtype=jnp.result_type(float))


def _turn(matrix: Float[Array, "3 3"], vectors: Direction) -> Direction:
    # Written out: accelerators may run a matrix product in reduced precision, and a direction must not be.
    return matrix[:, 0] * vectors[..., :1] + matrix[:, 1] * vectors[..., 1:2] + matrix[:, 2] * vectors[..., 2:]


class Camera(eqx.Module):
    """A picture of ``height`` rows and ``width`` columns with a pose. Raises :class:`CameraError` for a bad value.

    The public methods are compiled as a whole: operation by operation, the first call would take a second.
    """

    height: eqx.AbstractVar[int]
    width: eqx.AbstractVar[int]
    yaw: eqx.AbstractVar[Scalar]
    pitch: eqx.AbstractVar[Scalar]
    roll: eqx.AbstractVar[Scalar]

    @abstractmethod
    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        """Unit vectors in the camera's frame towards points of the picture."""

    @abstractmethod
    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """(x, y) of unit vectors in the camera's frame: finite, and outside the picture for what it cannot show."""

    @property
    @abstractmethod
    def pixel_angle(self) -> float | Scalar:
        """Angle, rad, from one row to the next at the centre of the picture."""

    @abstractmethod
    def zoomed(self, factor: float | Scalar) -> "Camera":
        """The same camera with a focal length ``factor`` times as long; raises :class:`CameraError` if it has none."""

    @property
    def wraps(self) -> bool:
        """Whether the last column borders on the first."""
        return False

    @abstractmethod
    def _solid_angles(self) -> Float[Array, "height width"]:
        """Solid angle of every pixel, sr."""

    def _covers(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Whether points belong to the picture."""
        return (x >= -0.5) & (x <= self.width - 0.5) & (y >= -0.5) & (y <= self.height - 0.5)

    def _grid(self) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
        x, y = jnp.meshgrid(_array(jnp.arange(self.width)), _array(jnp.arange(self.height)))
        return x, y

    def rotation(self) -> Float[Array, "3 3"]:
        """Matrix that takes the camera's frame to the local one."""
        (sy, cy), (sp, cp), (sr, cr) = ((jnp.sin(a), jnp.cos(a)) for a in (self.yaw, self.pitch, self.roll))
        right = jnp.stack([cy, -sy, jnp.zeros_like(sy)])
        forward = jnp.stack([sy * cp, cy * cp, sp])
        up = jnp.stack([-sy * sp, -cy * sp, cp])
        return jnp.stack([cr * right - sr * up, forward, sr * right + cr * up], axis=-1)

    @eqx.filter_jit
    def directions_at(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        """Unit vectors, local frame, towards any points (x, y) of the picture."""
        return _turn(self.rotation(), self._rays(x, y))

    @eqx.filter_jit
    def directions(self) -> Float[Array, "height width 3"]:
        """Unit vectors, local frame, towards the centres of all pixels."""
        return self.directions_at(*self._grid())

    @eqx.filter_jit
    def pixels(self, directions: Direction) -> Float[Array, "... 2"]:
        """(x, y) of local directions: the inverse of :meth:`directions_at` for all that the camera sees."""
        return jnp.stack(self._project(_turn(self.rotation().T, directions)), axis=-1)

    @eqx.filter_jit
    def sees(self, directions: Direction) -> Bool[Array, "..."]:
        """Whether local directions fall inside the picture."""
        return self._covers(*self._project(_turn(self.rotation().T, directions)))

    @eqx.filter_jit
    def solid_angles(self) -> Float[Array, "height width"]:
        """Solid angle of every pixel, sr: exact for a panorama, otherwise from the pixel's centre."""
        return self._solid_angles()

    @eqx.filter_jit
    def valid(self) -> Bool[Array, "height width"]:
        """Which pixels show anything: all but those outside a fisheye's circle."""
        return self._covers(*self._grid())


class Equirectangular(Camera):
    """Longitude and latitude: azimuth = yaw + 360° (x + ½) / width, growing to the right; row 0 at the zenith.

    The rows span the whole sphere, or with ``upper`` the upper half only (elevation 90° to 0°). ``pitch`` and ``roll``
    tilt the panorama as a whole.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    yaw: Scalar = eqx.field(converter=_array, default=0.0)
    pitch: Scalar = eqx.field(converter=_array, default=0.0)
    roll: Scalar = eqx.field(converter=_array, default=0.0)
    upper: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        _check(self)

    @property
    def pixel_angle(self) -> float:
        """Angle, rad, from one row to the next."""
        return (np.pi / 2 if self.upper else np.pi) / self.height

    def zoomed(self, factor: float | Scalar) -> "Equirectangular":
        """See :class:`Camera`."""
        raise CameraError("an equirectangular picture has no focal length, expected a fisheye's or a pinhole camera's")

    @property
    def wraps(self) -> bool:
        """True: the picture is a full turn."""
        return True

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        azimuth = (x + 0.5) * (2 * np.pi / self.width)
        zenith = (y + 0.5) * self.pixel_angle
        sine = jnp.sin(zenith)
        return jnp.stack(
            jnp.broadcast_arrays(sine * jnp.sin(azimuth), sine * jnp.cos(azimuth), jnp.cos(zenith)), axis=-1
        )

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        # At the zenith every azimuth is right; north is taken, because arctan2(0, 0) has no derivative.
        east, north = rays[..., 0], rays[..., 1]
        north = jnp.where((east == 0) & (north == 0), 1, north)
        turns = jnp.mod(jnp.arctan2(east, north) / (2 * np.pi), 1)
        zenith = jnp.arctan2(safe_norm(rays[..., :2]), rays[..., 2])
        return turns * self.width - 0.5, zenith / self.pixel_angle - 0.5

    def _solid_angles(self) -> Float[Array, "height width"]:
        # Exact: 2π/width (cos θ_top - cos θ_bottom).
        zenith = (_array(jnp.arange(self.height)) + 0.5) * self.pixel_angle
        row = 2 * np.pi / self.width * 2 * np.sin(self.pixel_angle / 2) * jnp.sin(zenith)
        return jnp.broadcast_to(row[:, None], (self.height, self.width))


class Fisheye(Camera):
    """Equidistant fisheye: the angle from the optical axis grows in proportion to the distance from the centre.

    ``fov`` is the angle across the shorter side of the picture, where the image circle ends. By default it looks
    straight up with north at the top and east on the left, as all-sky cameras are mounted.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    fov: Scalar = eqx.field(converter=_array, default=np.pi)
    yaw: Scalar = eqx.field(converter=_array, default=np.pi)
    pitch: Scalar = eqx.field(converter=_array, default=np.pi / 2)
    roll: Scalar = eqx.field(converter=_array, default=0.0)

    def __check_init__(self) -> None:
        _check(self)
        _check_angle(self, "fov", 360.0)

    @property
    def pixel_angle(self) -> Scalar:
        """Angle, rad, between neighbouring pixels along a radius."""
        return self.fov / min(self.height, self.width)

    def zoomed(self, factor: float | Scalar) -> "Fisheye":
        """See :class:`Camera`."""
        return replace(self, fov=self.fov / factor)

    def _centred(
        self, x: Float[Array, "..."], y: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        right, up = x - (self.width - 1) / 2, (self.height - 1) / 2 - y
        return right, up, safe_norm(jnp.stack(jnp.broadcast_arrays(right, up), axis=-1))

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        right, up, distance = self._centred(x, y)
        angle = distance * self.pixel_angle
        # sin(angle) / distance, smooth through the centre.
        sine = self.pixel_angle * jnp.sinc(angle / np.pi)
        return jnp.stack([right * sine, jnp.broadcast_to(jnp.cos(angle), sine.shape), up * sine], axis=-1)

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        sine = safe_norm(rays[..., ::2])
        per_sine = safe_divide(jnp.arctan2(sine, rays[..., 1]), sine, 1.0) / self.pixel_angle
        return rays[..., 0] * per_sine + (self.width - 1) / 2, (self.height - 1) / 2 - rays[..., 2] * per_sine

    def _covers(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Bool[Array, "..."]:
        _, _, distance = self._centred(x, y)
        return super()._covers(x, y) & (distance <= min(self.height, self.width) / 2)

    def _solid_angles(self) -> Float[Array, "height width"]:
        _, _, distance = self._centred(*self._grid())
        return self.pixel_angle**2 * jnp.sinc(distance * self.pixel_angle / np.pi)


class Pinhole(Camera):
    """An ordinary lens without distortion; ``fov_y`` is the angle from the top edge to the bottom edge."""

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    fov_y: Scalar = eqx.field(converter=_array, default=np.pi / 3)
    yaw: Scalar = eqx.field(converter=_array, default=0.0)
    pitch: Scalar = eqx.field(converter=_array, default=0.0)
    roll: Scalar = eqx.field(converter=_array, default=0.0)

    def __check_init__(self) -> None:
        _check(self)
        _check_angle(self, "fov_y", 179.0)

    @property
    def pixel_angle(self) -> Scalar:
        """Angle, rad, between neighbouring pixels at the centre (their distance on a screen at distance 1)."""
        return jnp.tan(self.fov_y / 2) * (2 / self.height)

    def zoomed(self, factor: float | Scalar) -> "Pinhole":
        """See :class:`Camera`."""
        return replace(self, fov_y=2 * jnp.arctan(jnp.tan(self.fov_y / 2) / factor))

    def _plane(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "... 3"]:
        right = (x - (self.width - 1) / 2) * self.pixel_angle
        up = ((self.height - 1) / 2 - y) * self.pixel_angle
        return jnp.stack(jnp.broadcast_arrays(right, jnp.ones_like(right), up), axis=-1)

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        plane = self._plane(x, y)
        return plane / safe_norm(plane)[..., None]

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        forward = rays[..., 1]
        ahead = forward > jnp.finfo(rays.dtype).eps
        scale = 1 / (jnp.where(ahead, forward, 1) * self.pixel_angle)
        x = rays[..., 0] * scale + (self.width - 1) / 2
        y = (self.height - 1) / 2 - rays[..., 2] * scale
        return jnp.where(ahead, x, -2.0 * self.width), jnp.where(ahead, y, -2.0 * self.height)

    def _solid_angles(self) -> Float[Array, "height width"]:
        return self.pixel_angle**2 / safe_norm(self._plane(*self._grid())) ** 3


def _check(camera: Camera) -> None:
    for name in ("height", "width"):
        size = getattr(camera, name)
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise CameraError(f"{name}: got {size!r}, expected a whole number of pixels, at least 1")
    for name in ("yaw", "pitch", "roll"):
        _check_angle(camera, name)


def _check_angle(camera: Camera, name: str, largest_deg: float | None = None) -> None:
    """Refuse a concrete angle that is not finite or, if it has a largest value, not in (0, largest]."""
    value = getattr(camera, name)
    if value.ndim:
        raise CameraError(f"{name}: got an array of shape {value.shape}, expected one angle")
    if isinstance(value, jax.core.Tracer):
        return
    degrees = float(np.degrees(value))
    if not np.isfinite(degrees):
        raise CameraError(f"{name}: got {degrees}, expected a finite angle")
    if largest_deg is not None and not 0 < degrees <= largest_deg * (1 + 1e-6):
        raise CameraError(f"{name}: got {degrees:g} degrees, expected more than 0 and at most {largest_deg:g}")


PROJECTIONS: dict[str, type[Camera]] = {"equirectangular": Equirectangular, "fisheye": Fisheye, "pinhole": Pinhole}
"""Cameras by the name files and the command line give them."""

_ANGLES = ("fov", "fov_y", "yaw", "pitch", "roll")


def _degrees(radians: Array) -> float:
    """The decimal with the fewest digits that becomes the same number of radians again, in the same precision."""
    exact = np.degrees(np.float64(radians))
    for digits in range(1, 17):
        short = float(f"{exact:.{digits}g}")
        if np.radians(short).astype(radians.dtype) == radians:
            return short
    return float(exact)


def to_dict(camera: Camera) -> dict[str, Any]:
    """``projection`` and all fields of a camera as they stand in files, angles in degrees under ``<name>_deg``."""
    result: dict[str, Any] = {name: value for name, value in vars(camera).items() if name not in _ANGLES}
    result |= {f"{name}_deg": _degrees(value) for name, value in vars(camera).items() if name in _ANGLES}
    return {"projection": next(name for name, kind in PROJECTIONS.items() if isinstance(camera, kind))} | result


def from_dict(data: Mapping[str, Any]) -> Camera:
    """A camera from the keys of :func:`to_dict`; what is missing takes its default. Raises :class:`CameraError`."""
    projection = data.get("projection")
    if projection not in PROJECTIONS:
        raise CameraError(f"projection: got {projection!r}, expected one of {', '.join(PROJECTIONS)}")
    kind = PROJECTIONS[projection]
    values: dict[str, Any] = {}
    for key, value in data.items():
        name = key.removesuffix("_deg")
        if key == "projection":
            continue
        if name not in kind.__dataclass_fields__ or (name in _ANGLES) != (key != name):
            known = (f"{field}_deg" if field in _ANGLES else field for field in kind.__dataclass_fields__)
            raise CameraError(f"{key}: unknown key; a camera with {projection} projection has {', '.join(known)}")
        if name in _ANGLES:
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise CameraError(f"{key}: got {value!r}, expected a number of degrees")
            value = np.radians(value)
        elif name == "upper" and not isinstance(value, bool):
            raise CameraError(f"{key}: got {value!r}, expected true or false")
        values[name] = value
    missing = [name for name in ("height", "width") if name not in values]
    if missing:
        raise CameraError(f"{missing[0]}: missing; a camera needs its height and width in pixels")
    return kind(**values)
