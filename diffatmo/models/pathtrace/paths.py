"""The random walk: backward from the camera, with the sun asked at every vertex.

A path carries a weight per wavelength through vertices common to all of them. From each vertex it looks along its ray and
*must* scatter in the volume or on the ground, at a place drawn from the light expected there (:mod:`.guide`); the true
radiance over that probability goes into the weights, so nothing is lost to escape or absorption. There the direct sun is
added (next-event estimation), and the path turns by phase function, by the guide's directions, or by Lambert's cosine; the
probabilities of all the ways to the same direction are summed (Veach 1997, balance heuristic). Places and directions are
drawn for the wavelengths together, each weighted by what it still can contribute, which bounds the ratio of weights.
A path ends by Russian roulette where the light it can still find is a small part of what its ray started with.

A lane that has finished a path starts the next, so that long and short paths keep all lanes busy.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from diffatmo import geometry, phase
from diffatmo._types import Altitude, Length
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.pathtrace import columns, guide, lattice, vector
from diffatmo.models.pathtrace.guide import Expected, Guide
from diffatmo.models.pathtrace.lattice import Stream
from diffatmo.models.pathtrace.vector import Vector
from diffatmo.numerics import safe_divide

PEAK_SHARE = 0.75
"""How far the aerosol's share in scattering is followed in drawing directions from its phase function."""
GUIDE_SHARE = 0.8
"""Part of the other directions that is drawn from the guide, not from Rayleigh's phase function or Lambert's cosine."""
FLOOR = 0.02
"""Part of the places drawn evenly over the panels, in case the guide sees nothing where there is something."""
ROULETTE = 0.1
"""Expected light, relative to the start, under which a path may end."""


class Rays(NamedTuple):
    """What every lane starts from."""

    altitude: Altitude
    """km, inside the atmosphere."""
    up: Vector
    view: Vector
    sun: Vector
    reach: Length
    """Inscattering counts up to here, km."""
    ground: Bool[Array, " lanes"]
    """Whether the ground at the end of the ray counts."""


PARTS = 4
"""Parts of the light told apart: by the order of scattering 1, 2, 3 and more, and the sunlit ground seen directly."""


class State(NamedTuple):
    """A path at a vertex, about to look along its next ray."""

    altitude: Altitude
    up: Vector
    direction: Vector
    weight: Float[Array, "w lanes"]
    vertex: UInt32[Array, " lanes"]
    """How often it has been scattered or reflected."""
    stream: Stream
    total: Float[Array, "part w lanes"]
    """Of all paths of the lane."""


class Place(NamedTuple):
    """Where a path scatters next."""

    distance: Length
    on_ground: Bool[Array, " lanes"]
    density: Float[Array, " lanes"]
    """Probability per km, or of the ground."""
    columns: columns.Triple


def _draw_place(
    atmosphere: Atmosphere, ray: columns.Segment, light: Expected, u: Float[Array, " lanes"]
) -> tuple[Place, Float[Array, " lanes"]]:
    """Draw a place in proportion to the light expected from it; also the total light expected."""
    length = light.end - light.start
    mass = 0.5 * length * (light.density_start + light.density_end)
    volume = jnp.sum(mass, axis=0)
    count = mass.shape[0]
    even = FLOOR / count * volume
    mass = mass + jnp.where(length > 0, even, 0)
    cumulative = jnp.einsum("mk,k...->m...", jnp.tril(jnp.ones((count, count), mass.dtype)), mass, precision="highest")
    everything = cumulative[-1] + light.ground
    aim = u * everything
    on_ground = (aim >= cumulative[-1]) & (light.ground > 0)

    panel = jnp.minimum(jnp.sum(cumulative <= aim, axis=0), count - 1)
    flat = panel * u.size + jnp.arange(u.size)

    def pick(values: Float[Array, "panel lanes"]) -> Float[Array, " lanes"]:
        return values.reshape(-1)[flat]

    mass, length, start = pick(mass), pick(length), pick(light.start)
    low, high = (pick(density) + safe_divide(even, length) for density in (light.density_start, light.density_end))
    inside = jnp.clip(safe_divide(aim - (pick(cumulative) - mass), mass), 0, 1)
    # The inverse of the cumulative distribution of a density that runs linearly from `low` to `high`.
    slope = safe_divide(high - low, high + low)
    root = jnp.sqrt((1 - slope) * (1 - slope) + 4 * slope * inside)
    inside = jnp.clip(safe_divide(2 * inside, 1 - slope + root), 0, 1)
    step = inside * length

    there = geometry.altitude_along(ray.altitude, ray.mu, start, atmosphere.bottom_radius)
    partial, _, _ = columns.over(atmosphere, ray, start, start + step, columns.densities(atmosphere, there))
    before = columns.add((pick(light.before[0]), pick(light.before[1]), pick(light.before[2])), partial)
    density = safe_divide(jnp.where(on_ground, light.ground, low + (high - low) * inside), everything)
    behind = tuple(jnp.where(on_ground, a, b) for a, b in zip(light.whole, before, strict=True))
    distance = jnp.where(on_ground, ray.length, start + step)
    return Place(distance, on_ground, density, behind), everything


