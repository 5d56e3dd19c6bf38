"""Geometry of the iteration: where the nodes are and how rays connect them. Depends on the planet's radii only."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, rays, table
from diffatmo._types import Altitude, Cosine, Scalar
from diffatmo.models.moments.angular import cosines, orders, pairs, plane, polar, projection, relative_nu
from diffatmo.numerics import arcsinh, gauss_legendre, once, safe_divide
from diffatmo.rays import Nodes

ALTITUDE_LINEAR = 0.04
"""Linear part of the map of altitude nodes (clusters them in the aerosol layer)."""

DIRECTION_LINEAR = 0.02
"""Linear part of the map of direction nodes on either side of the horizon."""

GRAZING = 0.05
"""sqrt(2 * 8 km / 6360 km): the sine of the sun's height over which the sky changes at dusk. Scales with the planet."""

HIGH_SUN = 1.6
"""Square of the poles of the map of sun heights. The moments of a phase function with a peak are polynomials of a high degree
in mu_s, which change fastest towards the zenith: there the nodes have to be close in angle."""


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
    nodes: Nodes
    mu_s_here: Float[Array, "i k n p j"]
    mu_s_ground: Float[Array, "i g p j"]
    azimuths: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)


class Ways(NamedTuple):
    """What takes moments at the nodes of the shell to the light scattered along ``k`` rays.

    The interpolation in the sun's height is kept as stencils, and made dense where it is used: all its rows would be the
    largest array by far. ``suns`` stands for one or more axes over suns; in :class:`Links` axis ``i`` comes first.
    """

    altitude_rows: Float[Array, "..."]
    """Interpolation in altitude; k n h."""
    sun: table.Stencil
    """Interpolation in the sun's height at the nodes along the ray, times ``dusk`` there; k n suns, as what follows."""
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


def _along_suns(mu_s: Cosine, scale: Scalar) -> Float[Array, "..."]:
    """A coordinate in which sun nodes are equidistant: close at the horizon, on the ``scale`` of dusk, and at the zenith."""
    return arcsinh(mu_s / (1 - mu_s * mu_s / HIGH_SUN) / scale)


def _sun_at(along: Float[Array, "..."], scale: Scalar) -> Cosine:
    """The inverse of :func:`_along_suns`."""
    bent = scale * jnp.sinh(along)
    return 2 * bent / (1 + jnp.sqrt(1 + 4 / HIGH_SUN * bent * bent))


def sun_range(radius: Scalar, top: Altitude) -> tuple[Scalar, Scalar]:
    """Ends of the sun nodes in their coordinate: from 18° and the dip of the top's horizon below, to 10° off zenith."""
    scale = grazing(radius, top)
    dip = jnp.arctan(-geometry.horizon_mu(top, radius) / safe_divide(radius, radius + top))
    lowest = -jnp.sin(jnp.minimum(jnp.radians(18.0) + dip, jnp.radians(80.0)))
    return _along_suns(lowest, scale), _along_suns(jnp.asarray(0.985, scale.dtype), scale)


def altitude_unit(altitude: Altitude, top: Altitude) -> Float[Array, "..."]:
    """Unit coordinate of an altitude, km."""
    return table.unstretch(jnp.clip(altitude / top, 0, 1), ALTITUDE_LINEAR)


def sun_unit(mu_s: Cosine, radius: Scalar, top: Altitude) -> Float[Array, "..."]:
    """Unit coordinate of a sun height; not below 0, where the sky is dark."""
    low, high = sun_range(radius, top)
    return once(jnp.maximum((_along_suns(mu_s, grazing(radius, top)) - low) / (high - low), 0))


def dusk(mu_s: Cosine, scale: Scalar) -> Float[Array, "..."]:
    """How the light falls as the sun sinks, roughly: divided out of the moments before they are interpolated.

    exp(-s²/(1 + s/4)) with s the depth of the sun in units of ``scale``: the height of the shadow over a scale height, bent
    down to what light from the side adds. A scaling only: it cancels at the nodes. Where an atmosphere is thin compared with
    its planet it ends at e^-36, whose square single precision can divide by.
    """
    depth = jnp.maximum(-mu_s, 0) / scale
    return jnp.exp(-jnp.minimum(depth * depth / (1 + depth / 4), 36))


