"""The sun: its direction, also from time and place, the radiance of its disc, and where it is in a picture that shows it."""

from datetime import datetime
from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import ephemeris, saturation
from diffatmo._types import Direction, Radiance, Scalar, Spectrum
from diffatmo.constants import SUN_ANGULAR_RADIUS
from diffatmo.numerics import safe_norm, safe_sqrt

ROUNDING = 1e-6
"""Of π in single precision."""


class SunError(ValueError):
    """A picture does not show one sun, or a sun cannot be where it is said to be; the message says what is wrong."""


def direction(*, zenith: float | Scalar, azimuth: float | Scalar) -> Direction:
    """Unit vector (x east, y north, z up) towards a zenith angle and an azimuth clockwise from north, rad.

    Raises :class:`SunError` for a zenith angle beyond π, which is one in degrees (traced values are not looked at).
    """
    if not isinstance(zenith, jax.core.Tracer) and np.any(np.abs(np.asarray(zenith)) > np.pi + ROUNDING):
        raise SunError(f"zenith: got {np.asarray(zenith).tolist()}, expected radians, up to π")
    return _direction(zenith, azimuth)


@jax.jit
def _direction(zenith: float | Scalar, azimuth: float | Scalar) -> Direction:
    zenith, azimuth = jnp.asarray(zenith, jnp.result_type(float)), jnp.asarray(azimuth, jnp.result_type(float))
    sine = jnp.sin(zenith)
    return jnp.stack(jnp.broadcast_arrays(sine * jnp.sin(azimuth), sine * jnp.cos(azimuth), jnp.cos(zenith)), axis=-1)