def _turn(
    atmosphere: Atmosphere,
    tables: Guide,
    altitude: Altitude,
    up: Vector,
    direction: Vector,
    sun: Vector,
    on_ground: Bool[Array, " lanes"],
    aerosol: Float[Array, " lanes"],
    u: Float[Array, " lanes"],
    v: Float[Array, " lanes"],
) -> tuple[Vector, tuple[Float[Array, " lanes"], Float[Array, " lanes"], Float[Array, " lanes"]]]:
    """Draw a new direction.

    ``aerosol`` is the aerosol's share in the scattering. Returns the direction and, divided by its probability, the phase
    functions of air and aerosol and Lambert's cosine / π there.
    """
    radius, g, name = atmosphere.bottom_radius, atmosphere.mie_g, atmosphere.mie_phase
    peak = jnp.where(on_ground, 0, PEAK_SHARE * aerosol)
    guided = (1 - peak) * GUIDE_SHARE
    plain = 1 - peak - guided
    by_peak = u < peak
    by_guide = ~by_peak & (u < peak + guided)
    u_peak, u_guide, u_plain = (
        jnp.clip(safe_divide(u - low, share), 0, 1)
        for low, share in ((0.0, peak), (peak, guided), (peak + guided, plain))
    )

    node = guide.cell(altitude, vector.cosine(up, sun), atmosphere.top_altitude)
    horizon = geometry.horizon_mu(altitude, radius)
    guide_mu, guide_azimuth = guide.sample_direction(tables, node, horizon, u_guide, v)
    turned = jnp.where(by_peak, phase.sample_mie(u_peak, g, name), phase.sample_rayleigh(u_plain))
    turned = jnp.where(by_guide, guide_mu, jnp.where(on_ground, jnp.sqrt(u_plain), jnp.clip(turned, -1, 1)))
    azimuth = jnp.where(by_guide, guide_azimuth, 2 * jnp.pi * v)
    new = vector.around(vector.where(on_ground | by_guide, up, direction), sun, turned, azimuth)

    mu, cos_turn = vector.cosine(up, new), vector.cosine(direction, new)
    cos_azimuth = safe_divide(vector.dot(new, vector.towards(up, sun)), geometry.sine(mu))
    lambert = jnp.maximum(mu, 0) / jnp.pi
    air = phase.rayleigh(cos_turn)
    probability = (
        plain * jnp.where(on_ground, lambert, air)
        + peak * phase.sampled_density(cos_turn, g, name)
        + guided * guide.direction_density(tables, node, horizon, mu, cos_azimuth)
    )
    dust = phase.mie(cos_turn, g, name)
    return new, (air / probability, dust / probability, lambert / probability)


def balance(atmosphere: Atmosphere, tables: Guide, rays: Rays, panels: int) -> Float[Array, "w lanes"]:
    """One over the radiance expected along each lane's ray: what makes wavelengths comparable."""
    radius = atmosphere.bottom_radius
    mu, mu_s, nu = (vector.cosine(*pair) for pair in ((rays.up, rays.view), (rays.up, rays.sun), (rays.view, rays.sun)))
    hits = geometry.hits_ground(rays.altitude, mu, radius)
    ray = columns.segment(atmosphere, rays.altitude, mu, hits)
    count = atmosphere.wavelengths.size

    def one(k: Array) -> Float[Array, " lanes"]:
        light = guide.expected(
            atmosphere,
            tables,
            ray,
            mu_s,
            nu,
            jnp.broadcast_to((jnp.arange(count) == k).astype(mu.dtype)[:, None], (count, mu.size)),
            end=jnp.minimum(rays.reach, ray.length),
            sees_ground=hits & rays.ground & (rays.reach >= ray.length),
            jitter=jnp.full_like(mu, 0.5),
            panels=panels,
        )
        length = light.end - light.start
        return jnp.sum(0.5 * length * (light.density_start + light.density_end), axis=0) + light.ground

    radiance = jax.lax.map(one, jnp.arange(count))
    return jnp.where(radiance > guide.DARK, 1 / jnp.maximum(radiance, guide.DARK), 0)


