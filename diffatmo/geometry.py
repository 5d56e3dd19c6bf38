"""The spherical shell, written in *altitude*.

A point is given by its altitude ``h`` above a ground sphere of radius ``R``; a ray by the cosine ``mu`` of its zenith angle
there. ``r = R + h`` never enters as a difference of squares: ``r'^2 - r^2`` is ``(h' - h)(h' + h + 2R)``, which keeps
float32 exact to 1e-6 one metre above the ground, where ``sqrt(r^2 - R^2)`` is off by percents.

Equations are elementary; names follow Bruneton & Neyret 2008, section 2.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from diffatmo._types import Altitude, Cosine, Length, Scalar
from diffatmo.numerics import bounded_divide, once, safe_sqrt


def sine(mu: Cosine) -> Cosine:
    """Sine of the angle whose cosine is ``mu`` (>= 0, derivative 0 at ``mu = ±1``)."""
    return safe_sqrt((1 - mu) * (1 + mu))


def perigee_altitude(altitude: Altitude, mu: Cosine, bottom_radius: Scalar) -> Altitude:
    """Altitude, km, of the point of the (infinite) line nearest to the planet's centre; negative if it is underground.

    ``r sin(theta) - R`` without the cancellation: ``h - r mu^2 / (1 + sin(theta))``.
    """
    return altitude - (bottom_radius + altitude) * mu * mu / (1 + sine(mu))


def horizon_mu(altitude: Altitude, bottom_radius: Scalar) -> Cosine:
    """Cosine of the zenith angle of the geometric horizon: 0 on the ground, negative above it."""
    return -safe_sqrt(altitude * (altitude + 2 * bottom_radius)) / (bottom_radius + altitude)


def hits_ground(altitude: Altitude, mu: Cosine, bottom_radius: Scalar) -> Bool[Array, "..."]:
    """Whether the ray meets the ground. Decide once per ray and hand the answer on."""
    return mu < horizon_mu(altitude, bottom_radius)


def altitude_along(altitude: Altitude, mu: Cosine, distance: Length, bottom_radius: Scalar) -> Altitude:
    """Altitude, km, after ``distance`` km along the ray."""
    r = bottom_radius + altitude
    step = distance * (2 * r * mu + distance)
    return altitude + step / (r + safe_sqrt(r * r + step))


def mu_along(altitude: Altitude, mu: Cosine, distance: Length, there: Altitude, bottom_radius: Scalar) -> Cosine:
    """Cosine of the ray's zenith angle after ``distance`` km along it, at the altitude ``there``."""
    return ((bottom_radius + altitude) * mu + distance) / (bottom_radius + there)


def mu_s_along(
    altitude: Altitude, mu_s: Cosine, nu: Cosine, distance: Length, there: Altitude, bottom_radius: Scalar
) -> Cosine:
    """Cosine of the sun's zenith angle after ``distance`` km along the ray, at the altitude ``there``."""
    return ((bottom_radius + altitude) * mu_s + distance * nu) / (bottom_radius + there)


def distance_up(altitude: Altitude, mu: Cosine, target: Altitude, bottom_radius: Scalar) -> Length:
    """Distance, km, to the farther crossing of altitude ``target`` (>= the ray's perigee), 0 where there is none ahead."""
    r_mu = (bottom_radius + altitude) * mu
    gap = (target - altitude) * (target + altitude + 2 * bottom_radius)
    root = safe_sqrt(r_mu * r_mu + gap)
    # -r mu + root, without its cancellation when mu > 0.
    ascending = bounded_divide(gap, jnp.where(mu > 0, r_mu + root, 1))
    return jnp.maximum(jnp.where(mu > 0, ascending, root - r_mu), 0)


def distance_down(altitude: Altitude, mu: Cosine, target: Altitude, bottom_radius: Scalar) -> Length:
    """Distance, km, to the nearer crossing of ``target`` <= ``altitude`` by a descending ray (``mu < 0``), else 0."""
    r_mu = (bottom_radius + altitude) * mu
    gap = (altitude - target) * (target + altitude + 2 * bottom_radius)
    root = safe_sqrt(r_mu * r_mu - gap)
    return jnp.maximum(bounded_divide(jnp.where(mu < 0, gap, 0), jnp.where(mu < 0, root - r_mu, 1)), 0)


def distance_to_boundary(
    altitude: Altitude, mu: Cosine, ground: Bool[Array, "..."], bottom_radius: Scalar, top_altitude: Altitude
) -> Length:
    """Distance, km, to the end of the ray: the ground where ``ground`` says so, else the top of the atmosphere."""
    return jnp.where(
        ground,
        distance_down(altitude, mu, jnp.zeros_like(altitude), bottom_radius),
        distance_up(altitude, mu, top_altitude, bottom_radius),
    )


def enter_atmosphere(
    altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, bottom_radius: Scalar, top_altitude: Altitude
) -> tuple[Altitude, Cosine, Cosine, Length, Bool[Array, "..."]]:
    """Move a ray that starts in space to the top of the atmosphere.

    Returns ``(altitude, mu, mu_s, distance moved, misses)`` there; a ray that starts inside is returned unchanged, and
    ``misses`` marks one that never meets the atmosphere.
    """
    outside = altitude > top_altitude
    misses = outside & ((mu >= 0) | (perigee_altitude(altitude, mu, bottom_radius) >= top_altitude))
    distance = jnp.where(outside & ~misses, distance_down(altitude, mu, top_altitude, bottom_radius), 0)
    r = bottom_radius + altitude
    r_there = bottom_radius + jnp.where(outside, top_altitude, altitude)
    mu_there = jnp.where(outside, (r * mu + distance) / r_there, mu)
    mu_s_there = jnp.where(outside, (r * mu_s + distance * nu) / r_there, mu_s)
    altitude_there = jnp.where(outside, top_altitude, altitude)
    # A miss is parked on a harmless ray of length zero, so that nothing downstream meets an undefined geometry.
    there = (
        altitude_there,
        jnp.where(misses, 1.0, jnp.clip(mu_there, -1, 1)),
        jnp.where(misses, mu_s, jnp.clip(mu_s_there, -1, 1)),
        distance,
        misses,
    )
    return once(there)