@jax.jit
def angles(direction: Direction) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Zenith angle and azimuth in [0, 2π), rad, of unit vectors; the azimuth of the zenith is 0 with derivative 0."""
    east, north = direction[..., 0], direction[..., 1]
    vertical = (east == 0) & (north == 0)
    azimuth = jnp.arctan2(east, jnp.where(vertical, 1, north))
    return jnp.arctan2(safe_norm(direction[..., :2]), direction[..., 2]), jnp.mod(azimuth, 2 * np.pi)


def position(
    time: datetime,
    *,
    latitude_deg: float | Float[Array, "..."],
    longitude_deg: float | Float[Array, "..."],
    altitude_km: float | Float[Array, "..."] = 0.0,
    pressure_hpa: float | Float[Array, "..."] | None = None,
    temperature_k: float | Float[Array, "..."] = 288.15,
    offset_s: float | Float[Array, "..."] = 0.0,
    refraction: bool = True,
) -> Direction:
    """Unit vector to the sun at a time and a place (north and east positive), to 0.005° from 1950 to 2100.

    ``time`` needs a time zone; it is reckoned on the host. All else may be arrays, and be differentiated by:
    ``offset_s`` are seconds to be added to ``time``, of a clock that is off or over a day (in single precision a few days
    at most). Refraction is that of the pressure and temperature at the place, of a pressure that falls off with altitude
    unless it is given, and fades below the horizon. Raises :class:`diffatmo.ephemeris.TimeError`.
    """
    if pressure_hpa is None:
        pressure_hpa = 1013.25 * jnp.exp(-_array(altitude_km) / 8)
    strength = _array(pressure_hpa) / 1010 * (283.15 / _array(temperature_k))
    place = (_array(value) for value in (latitude_deg, longitude_deg, altitude_km, offset_s))
    return _position(ephemeris.epoch(time), *place, strength if refraction else None)


@jax.jit
def _position(
    epoch: ephemeris.Epoch, latitude: Array, longitude: Array, altitude: Array, offset: Array, strength: Array | None
) -> Direction:
    towards = ephemeris.topocentric(
        ephemeris.geocentric(epoch, offset),
        latitude=jnp.radians(latitude),
        longitude=jnp.radians(longitude),
        altitude=altitude,
    )
    return towards if strength is None else ephemeris.refracted(towards, strength=strength)


def _array(value: float | Float[Array, "..."]) -> Array:
    return jnp.asarray(value, jnp.result_type(float))


def limb_exponent(wavelengths: Spectrum) -> Spectrum:
    """Exponent α of the limb darkening I(mu) = I(1) mu^α, mu the cosine of the angle at the photosphere.

    Hestroffer & Magnan 1998, A&A 333, 338: α = -0.023 + 0.292 / λ(µm) from 416 to 1099 nm, fitted to Neckel & Labs
    1994. Below, where the law breaks at the Balmer jump, the value at 416 nm is kept.
    """
    return -0.023 + 0.292 / (jnp.maximum(wavelengths, 416.0) * 1e-3)


@jax.jit
def disc_radiance(
    *,
    view: Direction,
    sun: Direction,
    irradiance: Spectrum,
    wavelengths: Spectrum,
    angular_radius: float | Scalar = SUN_ANGULAR_RADIUS,
) -> Radiance:
    """Radiance of the sun's disc along ``view``, 0 beside it, before any loss in the atmosphere.

    Integrated over the disc with the cosine of the angle to the sun it gives ``irradiance`` exactly. The radiance falls
    to 0 at the limb, so that its derivative is that of the true edge and nothing needs softening.
    """
    # Squared chord: exact for two nearly equal float32 vectors, where 1 - nu would be noise.
    chord = jnp.sum((view - sun) ** 2, axis=-1)
    rim = jnp.sin(angular_radius) ** 2
    u = jnp.where(chord < 1, chord * (1 - chord / 4), rim) / rim
    exponent = limb_exponent(wavelengths)
    mean = irradiance / (jnp.pi * rim)
    inside = (u < 1)[..., None]
    darkening = jnp.where(inside, jnp.where(inside, 1 - u[..., None], 1) ** (exponent / 2), 0)
    return mean * (1 + exponent / 2) * darkening


@partial(jax.jit, static_argnames="count")
def disc_points(
    sun: Direction, *, wavelengths: Spectrum, count: int = 4096, angular_radius: float | Scalar = SUN_ANGULAR_RADIUS
) -> tuple[Float[Array, "count 3"], Float[Array, "count w"]]:
    """Points spread evenly over the disc, and the share of the sun's irradiance that comes from each (sum 1).

    The points lie on a sunflower spiral (Vogel 1979): equal areas, and no direction preferred.
    """
    u = (np.arange(count) + 0.5) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    right, up = _tangents(sun)
    sine = jnp.sin(angular_radius) * jnp.asarray(np.sqrt(u))
    across = jnp.asarray(np.cos(turn))[:, None] * right + jnp.asarray(np.sin(turn))[:, None] * up
    points = safe_sqrt(1 - sine**2)[:, None] * sun + sine[:, None] * across
    weights = (1 - jnp.asarray(u)[:, None]) ** (limb_exponent(wavelengths) / 2)
    return points, weights / jnp.sum(weights, axis=0)


def _tangents(normal: Direction) -> tuple[Direction, Direction]:
    """Two unit vectors that complete ``normal`` to an orthonormal frame (Duff et al. 2017), continuous but near -z."""
    x, y, z = normal
    sign = jnp.where(z > -0.9, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])


class Picture(Protocol):
    """What is asked of a camera here; every :class:`diffatmo.camera.Camera` has it."""

    def directions(self) -> Float[Array, "height width 3"]:
        """Unit vectors towards the pixels."""

    def solid_angles(self) -> Float[Array, "height width"]:
        """Solid angle of every pixel, sr."""

    def valid(self) -> Bool[Array, "height width"]:
        """Which pixels show anything."""


class Detection(NamedTuple):
    """Where the sun is in a picture."""

    direction: Float[np.ndarray, "3"]
    uncertainty: float
    """One standard deviation of the direction, rad."""


def find(pixels: Float[np.ndarray, "height width w"], camera: Picture) -> Detection:
    """The centre of the one small, outstandingly bright spot in a picture of linear radiance.

    Where the picture is clipped around the sun it is the middle of the one round plateau, with an uncertainty in proportion to
    the plateau's width. Raises :class:`SunError` when there is neither (a sky without the sun) or more than one.
    Runs on the host; the result is data, not differentiable.
    """
    towards = np.asarray(camera.directions(), dtype=np.float64)
    area = np.asarray(camera.solid_angles(), dtype=np.float64)
    valid = np.asarray(camera.valid())
    # An infinite pixel is what half-precision files have where the sun was too bright for them.
    light = np.nan_to_num(np.mean(pixels, axis=-1, dtype=np.float64), nan=0.0, posinf=1e30, neginf=0.0)
    light = np.where(valid, light, 0)
    try:
        return _spot(light, towards, area)
    except SunError:
        found = _plateau(np.asarray(pixels), valid, towards, area)
        if found is None:
            raise
        return found


def _spot(
    light: Float[np.ndarray, "height width"],
    towards: Float[np.ndarray, "height width 3"],
    area: Float[np.ndarray, "height width"],
) -> Detection:
    brightest = np.unravel_index(light.argmax(), light.shape)
    peak = light[brightest]
    if peak <= 0:
        raise SunError("the picture shows no light at all")
    # Nothing else in a sky stands out from its surroundings by this much; the sun does so by 1000 or more, even
    # spread over a pixel of 1.5 degrees.
    pixel = np.sqrt(area[brightest])
    reach = max(np.radians(2.0), 2.5 * pixel)
    chord = np.linalg.norm(towards - towards[brightest], axis=-1)
    ring = light[(chord > reach) & (chord < 2.5 * reach) & (light > 0)]
    contrast = peak / np.median(ring) if ring.size else np.inf
    if contrast < 20:
        raise SunError(f"no sun found: the brightest pixel is only {contrast:.1f} times brighter than its surroundings")
    bright = light > 0.1 * peak
    if np.any(bright & (chord > reach)):
        raise SunError(f"no single sun found: {np.count_nonzero(bright)} pixels are about as bright as the brightest")
    weight = np.where(bright, light * area, 0)
    centre = np.einsum("yx,yxi->i", weight, towards)
    centre /= np.linalg.norm(centre)
    spread = np.sum(weight * np.sum((towards - centre) ** 2, axis=-1)) / np.sum(weight)
    # A centroid of light known to a pixel's width and to a half of the spot's.
    return Detection(centre, float(np.sqrt(pixel**2 / 12 + spread / 4)))


WIDEST = np.radians(8.0)
"""Radius of a clipped plateau beyond which it does not tell where the sun is."""

LONGEST = 1.5
"""Length by width of a plateau, up to which it is round; that of a half disc is 1.9."""


def _plateau(
    pixels: Float[np.ndarray, "height width w"],
    valid: Bool[np.ndarray, "height width"],
    towards: Float[np.ndarray, "height width 3"],
    area: Float[np.ndarray, "height width"],
) -> Detection | None:
    """The middle of what is clipped, if that is one round piece in the midst of a glow; None if it is anything else."""
    channels = [saturation.clipped(pixels[..., i : i + 1]) & valid for i in range(pixels.shape[-1])]
    # The channel with the smallest plateau shows best where its middle is.
    plateau = min((each for each in channels if each.any()), key=lambda each: area[each].sum(), default=None)
    if plateau is None:
        return None
    size = float(area[plateau].sum())
    centre = np.einsum("n,ni->i", area[plateau], towards[plateau])
    centre /= max(float(np.linalg.norm(centre)), 1e-12)
    chord = np.linalg.norm(towards - centre, axis=-1)
    radius = np.sqrt(size / np.pi)
    pixel = np.sqrt(area[plateau].mean())
    offset = (towards[plateau] - centre) * np.sqrt(area[plateau] / size)[:, None]
    long, wide, _ = np.linalg.svd(offset, compute_uv=False) if len(offset) > 2 else (0.0, 0.0, 0.0)
    within = plateau & (chord < 1.5 * radius + pixel)
    ring = valid & (chord > 1.5 * radius + pixel) & (chord < 2 * radius + 3 * pixel)
    whole = 2 * np.pi * (1 - np.cos(2 * radius + 3 * pixel)) - 2 * np.pi * (1 - np.cos(1.5 * radius + pixel))
    round_enough = long <= LONGEST * (wide + pixel / 4) and area[within].sum() >= 0.97 * size
    if radius > WIDEST or not round_enough or area[ring].sum() < 0.8 * whole:
        return None
    return Detection(centre, float(np.hypot(pixel, 0.4 * radius)))
