"""A picture of a sky: camera × model → radiance at every pixel and wavelength."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry
from diffatmo import sun as sunlight
from diffatmo._types import Direction, Length, Radiance, Scalar
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Camera
from diffatmo.constants import SUN_ANGULAR_RADIUS
from diffatmo.models import Model, Moments, Path, PathTrace, View
from diffatmo.numerics import array

TILE_PIXELS = 2**16
"""Pixels computed at a time; bounds the memory of a large picture."""

TILE_PATHS = 2**12
"""Rays to a given depth computed at a time: each is integrated on its own."""


def _rows(camera: Camera, model: Model | None, pixels: int) -> int:
    """Rows of a picture to be computed at a time, ``pixels`` or less.

    The path tracer bounds its memory itself, and it gives each ray of *one* question random numbers of its own: asked row by
    row, it would repeat its noise in every row.
    """
    if isinstance(model, PathTrace):
        return camera.height
    return min(max(1, pixels // camera.width), camera.height)


RESOLVED = 20.0
"""Diameter of the sun in pixels from which its disc is evaluated pixel by pixel."""

NOT_ONE = 1e-3
"""What a unit vector's length may be off by."""


class SceneError(ValueError):
    """A scene that cannot be; the message says what would be right."""


class Scene(eqx.Module):
    """All that a picture depends on: air, camera, its altitude (km), the unit vector to the sun, and the exposure.

    Pixels are radiance times ``exposure``. Raises :class:`SceneError` for a bad value (traced values are not looked at).
    """

    atmosphere: Atmosphere
    camera: Camera
    altitude: Scalar = eqx.field(converter=array)
    sun: Direction = eqx.field(converter=array)
    exposure: Scalar = eqx.field(converter=array, default=1.0)

    def __check_init__(self) -> None:
        unit = lambda v: v.shape[-1:] == (3,) and np.abs(np.linalg.norm(v, axis=-1) - 1) < NOT_ONE
        for name, good, expected in (
            ("altitude", lambda km: (km >= 0) & np.isfinite(km), "kilometres >= 0"),
            ("sun", unit, "a unit vector towards the sun, like that of diffatmo.sun.direction"),
            ("exposure", lambda factor: (factor > 0) & np.isfinite(factor), "a finite number > 0"),
        ):
            value = getattr(self, name)
            if not isinstance(value, jax.core.Tracer) and not np.all(good(np.asarray(value))):
                raise SceneError(f"{name}: got {value.tolist()}, expected {expected}")


@eqx.filter_jit
def render(
    scene: Scene,
    model: Model | None = None,
    *,
    sun_disc: bool = False,
    sun_angular_radius: float | Scalar = SUN_ANGULAR_RADIUS,
) -> Float[Array, "height width w"]:
    """Radiance times exposure of every pixel, 0 outside a fisheye's circle; ``model`` is :class:`Moments` by default.

    A pixel has the radiance at its centre. The disc of the sun is drawn if asked for: pixel by pixel where it is large,
    otherwise by spreading the light of many points of the disc over the pixels around them, so that the irradiance of a
    small sun is right in a picture that does not resolve it.
    """
    sky = (model or Moments()).sky(scene.atmosphere)
    view = sky.view(altitude=scene.altitude, sun=scene.sun)

    def tile(directions: Float[Array, "columns 3"]) -> Float[Array, "columns w"]:
        ray = view.radiance(view=directions)
        if not sun_disc:
            return ray.radiance
        return ray.radiance + _large_sun(scene, directions, ray.transmittance, sun_angular_radius)

    directions = scene.camera.directions()
    rows = _rows(scene.camera, model, TILE_PIXELS)
    whole = rows == scene.camera.height
    picture = tile(directions) if whole else jax.lax.map(tile, directions, batch_size=rows)
    if sun_disc:
        picture = picture + _small_sun(scene, view, sun_angular_radius)
    return _exposed(scene, picture)


@eqx.filter_jit
def render_with_error(
    scene: Scene,
    model: PathTrace,
    *,
    sun_disc: bool = False,
    sun_angular_radius: float | Scalar = SUN_ANGULAR_RADIUS,
) -> tuple[Float[Array, "height width w"], Float[Array, "height width w"]]:
    """The picture that :func:`render` makes by the path tracer, and the Monte Carlo's standard error of every pixel of it."""
    sky = model.sky(scene.atmosphere)
    directions = scene.camera.directions()
    picture, error, transmittance = sky.radiance_with_error(altitude=scene.altitude, view=directions, sun=scene.sun)
    if sun_disc:
        picture = picture + _large_sun(scene, directions, transmittance, sun_angular_radius)
        picture = picture + _small_sun(scene, sky.view(altitude=scene.altitude, sun=scene.sun), sun_angular_radius)
    return _exposed(scene, picture), _exposed(scene, error)