class _Bundle(NamedTuple):
    """Rays of several sets of directions as one, so that the compiler has to see their geometry once.

    All pieces have as many places for nodes as those of the set with the most; the ``k`` axis holds one set after another.
    """

    mu: Float[Array, "i k"]
    solid_angle: Float[Array, "i k"]
    nodes: Nodes
    """Axes i, k, piece, place."""

    @classmethod
    def trace(
        cls, altitude: Float[Array, " i"], radius: Scalar, top: Altitude, counts: Sequence[Directions]
    ) -> "_Bundle":
        """Gauss-Legendre directions on either side of each node's horizon, and the ray into each of them."""
        dtype = altitude.dtype
        sides = [gauss_legendre(number) for count in counts for number in (count.sky, count.ground)]
        unit, w = (jnp.asarray(np.concatenate(parts), dtype) for parts in zip(*sides, strict=True))
        ground = np.concatenate([np.arange(count.sky + count.ground) >= count.sky for count in counts])
        horizon = geometry.horizon_mu(altitude, radius)[:, None]
        span = jnp.where(ground, -1, 1) - horizon
        slope = DIRECTION_LINEAR + 2 * (1 - DIRECTION_LINEAR) * unit
        mu, span = once((horizon + span * table.stretch(unit, DIRECTION_LINEAR), span))
        places = np.zeros((2, len(ground), 1, max(count.steps for count in counts)), dtype)
        for count, rows in zip(counts, _parts(counts), strict=True):
            places[:, rows, :, : count.steps] = np.stack(rays.rule(count.steps, dtype.name)[:2])[:, None, None]
        start = jnp.broadcast_to(altitude[:, None], mu.shape)
        nodes = rays.place(start, mu, jnp.broadcast_to(ground, mu.shape), radius, top, *places)
        return cls(mu, jnp.abs(span) * w * slope, nodes)


def _parts(counts: Sequence[Directions]) -> list[slice]:
    """Where each set lies on the axis of all directions."""
    ends = np.cumsum([count.sky + count.ground for count in counts])
    return [slice(end - count.sky - count.ground, end) for count, end in zip(counts, ends, strict=True)]


def _at_nodes(places: Float[Array, "i k piece place ..."], steps: int) -> Float[Array, "i k n ..."]:
    """What stands at the nodes of a set with so many on each piece."""
    i, k, pieces, _, *more = places.shape
    return places[:, :, :, :steps].reshape(i, k, pieces * steps, *more)


def _rays(
    altitude: Float[Array, " i"],
    mu_s: Float[Array, " j"],
    radius: Scalar,
    bundle: _Bundle,
    counts: Sequence[Directions],
) -> list[Rays]:
    """Each set of a bundle, with the sun's height along its rays."""
    most = max(count.degree for count in counts)
    project = bundle.solid_angle[..., None] * projection(most, bundle.mu)
    powers = [jnp.ones_like(mu_s)]
    for _ in range(most):
        powers.append(powers[-1] / geometry.sine(mu_s))
    sun_scale = jnp.stack(powers)[orders(most)]
    found = []
    for count, part in zip(counts, _parts(counts), strict=True):
        nodes = Nodes(*(_at_nodes(places[:, part], count.steps) for places in bundle.nodes))
        mu, moments = bundle.mu[:, part], len(pairs(count.degree))
        nu = relative_nu(mu[..., None, None], mu_s, cosines(count.azimuths, altitude.dtype)[:, None])
        along = nodes.distance[..., None, None], nodes.altitude[..., None, None], radius
        start = altitude[:, None, None, None]
        mu_s_here = geometry.mu_s_along(start[..., None], mu_s, nu[:, :, None], *along)
        reach = jnp.sum(nodes.weight, axis=-1)[:, count.sky :, None, None]
        mu_s_ground = geometry.mu_s_along(start, mu_s, nu[:, count.sky :], reach, jnp.zeros_like(start), radius)
        found.append(
            Rays(
                mu,
                bundle.solid_angle[:, part],
                project[:, part, :moments],
                sun_scale[:moments],
                jnp.arange(count.sky + count.ground) >= count.sky,
                nodes,
                mu_s_here,
                jnp.clip(mu_s_ground, -1, 1),
                count.azimuths,
                count.steps,
            )
        )
    return found


