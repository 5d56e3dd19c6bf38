"""Geometry of the iteration: where the nodes are and how rays connect them. Depends on the planet's radii only."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, rays, table
from diffatmo._types import Altitude, Cosine, Scalar
from diffatmo.models.moments.angular import cosines, orders, plane, polar, projection, relative_nu
from diffatmo.numerics import gauss_legendre, safe_divide

ALTITUDE_LINEAR = 0.04
"""Linear part of the map of altitude nodes (clusters them in the aerosol layer)."""

DIRECTION_LINEAR = 0.02
"""Linear part of the map of direction nodes on either side of the horizon."""

GRAZING = 0.05
"""sqrt(2 * 8 km / 6360 km): the sine of the sun's height over which the sky changes at dusk. Scales with the planet."""


class Directions(NamedTuple):
    """How finely the sphere of directions is sampled, and the rays into it."""

    sky: int
    ground: int
    azimuths: int
    steps: int
    degree: int
    """Degree of the moments that are wanted."""


class Rays(eqx.Module):
    """Rays from every altitude node into every direction node: geometry that depends on the planet alone.

    Axes: ``i`` altitude node, ``k`` direction (the sky's first, then the ground's), ``p`` azimuth, ``j`` sun node, ``n`` node
    along the ray.
    """

    mu: Float[Array, "i k"]
    solid_angle: Float[Array, "i k"]
    """Weight of the direction: d mu, so that a sum over k and a mean over azimuth times 2π integrates the sphere."""
    project: Float[Array, "i k lm"]
    """Solid angle times N_lm Π_lm sin^m θ."""
    sun_scale: Float[Array, "lm j"]
    """sin^-m θ_s."""
    ground: Bool[Array, " k"]
    nodes: rays.Nodes
    mu_s_here: Float[Array, "i k n p j"]
    mu_s_ground: Float[Array, "i g p j"]
    azimuths: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        altitude: Float[Array, " i"],
        mu_s: Float[Array, " j"],
        radius: Scalar,
        top: Altitude,
        count: Directions,
    ) -> "Rays":
        """Gauss-Legendre directions on either side of each node's horizon, and the ray into each of them."""
        horizon = geometry.horizon_mu(altitude, radius)[:, None]
        mus, weights = [], []
        for number, span in ((count.sky, 1 - horizon), (count.ground, -1 - horizon)):
            unit, w = gauss_legendre(number)
            slope = DIRECTION_LINEAR + 2 * (1 - DIRECTION_LINEAR) * unit
            mus.append(horizon + span * table.stretch(jnp.asarray(unit, altitude.dtype), DIRECTION_LINEAR))
            weights.append(jnp.abs(span) * jnp.asarray(w * slope, altitude.dtype))
        mu, solid_angle = jnp.concatenate(mus, axis=1), jnp.concatenate(weights, axis=1)
        ground = jnp.arange(count.sky + count.ground) >= count.sky
        start = jnp.broadcast_to(altitude[:, None], mu.shape)
        nodes = rays.trace(start, mu, jnp.broadcast_to(ground, mu.shape), radius, top, count.steps)
        nu = relative_nu(mu[..., None, None], mu_s, cosines(count.azimuths, altitude.dtype)[:, None])
        mu_s_here = geometry.mu_s_along(
            start[..., None, None, None], mu[..., None, None, None], mu_s, nu[:, :, None],
            nodes.distance[..., None, None], radius,
        )  # fmt: skip
        reach = jnp.sum(nodes.weight, axis=-1)[:, count.sky :, None, None]
        r_mu_s = (radius + altitude)[:, None, None, None] * mu_s
        mu_s_ground = (r_mu_s + reach * nu[:, count.sky :]) / radius
        powers = [jnp.ones_like(mu_s)]
        for _ in range(count.degree):
            powers.append(powers[-1] / geometry.sine(mu_s))
        return cls(
            mu,
            solid_angle,
            solid_angle[..., None] * projection(count.degree, mu),
            jnp.stack(powers)[orders(count.degree)],
            ground,
            nodes,
            mu_s_here,
            jnp.clip(mu_s_ground, -1, 1),
            count.azimuths,
            count.steps,
        )


class Ways(NamedTuple):
    """What takes moments at the nodes of the shell to the light scattered along ``k`` rays.

    The weights of the interpolation in the sun's height are made from ``sun_unit`` where they are used: as a table they would
    be the largest array by far. ``suns`` stands for one or more axes over suns; in :class:`Links` axis ``i`` comes first.
    """

    altitude_rows: Float[Array, "..."]
    """Interpolation in altitude; k n h."""
    sun_unit: Float[Array, "..."]
    """Unit coordinate of the sun's height at the nodes along the ray; k n suns, as what follows."""
    dusk: Float[Array, "..."]
    w: Float[Array, "..."]
    """sinθ sinθ_s cos φ."""
    q: Float[Array, "..."]
    """(sinθ sinθ_s)²."""


class Links(eqx.Module):
    """Rays with everything that takes moments at the nodes to the source along the rays."""

    rays: Rays
    ways: Ways
    polar: Float[Array, "i k n lm"]
    """Π_lm in the direction of the ray."""
    ground_rows: Float[Array, "i g s p j"]
    """Interpolation of the ground's irradiance where the ray ends."""


