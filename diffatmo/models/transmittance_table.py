"""Transmittance as a table over radius and mu, shared by the models that have one (Bruneton & Neyret 2008, section 4)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Length, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.tables import Planet, bilinear
from diffatmo.numerics import bounded_divide

SUN_ANGULAR_RADIUS = 0.00935 / 2
"""rad; that of Bruneton's demonstration of 2017. Over this range of its height the sun sets."""

ROWS = 8
"""Rows of the table computed at once."""


def trapezoid(i: Array, steps: int) -> Array:
    """Weight of point ``i`` of 0 … ``steps`` in the mean over a ray, by the trapezoidal rule."""
    return jnp.where((i == 0) | (i == steps), 0.5, 1.0) / steps


def compute_transmittance(atmosphere: Atmosphere, planet: Planet, steps: int) -> Float[Array, "r mu w"]:
    """T(r, mu) to the top of the atmosphere, by the trapezoidal rule (paper, eq. 5)."""
    altitude, mu = planet.transmittance_nodes()
    profiles = atmosphere.rayleigh_density, atmosphere.mie_density, atmosphere.ozone_density
    i = jnp.arange(steps + 1)[:, None]

    def row(node: tuple[Scalar, Float[Array, " mu"]]) -> Float[Array, "3 mu"]:
        altitude, mu = node
        length = geometry.distance_up(altitude, mu, planet.top_altitude, planet.bottom_radius)
        here = geometry.altitude_along(altitude, mu, length * (i / steps), planet.bottom_radius)
        densities = jnp.stack([profile(jnp.maximum(here, 0)) for profile in profiles])
        return length * jnp.sum(trapezoid(i, steps) * densities, axis=1)

    # Some rows after the others: the samples stay in the cache.
    columns = jax.lax.map(row, (altitude, mu), batch_size=ROWS)
    coefficients = jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_extinction, atmosphere.ozone_absorption])
    depth = jnp.sum(columns[..., None] * coefficients[:, None], axis=1)
    return jnp.exp(-depth)


def to_top(planet: Planet, transmittance: Float[Array, "r mu w"], altitude: Altitude, mu: Cosine) -> Transmittance:
    """T looked up, for a ray that does not meet the ground."""
    return bilinear(transmittance, *planet.transmittance_position(altitude, mu))


def between(
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    altitude: Altitude,
    mu: Cosine,
    distance: Length,
    ground: Bool[Array, "..."],
) -> Transmittance:
    """T over the first ``distance`` km of a ray."""
    there = planet.altitude_after(altitude, mu, distance)
    return _ratio(planet, transmittance, altitude, mu, there, distance, ground)


def to_ground(
    planet: Planet, transmittance: Float[Array, "r mu w"], altitude: Altitude, mu: Cosine, ground: Bool[Array, "..."]
) -> Transmittance:
    """T down to the ground; 1 for a ray that is not said to meet it."""
    zero = jnp.zeros_like(altitude)
    distance = jnp.where(ground, geometry.distance_down(altitude, mu, zero, planet.bottom_radius), 0)
    # The altitude there is 0, not nearly 0: the position in the table goes as its square root.
    return _ratio(planet, transmittance, altitude, mu, jnp.where(ground, zero, altitude), distance, ground)


def _ratio(
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    altitude: Altitude,
    mu: Cosine,
    there: Altitude,
    distance: Length,
    ground: Bool[Array, "..."],
) -> Transmittance:
    """T between two points of a ray, as a ratio of two entries of the table (paper, eq. 6)."""
    mu_there = planet.cosine_after(altitude, mu, 1.0, distance, there)
    sign = jnp.where(ground, -1.0, 1.0)
    here_up = to_top(planet, transmittance, altitude, sign * mu)
    there_up = to_top(planet, transmittance, there, sign * mu_there)
    down = ground[..., None]
    return jnp.minimum(bounded_divide(jnp.where(down, there_up, here_up), jnp.where(down, here_up, there_up)), 1)


def sun_seen(planet: Planet, altitude: Altitude, mu_s: Cosine, sun_angular_radius: float) -> Float[Array, "..."]:
    """Fraction of the sun's disc above the horizon, roughly: a smooth step (2017, ``GetTransmittanceToSun``)."""
    horizon = geometry.horizon_mu(altitude, planet.bottom_radius)
    dip_sine = planet.bottom_radius / (planet.bottom_radius + altitude)
    t = jnp.clip((mu_s - horizon) / (2 * dip_sine * sun_angular_radius) + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def to_sun(
    planet: Planet, transmittance: Float[Array, "r mu w"], altitude: Altitude, mu_s: Cosine, sun_angular_radius: float
) -> Transmittance:
    """T towards the sun, times the part of its disc that is up."""
    seen = sun_seen(planet, altitude, mu_s, sun_angular_radius)
    return to_top(planet, transmittance, altitude, mu_s) * seen[..., None]
