"""Cameras: which direction does a pixel look in, and where in the picture is a direction.

A point of the picture is (x, y) = (column, row), whole numbers at pixel centres, row 0 at the top. In the camera's own
frame X points right, Y forward along the optical axis and Z up; the pose turns it into the local frame (x east, y
north, z up): ``yaw`` is the azimuth of the optical axis clockwise from north, ``pitch`` its elevation, ``roll`` a
clockwise turn of the camera about it, in radians. The rotation is made of sines and cosines only, so that its
derivative exists everywhere, also for a camera that looks straight up. Sizes are static; every angle may be
differentiated.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo._types import Direction, Scalar
from diffatmo.numerics import array, safe_divide, safe_norm, safe_sqrt


class CameraError(ValueError):
    """A camera's size or angle is out of range; the message says what would be right."""


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
        x, y = jnp.meshgrid(array(np.arange(self.width)), array(np.arange(self.height)))
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


# Distortion ---------------------------------------------------------------------------------------------------------

STEPS = 8
"""Of Newton's method against a distortion; each doubles the digits."""

MARGIN = 1.02
"""Of the picture's half diagonal, within which a distortion is what it says."""


class _Along(NamedTuple):
    """A radial distortion at a distance from the centre."""

    factor: Float[Array, "..."]
    """By which the distance grows."""
    slope: Float[Array, "..."]
    """Of the distance shown by the true one."""


def _along(radial: Float[Array, " k"], radius: Float[Array, "..."]) -> _Along:
    factor = slope = jnp.zeros_like(radius)
    for power in range(radial.size, 0, -1):
        factor = (factor + radial[power - 1]) * radius**2
        slope = (slope + (2 * power + 1) * radial[power - 1]) * radius**2
    return _Along(1 + factor, 1 + slope)


class _Lens(NamedTuple):
    """What a lens does to the points of an ideal picture, x to the right and y down."""

    radial: Float[Array, " k"]
    """Of the second, fourth, … power of the distance from the centre."""
    across: Float[Array, " 2"]
    """p1 and p2 of Brown and Conrady."""
    edge: Scalar
    """Distance from the centre beyond which nothing is shown. There the distortion is continued by a straight line:
    a polynomial may turn back, and bring into the picture what is far outside of it."""


def _distorted(points: Float[Array, "... 2"], lens: _Lens) -> Float[Array, "... 2"]:
    radius = safe_norm(points)
    beyond = radius > lens.edge
    inside = points * jnp.where(beyond, lens.edge / jnp.where(beyond, radius, 1), 1)[..., None]
    x, y = inside[..., 0], inside[..., 1]
    square, (p1, p2) = x * x + y * y, lens.across
    across = (2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y)
    factor = _along(lens.radial, jnp.where(beyond, lens.edge, radius)).factor
    return (
        inside * factor[..., None]
        + jnp.stack(across, axis=-1)
        + _along(lens.radial, lens.edge).slope * (points - inside)
    )


def _columns(points: Float[Array, "... 2"], lens: _Lens) -> tuple[Float[Array, "... 2"], list[Float[Array, "... 2"]]]:
    """Distorted points, and their derivatives by x and by y."""
    value, derivative = jax.linearize(lambda p: _distorted(p, lens), points)
    return value, [derivative(jnp.broadcast_to(unit, points.shape)) for unit in jnp.eye(2, dtype=points.dtype)]


def _stretch(points: Float[Array, "... 2"], lens: _Lens) -> Float[Array, "..."]:
    """By how much the distortion enlarges an area."""
    _, (by_x, by_y) = _columns(points, lens)
    return by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]


