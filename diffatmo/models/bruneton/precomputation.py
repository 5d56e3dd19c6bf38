"""The precomputation of Bruneton & Neyret 2008, algorithm 4.1: one function per table, in the paper's order and names.

T is the transmittance, E the irradiance of the ground by the sky, S the light scattered towards a point; Δ marks what one more
order of scattering adds. Axes: ``r``, ``m`` (mu), ``v`` (nu), ``s`` (mu_s), ``w`` (wavelength).

The spherical integral of ΔJ is the paper's rule (midpoints in the polar angle and in azimuth), but in azimuth it is done term
by term of a Fourier series: at one altitude and sun the light is sampled in every direction *once*, and the phase function
turns each of its harmonics into one of ΔJ. The paper samples it anew for every direction that it is scattered into, 1024
times as often.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, phase, rays, table
from diffatmo._types import Altitude, Cosine, Irradiance, Length, Scalar
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.tables import Planet, bilinear, possible, taps
from diffatmo.models.transmittance_table import between, compute_transmittance, to_ground, to_sun, to_top, trapezoid
from diffatmo.numerics import safe_divide

Scattered = Float[Array, "r m v s w"]


TRAPEZOID, GAUSS = QUADRATURES = ("trapezoid", "gauss")
"""Along a ray: the papers' equidistant steps, or the nodes of :mod:`diffatmo.rays`, which lie where the densities change."""


class Steps(NamedTuple):
    """Quadrature counts; the defaults are those of the papers."""

    transmittance: int = 500
    single: int = 50
    multiple: int = 50
    density: int = 16
    """Directions in the polar angle for ΔJ, and as many in half the azimuth."""
    irradiance: int = 32
    """The same for ΔE, of which the upper half is used."""


class Tables(eqx.Module):
    """What the precomputation leaves behind."""

    transmittance: Float[Array, "r mu w"]
    irradiance: Float[Array, "r s w"]
    """Of the sky alone, on a horizontal plane."""
    rayleigh: Scattered
    """S without Rayleigh's phase function: single scattering by air, and all further orders divided by that function."""
    mie: Scattered
    """Single scattering by aerosol, without its phase function."""


def compute_direct_irradiance(
    atmosphere: Atmosphere, planet: Planet, transmittance: Float[Array, "r mu w"], sun_angular_radius: float
) -> Float[Array, "r s w"]:
    """ΔE of order 0: the sun on a horizontal plane; as the disc sets, the mean cosine of what is left of it."""
    altitude, mu_s = planet.irradiance_nodes()
    altitude, mu_s = jnp.broadcast_arrays(altitude[:, None], mu_s)
    a = sun_angular_radius
    setting = jnp.maximum(mu_s + a, 0) ** 2 / (4 * a)
    cosine = jnp.where(mu_s > a, mu_s, setting)
    return atmosphere.solar_irradiance * to_top(planet, transmittance, altitude, mu_s) * cosine[..., None]


class _Axes(NamedTuple):
    """The entries of S at one altitude."""

    altitude: Scalar
    mu: Float[Array, " m"]
    ground: Bool[Array, " m"]
    mu_s: Float[Array, " s"]
    nu: Float[Array, "m v s"]
    length: Length
    """To the end of the ray; m."""


def _axes(planet: Planet, altitude: Scalar) -> _Axes:
    mu, mu_s, ground = planet.mu_nodes(altitude), planet.mu_s_nodes(), planet.ground_nodes()
    nu = possible(mu[:, None, None], mu_s, planet.nu_nodes()[:, None])
    start = jnp.broadcast_to(altitude, mu.shape)
    length = geometry.distance_to_boundary(start, mu, ground, planet.bottom_radius, planet.top_altitude)
    return _Axes(altitude, mu, ground, mu_s, nu, length)