def _exposed(scene: Scene, light: Float[Array, "height width w"]) -> Float[Array, "height width w"]:
    return jnp.where(scene.camera.valid()[..., None], scene.exposure * light, 0)


@eqx.filter_jit
def aerial_perspective(scene: Scene, depth: Float[Array, "height width"], model: Model | None = None) -> Path:
    """Light and transmittance between the camera and what each pixel shows, ``depth`` km away along its ray.

    An object of radiance L is seen as L · transmittance + inscatter (:func:`composite`). A depth beyond the end of the ray,
    also an infinite one, counts as the end. The inscatter is multiplied by the scene's exposure; pixels outside a fisheye's
    circle have none. ``model`` is :class:`Moments` by default.
    """
    sky = (model or Moments()).sky(scene.atmosphere)
    # Finite, so that the derivative in depth is as well; no ray inside an atmosphere is longer than its circumference.
    longest = 2 * jnp.pi * (scene.atmosphere.top_radius + scene.altitude)

    def tile(directions: Direction, far: Length) -> Path:
        mu, nu = directions[..., 2], jnp.sum(directions * scene.sun, axis=-1)
        level, mu_s = (jnp.broadcast_to(jnp.asarray(x, mu.dtype), mu.shape) for x in (scene.altitude, scene.sun[2]))
        return sky.path(altitude=level, mu=mu, mu_s=mu_s, nu=nu, distance=jnp.clip(far, 0, longest))

    rows = _rows(scene.camera, model, TILE_PATHS)
    directions, depth = scene.camera.directions(), jnp.asarray(depth)
    whole = rows == scene.camera.height
    path = (
        tile(directions, depth) if whole else jax.lax.map(lambda row: tile(*row), (directions, depth), batch_size=rows)
    )
    valid = scene.camera.valid()[..., None]
    return Path(jnp.where(valid, scene.exposure * path.inscatter, 0), jnp.where(valid, path.transmittance, 1))


def composite(colour: Radiance, air: Path) -> Radiance:
    """Things of radiance ``colour``, in the exposure of the picture, behind the air in front of them."""
    return colour * air.transmittance + air.inscatter


def _clear(scene: Scene, directions: Direction, transmittance: Radiance) -> Radiance:
    """The fraction of sunlight that arrives along ``directions``: none through the ground."""
    ground = geometry.hits_ground(scene.altitude, directions[..., 2], scene.atmosphere.bottom_radius)
    return jnp.where(ground[..., None], 0, transmittance)


def _is_resolved(scene: Scene, angular_radius: float | Scalar) -> Bool[Array, ""]:
    return jnp.asarray(2 * angular_radius > RESOLVED * scene.camera.pixel_angle)


def _large_sun(
    scene: Scene, directions: Direction, transmittance: Radiance, angular_radius: float | Scalar
) -> Radiance:
    """Radiance of the sun's disc along ``directions``; 0 where pixels are too large to show it."""
    disc = sunlight.disc_radiance(
        view=directions,
        sun=scene.sun,
        irradiance=scene.atmosphere.solar_irradiance,
        wavelengths=scene.atmosphere.wavelengths,
        angular_radius=angular_radius,
    )
    return jnp.where(_is_resolved(scene, angular_radius), disc * _clear(scene, directions, transmittance), 0)


def _small_sun(scene: Scene, view: View, angular_radius: float | Scalar) -> Float[Array, "height width w"]:
    """Radiance the sun adds to pixels that do not resolve it: each point's light goes to the four pixels around it."""
    camera, air = scene.camera, scene.atmosphere
    points, shares = sunlight.disc_points(scene.sun, wavelengths=air.wavelengths, angular_radius=angular_radius)
    arriving = _clear(scene, points, view.radiance(view=points).transmittance)
    light = jnp.where(camera.sees(points)[:, None], air.solar_irradiance * shares * arriving, 0)
    xy = camera.pixels(points)
    corner = jnp.floor(xy)
    fraction = xy - corner
    column, row = corner.astype(jnp.int32).T
    picture = jnp.zeros((camera.height, camera.width, air.wavelengths.size), light.dtype)
    for right in (0, 1):
        for down in (0, 1):
            x = (column + right) % camera.width if camera.wraps else jnp.clip(column + right, 0, camera.width - 1)
            y = jnp.clip(row + down, 0, camera.height - 1)
            share = jnp.prod(jnp.abs(fraction - jnp.array([1 - right, 1 - down])), axis=-1)
            picture = picture.at[y, x].add(light * share[:, None])
    return jnp.where(_is_resolved(scene, angular_radius), 0, picture / camera.solid_angles()[..., None])