class Shell(eqx.Module):
    """All geometry of the iteration: a function of the planet's radii only, so a fit computes it once."""

    altitude: Float[Array, " i"]
    mu_s: Float[Array, " j"]
    dusk: Float[Array, " j"]
    first: Rays
    iterate: Links
    last: Links
    bottom_radius: Scalar
    top_altitude: Scalar

    def grazing(self) -> Scalar:
        """Sine of the sun's height over which the sky changes at dusk on this planet."""
        return grazing(self.bottom_radius, self.top_altitude)

    def altitude_unit(self, altitude: Altitude) -> Float[Array, "..."]:
        """Unit coordinate of an altitude, km."""
        return altitude_unit(altitude, self.top_altitude)

    def sun_unit(self, mu_s: Cosine) -> Float[Array, "..."]:
        """Unit coordinate of a sun height; not below 0, where the sky is dark."""
        return sun_unit(mu_s, self.bottom_radius, self.top_altitude)


def grazing(radius: Scalar, top: Altitude) -> Scalar:
    """:data:`GRAZING` on a planet of another shape, with a scale height of 8 % of the atmosphere's thickness."""
    return jnp.sqrt(2 * 0.08 * top / radius)


def sun_range(radius: Scalar, top: Altitude) -> tuple[Scalar, Scalar]:
    """Ends of the sun nodes in arcsinh(mu_s / grazing): from 18° and the dip of the top's horizon below, to 10° off zenith."""
    scale = grazing(radius, top)
    dip = jnp.arctan(-geometry.horizon_mu(top, radius) / safe_divide(radius, radius + top))
    lowest = -jnp.sin(jnp.minimum(jnp.radians(18.0) + dip, jnp.radians(80.0)))
    return jnp.arcsinh(lowest / scale), jnp.arcsinh(0.985 / scale)


def altitude_unit(altitude: Altitude, top: Altitude) -> Float[Array, "..."]:
    """Unit coordinate of an altitude, km."""
    return table.unstretch(jnp.clip(altitude / top, 0, 1), ALTITUDE_LINEAR)


def sun_unit(mu_s: Cosine, radius: Scalar, top: Altitude) -> Float[Array, "..."]:
    """Unit coordinate of a sun height; not below 0, where the sky is dark."""
    low, high = sun_range(radius, top)
    return jnp.maximum((jnp.arcsinh(mu_s / grazing(radius, top)) - low) / (high - low), 0)


def dusk(mu_s: Cosine, scale: Scalar) -> Float[Array, "..."]:
    """How the light falls as the sun sinks, roughly: divided out of the moments before they are interpolated.

    exp(-s²/(1 + s/4)) with s the depth of the sun in units of ``scale``: the height of the shadow over a scale height, bent
    down to what light from the side adds. A scaling only: it cancels at the nodes. Where an atmosphere is thin compared with
    its planet it ends at e^-36, whose square single precision can divide by.
    """
    depth = jnp.maximum(-mu_s, 0) / scale
    return jnp.exp(-jnp.minimum(depth * depth / (1 + depth / 4), 36))


def _link(
    altitude: Float[Array, " i"],
    mu_s: Float[Array, " j"],
    radius: Scalar,
    top: Altitude,
    count: Directions,
    degree: int,
) -> Links:
    """Rays, and the links that take moments of ``degree`` along them."""
    r = Rays.build(altitude, mu_s, radius, top, count)
    start = jnp.broadcast_to(altitude[:, None, None], r.nodes.altitude.shape)
    mu_here = geometry.mu_along(start, r.mu[..., None], r.nodes.distance, radius)
    nu = relative_nu(r.mu[..., None, None], mu_s, cosines(count.azimuths, altitude.dtype)[:, None])
    scale = grazing(radius, top)
    ground_rows = table.cubic_rows(sun_unit(r.mu_s_ground, radius, top), mu_s.size, axis=2)
    return Links(
        rays=r,
        ways=Ways(
            table.cubic_rows(altitude_unit(r.nodes.altitude, top), altitude.size),
            sun_unit(r.mu_s_here, radius, top),
            dusk(r.mu_s_here, scale),
            *plane(mu_here[..., None, None], r.mu_s_here, nu[:, :, None]),
        ),
        polar=polar(degree, mu_here),
        ground_rows=ground_rows * dusk(r.mu_s_ground, scale)[:, :, None],
    )


def build(
    bottom_radius: Scalar,
    top_altitude: Scalar,
    *,
    altitudes: int,
    suns: int,
    first: Directions,
    iterate: Directions,
    last: Directions,
    source_degree: int,
) -> Shell:
    """All geometry of a planet (radii and altitudes in km)."""
    altitude = top_altitude * table.stretch(jnp.linspace(0, 1, altitudes), ALTITUDE_LINEAR)
    low, high = sun_range(bottom_radius, top_altitude)
    scale = grazing(bottom_radius, top_altitude)
    mu_s = scale * jnp.sinh(jnp.linspace(0, 1, suns) * (high - low) + low)
    planet = altitude, mu_s, bottom_radius, top_altitude
    return Shell(
        altitude=altitude,
        mu_s=mu_s,
        dusk=dusk(mu_s, scale),
        first=Rays.build(*planet, first),
        iterate=_link(*planet, iterate, iterate.degree),
        last=_link(*planet, last, source_degree),
        bottom_radius=bottom_radius,
        top_altitude=top_altitude,
    )