def _quadrature(planet: Planet, axes: _Axes, steps: int, rule: str) -> tuple[Float[Array, "n m"], Float[Array, "n m"]]:
    """Distances along the rays and their weights, km."""
    if rule == TRAPEZOID:
        i = jnp.arange(steps + 1)
        return axes.length * (i / steps)[:, None], axes.length * trapezoid(i, steps)[:, None]
    start = jnp.broadcast_to(axes.altitude, axes.mu.shape)
    nodes = rays.trace(
        start, axes.mu, axes.ground, planet.bottom_radius, planet.top_altitude, max(steps // rays.PIECES, 1)
    )
    return nodes.distance.T, nodes.weight.T


def _along(planet: Planet, axes: _Axes, distance: Float[Array, " m"]) -> tuple[Altitude, Cosine, Float[Array, "m v s"]]:
    """Altitude, mu and mu_s at a distance along the rays."""
    there = planet.altitude_after(axes.altitude, axes.mu, distance)
    mu = planet.cosine_after(axes.altitude, axes.mu, 1.0, distance, there)
    far = distance[:, None, None], there[:, None, None]
    return there, mu, planet.cosine_after(axes.altitude, axes.mu_s, axes.nu, *far)


def compute_single_scattering(
    atmosphere: Atmosphere,
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    sun_angular_radius: float,
    steps: int,
    quadrature: str,
) -> tuple[Scattered, Scattered]:
    """ΔS_R and ΔS_M of order 1, without phase functions (paper, eq. 7)."""

    @jax.checkpoint
    def at(altitude: Scalar) -> tuple[Array, Array]:
        axes = _axes(planet, altitude)
        start = jnp.broadcast_to(altitude, axes.mu.shape)

        def step(sums: tuple[Array, Array], node: tuple[Length, Length]) -> tuple[tuple[Array, Array], None]:
            distance, length = node
            there, _, mu_s = _along(planet, axes, distance)
            view = between(planet, transmittance, start, axes.mu, distance, axes.ground)
            # All suns of a ray share the row of the table at this altitude.
            suns = mu_s.reshape(mu_s.shape[0], -1)
            sun = to_sun(planet, transmittance, there[:, None], suns, sun_angular_radius)
            sun = sun.reshape(*mu_s.shape, -1)
            weight = length[:, None] * view
            air = weight * atmosphere.rayleigh_density(there)[:, None]
            aerosol = weight * atmosphere.mie_density(there)[:, None]
            return (sums[0] + air[:, None, None] * sun, sums[1] + aerosol[:, None, None] * sun), None

        zero = jnp.zeros((*axes.nu.shape, transmittance.shape[-1]), axes.nu.dtype)
        return jax.lax.scan(step, (zero, zero), _quadrature(planet, axes, steps, quadrature))[0]

    rayleigh, mie = jax.lax.map(at, planet.altitudes())
    light = atmosphere.solar_irradiance
    return light * atmosphere.rayleigh_scattering * rayleigh, light * atmosphere.mie_scattering * mie


Incident = Callable[[Altitude, Cosine, Cosine, Cosine, Bool[Array, "..."]], Float[Array, "... w"]]
"""Light of one order of scattering from a direction: of (altitude, mu, mu_s, nu, whether the ray meets the ground)."""


def of_first_order(atmosphere: Atmosphere, planet: Planet, rayleigh: Scattered, mie: Scattered) -> Incident:
    """ΔS_R and ΔS_M with their phase functions."""

    def light(
        altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, ground: Bool[Array, "..."]
    ) -> Float[Array, "... w"]:
        air, aerosol = (look_up(planet, part, altitude, mu, mu_s, nu, ground) for part in (rayleigh, mie))
        peak = phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)
        return phase.rayleigh(nu)[..., None] * air + peak[..., None] * aerosol

    return light


def look_up(
    planet: Planet,
    scattered: Scattered,
    altitude: Altitude,
    mu: Cosine,
    mu_s: Cosine,
    nu: Cosine,
    ground: Bool[Array, "..."],
) -> Float[Array, "... w"]:
    """S between its entries, linearly along each axis."""
    sizes = planet.sizes
    altitude, mu, mu_s, nu, ground = jnp.broadcast_arrays(altitude, mu, mu_s, nu, ground)
    positions = (
        planet.altitude_position(altitude),
        planet.mu_position(altitude, mu, ground),
        planet.nu_position(nu),
        planet.mu_s_position(mu_s),
    )
    counts = (sizes.r, sizes.mu, sizes.nu, sizes.mu_s)
    flat = scattered.reshape(-1, scattered.shape[-1])
    index, weight = jnp.zeros_like(positions[0], dtype=jnp.int32)[..., None], jnp.ones_like(positions[0])[..., None]
    for position, count in zip(positions, counts, strict=True):
        first, part = taps(position, count)
        index = (index * count + first[..., None])[..., None] + np.arange(2)
        index = index.reshape(*first.shape, -1)
        weight = (weight[..., None] * jnp.stack([1 - part, part], axis=-1)[..., None, :]).reshape(*first.shape, -1)
    return jnp.sum(flat[index] * weight[..., None], axis=-2)