def _undistorted(points: Float[Array, "... 2"], lens: _Lens) -> Float[Array, "... 2"]:
    """The inverse of :func:`_distorted`, by Newton's method."""

    def step(guess: Float[Array, "... 2"], lens: _Lens, target: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
        value, (by_x, by_y) = _columns(guess, lens)
        x, y = jnp.moveaxis(value - target, -1, 0)
        area = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
        back = (by_y[..., 1] * x - by_y[..., 0] * y, by_x[..., 0] * y - by_x[..., 1] * x)
        return guess - jnp.stack(back, axis=-1) / area[..., None]

    still_lens, still = jax.lax.stop_gradient((lens, points))
    guess = jax.lax.fori_loop(0, STEPS, lambda _, guess: step(guess, still_lens, still), still)
    # A step from the solution has its first derivative, a second step its second and third as well.
    return step(step(guess, lens, points), lens, points)


# Kinds of cameras ---------------------------------------------------------------------------------------------------


class Equirectangular(Camera):
    """Longitude and latitude: azimuth = yaw + 360° (x + ½) / width, growing to the right; row 0 at the zenith.

    The rows span the whole sphere, or with ``upper`` the upper half only (elevation 90° to 0°). ``pitch`` and ``roll``
    tilt the panorama as a whole.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    yaw: Scalar = eqx.field(converter=array, default=0.0)
    pitch: Scalar = eqx.field(converter=array, default=0.0)
    roll: Scalar = eqx.field(converter=array, default=0.0)
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
        zenith = (array(np.arange(self.height)) + 0.5) * self.pixel_angle
        row = 2 * np.pi / self.width * 2 * np.sin(self.pixel_angle / 2) * jnp.sin(zenith)
        return jnp.broadcast_to(row[:, None], (self.height, self.width))


def _equisolid_angle(radius: Float[Array, "..."]) -> Float[Array, "..."]:
    half = radius / 2
    return 2 * jnp.arctan2(half, safe_sqrt(1 - half**2))


class _Mapping(NamedTuple):
    """How far from the centre a fisheye shows an angle from its axis: equal to the angle where that is small."""

    radius: Callable[[Float[Array, "..."]], Float[Array, "..."]]
    """Of angles from 0 to π; it grows everywhere, also where there is no picture any more."""
    angle: Callable[[Float[Array, "..."]], Float[Array, "..."]]
    """Its inverse, held at its largest value beyond it."""
    largest_deg: float
    """Field of view."""


MAPPINGS: dict[str, _Mapping] = {
    "equidistant": _Mapping(lambda angle: angle, lambda radius: radius, 360.0),
    "equisolid": _Mapping(lambda angle: 2 * jnp.sin(angle / 2), _equisolid_angle, 360.0),
    "stereographic": _Mapping(
        # Finite for what is right behind.
        lambda angle: 2 * jnp.tan(jnp.minimum(angle, np.radians(179.0)) / 2),
        lambda radius: 2 * jnp.arctan(radius / 2),
        350.0,
    ),
    "orthographic": _Mapping(
        # Its picture ends at a right angle; beyond, the same sines are laid outside of it.
        lambda angle: jnp.where(angle <= np.pi / 2, jnp.sin(angle), 2 - jnp.sin(angle)),
        lambda radius: jnp.arctan2(radius, safe_sqrt(1 - radius**2)),
        180.0,
    ),
}
"""Mappings of a fisheye by name."""


class Fisheye(Camera):
    """A fisheye: ``mapping`` says how the distance from the centre grows with the angle θ from the optical axis.

    ``"equidistant"`` is θ, ``"equisolid"`` 2 sin(θ/2), ``"stereographic"`` 2 tan(θ/2), ``"orthographic"`` sin θ.
    ``distortion`` (k1, k2, …) turns any such distance ρ into ρ (1 + k1 ρ² + k2 ρ⁴ + …); with the equidistant mapping that
    is the polynomial in θ of Kannala & Brandt 2006 (IEEE TPAMI 28, 1335) and of OpenCV's fisheye.

    ``fov`` is the angle across the image circle, whose diameter is ``circle`` times the shorter side of the picture: less
    than 1 where black surrounds it, more where the picture cuts it. By default a fisheye looks straight up with north at
    the top and east on the left, as all-sky cameras are mounted.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    fov: Scalar = eqx.field(converter=array, default=np.pi)
    yaw: Scalar = eqx.field(converter=array, default=np.pi)
    pitch: Scalar = eqx.field(converter=array, default=np.pi / 2)
    roll: Scalar = eqx.field(converter=array, default=0.0)
    mapping: str = eqx.field(static=True, default="equidistant")
    distortion: Float[Array, " k"] = eqx.field(converter=array, default=())
    circle: Scalar = eqx.field(converter=array, default=1.0)

    def __check_init__(self) -> None:
        _check(self)
        if self.mapping not in MAPPINGS:
            raise CameraError(f"mapping: got {self.mapping!r}, expected one of {', '.join(MAPPINGS)}")
        _check_angle(self, "fov", MAPPINGS[self.mapping].largest_deg)
        _check_circle(self)
        _check_distortion(self)

    @property
    def pixel_angle(self) -> Scalar:
        """Angle, rad, between neighbouring pixels along a radius at the centre."""
        edge = MAPPINGS[self.mapping].radius(self.fov / 2)
        return 2 * edge * _along(self.distortion, edge).factor / (min(self.height, self.width) * self.circle)

    def zoomed(self, factor: float | Scalar) -> "Fisheye":
        """See :class:`Camera`."""
        return replace(self, circle=self.circle * factor)

    def _lens(self) -> _Lens:
        return _Lens(self.distortion, jnp.zeros(2), MAPPINGS[self.mapping].radius(self.fov / 2))

    def _centred(
        self, x: Float[Array, "..."], y: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        right, down = x - (self.width - 1) / 2, y - (self.height - 1) / 2
        return right, down, safe_norm(jnp.stack(jnp.broadcast_arrays(right, down), axis=-1))

    def _plane(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "... 2"]:
        """Points at the distances of the mapping from the centre."""
        right, down, _ = self._centred(x, y)
        points = jnp.stack(jnp.broadcast_arrays(right, down), axis=-1) * self.pixel_angle
        return _undistorted(points, self._lens()) if self.distortion.size else points

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        points = self._plane(x, y)
        radius = safe_norm(points)
        angle = MAPPINGS[self.mapping].angle(radius)
        # Smooth through the centre, where both are the same.
        sine = safe_divide(jnp.sin(angle), radius, 1.0)
        return jnp.stack([points[..., 0] * sine, jnp.cos(angle), -points[..., 1] * sine], axis=-1)

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        # Right behind the camera every side is as good; the right one is taken.
        behind = (rays[..., 0] == 0) & (rays[..., 2] == 0) & (rays[..., 1] < 0)
        right, down = jnp.where(behind, jnp.finfo(rays.dtype).eps, rays[..., 0]), -rays[..., 2]
        sine = safe_norm(jnp.stack([right, down], axis=-1))
        per_sine = safe_divide(MAPPINGS[self.mapping].radius(jnp.arctan2(sine, rays[..., 1])), sine, 1.0)
        points = jnp.stack([right * per_sine, down * per_sine], axis=-1)
        if self.distortion.size:
            points = _distorted(points, self._lens())
        points = points / self.pixel_angle
        return points[..., 0] + (self.width - 1) / 2, points[..., 1] + (self.height - 1) / 2

    def _covers(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Bool[Array, "..."]:
        _, _, distance = self._centred(x, y)
        return super()._covers(x, y) & (distance <= min(self.height, self.width) / 2 * self.circle)

    def _solid_angles(self) -> Float[Array, "height width"]:
        points = self._plane(*self._grid())
        radius, mapping = safe_norm(points), MAPPINGS[self.mapping]
        angle = mapping.angle(radius)
        _, slope = jax.jvp(mapping.radius, (angle,), (jnp.ones_like(angle),))
        area = self.pixel_angle**2 * safe_divide(jnp.sin(angle), radius, 1.0) * safe_divide(jnp.ones_like(slope), slope)
        return area / _stretch(points, self._lens()) if self.distortion.size else area


class Pinhole(Camera):
    """An ordinary lens; ``fov_y`` is the angle from the top edge to the bottom edge, but for the distortion.

    ``distortion`` is that of Brown 1971 and Conrady 1919: (k1, k2, k3, p1, p2), of which the last may be left out. With
    x to the right and y down on a screen at distance 1, and r² = x² + y², a point is shown at
    x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²), and likewise y, with p1 (r² + 2 y²) + 2 p2 x y. These are
    OpenCV's numbers, which it lists as k1, k2, p1, p2, k3.
    """

    height: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    fov_y: Scalar = eqx.field(converter=array, default=np.pi / 3)
    yaw: Scalar = eqx.field(converter=array, default=0.0)
    pitch: Scalar = eqx.field(converter=array, default=0.0)
    roll: Scalar = eqx.field(converter=array, default=0.0)
    distortion: Float[Array, " k"] = eqx.field(converter=array, default=())

    def __check_init__(self) -> None:
        _check(self)
        _check_angle(self, "fov_y", 179.0)
        if self.distortion.size > 5:
            raise CameraError(f"distortion: got {self.distortion.size} numbers, expected at most 5: k1, k2, k3, p1, p2")
        _check_distortion(self)

    @property
    def pixel_angle(self) -> Scalar:
        """Angle, rad, between neighbouring pixels at the centre (their distance on a screen at distance 1)."""
        return jnp.tan(self.fov_y / 2) * (2 / self.height)

    def zoomed(self, factor: float | Scalar) -> "Pinhole":
        """See :class:`Camera`."""
        return replace(self, fov_y=2 * jnp.arctan(jnp.tan(self.fov_y / 2) / factor))

    def _lens(self) -> _Lens:
        whole = jnp.zeros(5, self.distortion.dtype).at[: self.distortion.size].set(self.distortion)
        radial, across = whole[:3], whole[3:]
        # A limit without influence on what is inside of it, so that nobody needs its derivative.
        corner, still, aside = jax.lax.stop_gradient((self._corner(), radial, jnp.sum(jnp.abs(across))))
        shown = MARGIN * corner + 3 * corner**2 * aside

        def step(_: int, radius: Scalar) -> Scalar:
            there = _along(still, radius)
            return radius - (radius * there.factor - shown) / there.slope

        return _Lens(radial, across, jax.lax.fori_loop(0, 2 * STEPS, step, shown))

    def _corner(self) -> Scalar:
        """Distance of the picture's corners from its centre on a screen at distance 1."""
        return float(np.hypot(self.height, self.width)) / 2 * self.pixel_angle

    def _plane(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "... 3"]:
        right = (x - (self.width - 1) / 2) * self.pixel_angle
        up = ((self.height - 1) / 2 - y) * self.pixel_angle
        right, up = jnp.broadcast_arrays(right, up)
        if self.distortion.size:
            straight = _undistorted(jnp.stack([right, -up], axis=-1), self._lens())
            right, up = straight[..., 0], -straight[..., 1]
        return jnp.stack([right, jnp.ones_like(right), up], axis=-1)

    def _rays(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Direction:
        plane = self._plane(x, y)
        return plane / safe_norm(plane)[..., None]

    def _project(self, rays: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        forward = rays[..., 1]
        ahead = forward > jnp.finfo(rays.dtype).eps
        points = jnp.stack([rays[..., 0], -rays[..., 2]], axis=-1) / jnp.where(ahead, forward, 1)[..., None]
        if self.distortion.size:
            points = _distorted(points, self._lens())
        points = points / self.pixel_angle
        x, y = points[..., 0] + (self.width - 1) / 2, points[..., 1] + (self.height - 1) / 2
        return jnp.where(ahead, x, -2.0 * self.width), jnp.where(ahead, y, -2.0 * self.height)

    def _solid_angles(self) -> Float[Array, "height width"]:
        plane = self._plane(*self._grid())
        area = self.pixel_angle**2 / safe_norm(plane) ** 3
        if not self.distortion.size:
            return area
        return area / _stretch(jnp.stack([plane[..., 0], -plane[..., 2]], axis=-1), self._lens())


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


def _check_circle(camera: "Fisheye") -> None:
    circle = camera.circle
    if circle.ndim:
        raise CameraError(f"circle: got an array of shape {circle.shape}, expected one number")
    if not isinstance(circle, jax.core.Tracer) and not 0 < float(circle) < np.inf:
        raise CameraError(f"circle: got {float(circle):g}, expected a number above 0")


def _check_distortion(camera: "Fisheye | Pinhole") -> None:
    """Refuse a concrete distortion that is not finite, or folds the picture."""
    given = camera.distortion
    if given.ndim != 1:
        raise CameraError(f"distortion: got an array of shape {given.shape}, expected a list of numbers")
    if not given.size or isinstance(given, jax.core.Tracer):
        return
    if not np.all(np.isfinite(given)):
        raise CameraError(f"distortion: got {given.tolist()}, expected finite numbers")
    lens = camera._lens()
    if isinstance(lens.edge, jax.core.Tracer):
        return
    along = _along(lens.radial, jnp.linspace(0, lens.edge, 256))
    reaches = isinstance(camera, Fisheye) or bool(lens.edge * along.factor[-1] >= camera._corner())
    if not (reaches and np.isfinite(lens.edge) and np.all(along.slope > 0)):
        raise CameraError(
            f"distortion: {given.tolist()} folds the picture, expected one that grows from centre to edge"
        )


PROJECTIONS: dict[str, type[Camera]] = {"equirectangular": Equirectangular, "fisheye": Fisheye, "pinhole": Pinhole}
"""Cameras by the name files and the command line give them."""

_ANGLES = ("fov", "fov_y", "yaw", "pitch", "roll")
_OF_LENSES = ("mapping", "distortion", "circle")


def _degrees(radians: Array) -> float:
    """The decimal with the fewest digits that becomes the same number of radians again, in the same precision."""
    exact = np.degrees(np.float64(radians))
    for digits in range(1, 17):
        short = float(f"{exact:.{digits}g}")
        if np.radians(short).astype(radians.dtype) == radians:
            return short
    return float(exact)


def to_dict(camera: Camera) -> dict[str, Any]:
    """``projection`` and all fields of a camera as they stand in files, angles in degrees under ``<name>_deg``.

    The mapping, the distortion and the circle of a lens are left out where they are the default.
    """
    result: dict[str, Any] = {
        "projection": next(name for name, kind in PROJECTIONS.items() if isinstance(camera, kind))
    }
    for name, value in vars(camera).items():
        if name not in (*_ANGLES, *_OF_LENSES):
            result[name] = value
    result |= {f"{name}_deg": _degrees(value) for name, value in vars(camera).items() if name in _ANGLES}
    for name in _OF_LENSES:
        if hasattr(camera, name):
            own: Any = getattr(camera, name)
            if not np.array_equal(own, type(camera).__dataclass_fields__[name].default):
                result[name] = own if isinstance(own, str) else _decimals(own)
    return result


def _decimals(values: Array) -> Any:
    """The decimals with the fewest digits that are read back as the same numbers in the same precision."""
    return float(str(np.asarray(values)[()])) if not values.ndim else [_decimals(value) for value in values]


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
            if not _is_number(value):
                raise CameraError(f"{key}: got {value!r}, expected a number of degrees")
            value = np.radians(value)
        elif name == "upper" and not isinstance(value, bool):
            raise CameraError(f"{key}: got {value!r}, expected true or false")
        elif name == "circle" and not _is_number(value):
            raise CameraError(f"{key}: got {value!r}, expected a number")
        elif name == "distortion" and not (isinstance(value, list | tuple) and all(map(_is_number, value))):
            raise CameraError(f"{key}: got {value!r}, expected a list of numbers")
        values[name] = value
    missing = [name for name in ("height", "width") if name not in values]
    if missing:
        raise CameraError(f"{missing[0]}: missing; a camera needs its height and width in pixels")
    return kind(**values)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