def _links(
    altitude: Float[Array, " i"],
    mu_s: Float[Array, " j"],
    radius: Scalar,
    top: Altitude,
    bundle: _Bundle,
    sets: Sequence[Rays],
    degrees: Sequence[int],
) -> list[Links]:
    """The last sets of a bundle, and the links that take moments of the given degrees along each of them."""
    skipped = bundle.mu.shape[1] - sum(r.mu.shape[1] for r in sets)
    here = jax.tree.map(lambda x: x[:, skipped:], bundle)
    mu_here = geometry.mu_along(
        altitude[:, None, None, None], here.mu[..., None, None], here.nodes.distance, here.nodes.altitude, radius
    )
    altitude_rows = table.cubic(altitude_unit(here.nodes.altitude, top), altitude.size).rows(altitude.size)
    angular = polar(max(degrees), mu_here)
    # The sun's height at every node of every set, then at the ground.
    suns = [part for r in sets for part in (r.mu_s_here, r.mu_s_ground)]
    flat = jnp.concatenate([part.reshape(altitude.size, -1, mu_s.size) for part in suns], axis=1)
    ends = np.cumsum([part[0, ..., 0].size for part in suns])
    stencil = table.cubic(sun_unit(flat, radius, top), mu_s.size).scaled(dusk(flat, grazing(radius, top)))
    stencils = [
        jax.tree.map(lambda x, sun=sun, end=end: x[:, end - sun[0, ..., 0].size : end].reshape(sun.shape), stencil)
        for sun, end in zip(suns, ends, strict=True)
    ]
    found, first = [], 0
    for number, (r, degree) in enumerate(zip(sets, degrees, strict=True)):
        part = slice(first, first + r.mu.shape[1])
        first = part.stop
        sun_here, sun_ground = stencils[2 * number : 2 * number + 2]
        nu = relative_nu(r.mu[..., None, None], mu_s, cosines(r.azimuths, altitude.dtype)[:, None])
        there = _at_nodes(mu_here[:, part], r.steps)[..., None, None]
        ways = Ways(
            _at_nodes(altitude_rows[:, part], r.steps),
            sun_here,
            *plane(there, r.mu_s_here, nu[:, :, None]),
        )
        angular_here = _at_nodes(angular[:, part, ..., : len(pairs(degree))], r.steps)
        ground_rows = sun_ground.rows(mu_s.size, axis=2)
        found.append(Links(rays=r, ways=ways, polar=angular_here, ground_rows=ground_rows))
    return found


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
    altitude = once(top_altitude * table.stretch(jnp.linspace(0, 1, altitudes), ALTITUDE_LINEAR))
    low, high = sun_range(bottom_radius, top_altitude)
    scale = grazing(bottom_radius, top_altitude)
    mu_s = once(_sun_at(jnp.linspace(0, 1, suns) * (high - low) + low, scale))
    counts = first, iterate, last
    bundle = _Bundle.trace(altitude, bottom_radius, top_altitude, counts)
    first_rays, *sets = _rays(altitude, mu_s, bottom_radius, bundle, counts)
    again, finally_ = _links(altitude, mu_s, bottom_radius, top_altitude, bundle, sets, (iterate.degree, source_degree))
    return Shell(
        altitude=altitude,
        mu_s=mu_s,
        dusk=dusk(mu_s, scale),
        first=first_rays,
        iterate=again,
        last=finally_,
        bottom_radius=bottom_radius,
        top_altitude=top_altitude,
    )