def trace(
    atmosphere: Atmosphere,
    tables: Guide,
    rays: Rays,
    key: tuple[UInt32[Array, " lanes"], UInt32[Array, " lanes"]],
    first: UInt32[Array, " lanes"],
    *,
    count: int,
    stride: int,
    panels: int,
    hemisphere: bool = False,
    apart: bool = False,
) -> Float[Array, "part w lanes"]:
    """Sum over each lane's samples ``first``, ``first + stride``, … below ``count`` (a power of two) of the radiance.

    With ``hemisphere`` the sky's irradiance on the horizontal plane at ``rays.altitude`` instead, whatever their view. All
    light is one part, unless the ``PARTS`` are wanted ``apart``.
    """
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    dtype = rays.altitude.dtype
    albedo, solar = atmosphere.ground_albedo[:, None], atmosphere.solar_irradiance[:, None]
    beta = columns.scattering(atmosphere)[..., None]
    log2_count = int(math.log2(count))
    wavelengths = albedo.shape[0]
    start = jnp.ones_like(first)
    importance = balance(atmosphere, tables, rays, panels)
    everywhere = jnp.ones_like(rays.ground)
    parts = np.arange(PARTS if apart else 1)[:, None]

    def step(state: State) -> State:
        stream = state.stream
        fresh = stream.dimension == start
        altitude = jnp.where(fresh, rays.altitude, state.altitude)
        up = vector.where(fresh, rays.up, state.up)
        view, weight = rays.view, jnp.ones_like(state.weight)
        if hemisphere:
            u, v = (lattice.even(stream, axis, log2_count, dtype) for axis in (3, 4))
            view, (_, _, lambert) = _turn(
                atmosphere, tables, rays.altitude, rays.up, rays.up, rays.sun, everywhere, jnp.zeros_like(u), u, v
            )
            weight = weight * jnp.pi * lambert
        direction = vector.where(fresh, view, state.direction)
        weight = jnp.where(fresh, weight, state.weight)

        mu, mu_s, nu = (vector.cosine(*pair) for pair in ((up, direction), (up, rays.sun), (direction, rays.sun)))
        hits = geometry.hits_ground(altitude, mu, radius)
        ray = columns.segment(atmosphere, altitude, mu, hits)
        reach = jnp.where(fresh, jnp.minimum(rays.reach, ray.length), ray.length)
        light = guide.expected(
            atmosphere,
            tables,
            ray,
            mu_s,
            nu,
            weight * importance,
            end=reach,
            sees_ground=hits & (reach >= ray.length) & (rays.ground | ~fresh),
            jitter=lattice.independent(stream, 0, dtype),
            panels=panels,
        )
        place, expected = _draw_place(atmosphere, ray, light, lattice.even(stream, 0, log2_count, dtype))
        survival = jnp.where(fresh, 1, jnp.minimum(1, expected / (ROULETTE * wavelengths)))
        survives = (lattice.independent(stream, 1, dtype) < survival) & (expected > 0)
        chance = safe_divide(jnp.ones_like(survival), survival * place.density)
        weight = jnp.where(survives, weight * chance * columns.transmittance(atmosphere, place.columns), 0)

        # The vertex: what it scatters of the sun, and where the path goes on.
        on_ground = place.on_ground
        up = vector.unit(vector.combine((radius + altitude, up), (place.distance, direction)))
        there = jnp.clip(geometry.altitude_along(altitude, mu, place.distance, radius), 0, top)
        altitude = jnp.where(on_ground, 0, there)
        mu_s = vector.cosine(up, rays.sun)
        density = columns.densities(atmosphere, altitude)
        air, dust = beta[0] * density[0], beta[1] * density[1]
        to_sun = columns.to_top(atmosphere, altitude, mu_s, lattice.independent(stream, 2, dtype), panels)
        once = air * phase.rayleigh(nu) + dust * phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
        once = jnp.where(on_ground, albedo * jnp.maximum(mu_s, 0) / jnp.pi, once)
        vertex = jnp.where(fresh, 0, state.vertex)
        part = jnp.where((vertex == 0) & on_ground, PARTS - 1, jnp.minimum(vertex, PARTS - 2)) if apart else 0 * vertex
        total = state.total + (part == parts)[:, None] * (weight * once * to_sun * solar)

        by_air, by_dust = (jnp.sum(importance * weight * part, axis=0) for part in (air, dust))
        share = safe_divide(by_dust, by_air + by_dust)
        u, v = (lattice.even(stream, axis, log2_count, dtype) for axis in (1, 2))
        direction, (air_phase, dust_phase, lambert) = _turn(
            atmosphere, tables, altitude, up, direction, rays.sun, on_ground, share, u, v
        )
        weight = weight * jnp.where(on_ground, albedo * lambert, air * air_phase + dust * dust_phase)

        goes_on = survives & (jnp.max(weight, axis=0) > 0)
        working = stream.index < count
        dimension = jnp.where(goes_on, lattice.advance(stream.dimension, 5 if hemisphere else 3), start)
        index = jnp.where(goes_on | ~working, stream.index, stream.index + stride)
        total = jnp.where(working, total, state.total)
        return State(altitude, up, direction, weight, vertex + 1, Stream(stream.key, index, dimension), total)

    nothing = jnp.zeros((parts.size, wavelengths, first.size), dtype)
    stream = Stream(key, first, start)
    state = State(rays.altitude, rays.up, rays.view, nothing[0], 0 * first, stream, nothing)
    return jax.lax.while_loop(lambda state: jnp.any(state.stream.index < count), step, state).total