def _midpoints(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Cosines of the midpoints of ``count`` equal parts of [0, π], and the weight sinθ dθ of each."""
    theta = (np.arange(count) + 0.5) * np.pi / count
    return np.cos(theta), np.sin(theta) * np.pi / count


def compute_scattering_density(
    atmosphere: Atmosphere,
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    irradiance: Float[Array, "r s w"],
    incident: Incident,
    count: int,
) -> Scattered:
    """ΔJ: light of the last order, and light of the last order reflected by the ground, scattered once more (eq. 8)."""
    cos_theta, weight = (jnp.asarray(a, transmittance.dtype) for a in _midpoints(count))
    sin_theta = geometry.sine(cos_theta)
    azimuth = jnp.asarray(np.cos((np.arange(count) + 0.5) * np.pi / count), transmittance.dtype)
    # Fourier coefficients of an even function of azimuth from its values at the midpoints.
    harmonics = jnp.asarray(table.chebyshev_coefficients(count), transmittance.dtype)

    @jax.checkpoint
    def at(altitude: Scalar) -> Array:
        axes = _axes(planet, altitude)
        start = jnp.broadcast_to(altitude, cos_theta.shape)
        ground = geometry.hits_ground(start, cos_theta, planet.bottom_radius)
        # Where the light comes from; axes θ, φ, s.
        mu, mu_s = cos_theta[:, None, None], axes.mu_s
        nu = mu * mu_s + sin_theta[:, None, None] * geometry.sine(mu_s) * azimuth[:, None]
        light = incident(altitude, mu, mu_s, nu, ground[:, None, None])
        reach = jnp.where(
            ground, geometry.distance_down(start, cos_theta, jnp.zeros_like(start), planet.bottom_radius), 0
        )
        survives = to_ground(planet, transmittance, start, cos_theta, ground)
        mu_s_ground = planet.cosine_after(altitude, mu_s, nu, reach[:, None, None], 0.0)
        falling = bilinear(irradiance, *planet.irradiance_position(jnp.zeros_like(mu_s_ground), mu_s_ground))
        reflected = (atmosphere.ground_albedo / jnp.pi * survives)[:, None, None] * falling
        light = light + jnp.where(ground[:, None, None, None], reflected, 0)
        light = jnp.einsum("nf,tfsw->ntsw", harmonics, light) * weight[:, None, None]
        # The phase functions' harmonics in the azimuth between where light comes from and where it goes.
        turn = axes.mu[:, None, None] * mu[..., 0] + (geometry.sine(axes.mu)[:, None] * sin_theta)[..., None] * azimuth
        air = phase.rayleigh(turn) @ harmonics.T
        aerosol = phase.mie(turn, atmosphere.mie_g, atmosphere.mie_phase) @ harmonics.T
        once = jnp.ones(count, turn.dtype).at[1:].set(0.5) * 2 * jnp.pi
        air_density = atmosphere.rayleigh_density(altitude) * atmosphere.rayleigh_scattering
        aerosol_density = atmosphere.mie_density(altitude) * atmosphere.mie_scattering
        scattered = air_density * jnp.einsum("mtn,ntsw->mnsw", air * once, light) + aerosol_density * jnp.einsum(
            "mtn,ntsw->mnsw", aerosol * once, light
        )
        sines = geometry.sine(axes.mu)[:, None, None] * geometry.sine(axes.mu_s)
        cosine = jnp.clip(safe_divide(axes.nu - axes.mu[:, None, None] * axes.mu_s, sines), -1, 1)
        multiples = table.chebyshev(count, cosine)
        return jnp.einsum("mvsn,mnsw->mvsw", multiples, scattered)

    return jax.lax.map(at, planet.altitudes())


def compute_indirect_irradiance(planet: Planet, incident: Incident, count: int) -> Float[Array, "r s w"]:
    """ΔE: light of one order of scattering on a horizontal plane (paper, eq. 10)."""
    altitudes, mu_s = planet.irradiance_nodes()
    cos_theta, weight = (jnp.asarray(a[: count // 2], mu_s.dtype) for a in _midpoints(count))
    azimuth = jnp.asarray(np.cos((np.arange(count) + 0.5) * np.pi / count), mu_s.dtype)
    mu = cos_theta[:, None, None]
    nu = mu * mu_s + geometry.sine(mu) * geometry.sine(mu_s) * azimuth[:, None]

    def at(altitude: Scalar) -> Array:
        light = incident(altitude, mu, mu_s, nu, jnp.zeros(nu.shape, bool))
        return 2 * jnp.pi * jnp.einsum("t,tsw->sw", weight * cos_theta, jnp.mean(light, axis=1))

    return jax.lax.map(jax.checkpoint(at), altitudes)


def compute_multiple_scattering(
    planet: Planet, transmittance: Float[Array, "r mu w"], density: Scattered, steps: int, quadrature: str
) -> Scattered:
    """ΔS: what ΔJ sends towards a point along every ray (paper, eq. 11)."""
    sizes = planet.sizes
    by_ray = density.reshape(sizes.r * sizes.mu, sizes.nu * sizes.mu_s, density.shape[-1])

    @jax.checkpoint
    def at(altitude: Scalar) -> Array:
        axes = _axes(planet, altitude)
        start = jnp.broadcast_to(altitude, axes.mu.shape)
        ray = jnp.arange(sizes.mu)[:, None, None]
        first_nu, part_nu = taps(planet.nu_position(axes.nu), sizes.nu)

        def step(total: Array, node: tuple[Length, Length]) -> tuple[Array, None]:
            distance, length = node
            there, mu, mu_s = _along(planet, axes, distance)
            # First along r and mu, which are common to all suns, then along nu and mu_s.
            (ir, fr), (im, fm) = (
                taps(planet.altitude_position(there), sizes.r),
                taps(planet.mu_position(there, mu, axes.ground), sizes.mu),
            )
            view = between(planet, transmittance, start, axes.mu, distance, axes.ground) * length[:, None]
            corners = ((0, 0, (1 - fr) * (1 - fm)), (0, 1, (1 - fr) * fm), (1, 0, fr * (1 - fm)), (1, 1, fr * fm))
            rows = sum(part[:, None, None] * by_ray[(ir + a) * sizes.mu + im + b] for a, b, part in corners)
            rows = rows * view[:, None]
            first_s, part_s = taps(planet.mu_s_position(mu_s), sizes.mu_s)
            entry = first_nu * sizes.mu_s + first_s
            light = jnp.zeros((), rows.dtype)
            for a, wa in ((0, 1 - part_nu), (1, part_nu)):
                for b, wb in ((0, 1 - part_s), (1, part_s)):
                    light = light + (wa * wb)[..., None] * rows[ray, entry + a * sizes.mu_s + b]
            return total + light, None

        zero = jnp.zeros((*axes.nu.shape, density.shape[-1]), axes.nu.dtype)
        return jax.lax.scan(step, zero, _quadrature(planet, axes, steps, quadrature))[0]

    return jax.lax.map(at, planet.altitudes())


def precompute(
    atmosphere: Atmosphere, planet: Planet, *, orders: int, steps: Steps, quadrature: str, sun_angular_radius: float
) -> Tables:
    """All tables, by the paper's algorithm 4.1 with ``orders`` orders of scattering."""
    transmittance = compute_transmittance(atmosphere, planet, steps.transmittance)
    delta_e = compute_direct_irradiance(atmosphere, planet, transmittance, sun_angular_radius)
    rayleigh, mie = compute_single_scattering(
        atmosphere, planet, transmittance, sun_angular_radius, steps.single, quadrature
    )
    irradiance, total = jnp.zeros_like(delta_e), rayleigh
    toward = jax.vmap(lambda altitude: phase.rayleigh(_axes(planet, altitude).nu))(planet.altitudes())[..., None]

    def order(incident: Incident, delta_e: Irradiance) -> tuple[Scattered, Irradiance]:
        density = compute_scattering_density(atmosphere, planet, transmittance, delta_e, incident, steps.density)
        falling = compute_indirect_irradiance(planet, incident, steps.irradiance)
        return compute_multiple_scattering(planet, transmittance, density, steps.multiple, quadrature), falling

    if orders > 1:
        delta_s, delta_e = order(of_first_order(atmosphere, planet, rayleigh, mie), delta_e)
        irradiance, total = irradiance + delta_e, total + delta_s / toward
        if orders > 2:

            def next_order(carry: Any, _: None) -> tuple[Any, None]:
                delta_s, delta_e, irradiance, total = carry
                delta_s, delta_e = order(partial(look_up, planet, delta_s), delta_e)
                return (delta_s, delta_e, irradiance + delta_e, total + delta_s / toward), None

            carry = (delta_s, delta_e, irradiance, total)
            (_, _, irradiance, total), _ = jax.lax.scan(next_order, carry, None, length=orders - 2)
    return Tables(transmittance, irradiance, total, mie)
