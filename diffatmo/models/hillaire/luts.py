"""The lookup tables of Hillaire 2020, "A Scalable and Production Ready Sky and Atmosphere Rendering Technique".

Transmittance is tabulated as by Bruneton (:mod:`diffatmo.models.tables`, parameterisation of 2017); the other tables
are the paper's own. Section and equation numbers are the paper's.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, phase
from diffatmo._types import Altitude, Cosine, Length, Radiance, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Path
from diffatmo.models.tables import Planet, bilinear
from diffatmo.models.transmittance_table import SUN_ANGULAR_RADIUS, compute_transmittance, to_sun
from diffatmo.numerics import safe_arccos, safe_divide, safe_sqrt


class Steps(NamedTuple):
    """Samples along a ray; the defaults are those of the paper and its published code."""

    transmittance: int = 40
    multiple: int = 20
    sky_view: int = 32
    march: int = 32
    directions: int = 8
    """Directions of the spherical integral of multiple scattering, squared."""


class Luts(eqx.Module):
    """The tables that do not depend on the camera."""

    transmittance: Float[Array, "r mu w"]
    multiple: Float[Array, "h s w"]
    """Ψ_ms (eq. 10) over altitude and mu_s in [-1, 1], for the given solar irradiance."""
    irradiance: Float[Array, "s w"]
    """Of the ground by the sky, over mu_s as in Bruneton's S: not in the paper, whose ground sees the sun only."""


class Medium(NamedTuple):
    """Coefficients at a point, km^-1."""

    rayleigh: Float[Array, "... w"]
    mie: Float[Array, "... w"]
    extinction: Float[Array, "... w"]

    @classmethod
    def at(cls, atmosphere: Atmosphere, altitude: Altitude) -> "Medium":
        """Those of the atmosphere at ``altitude``."""
        air = atmosphere.rayleigh_density(altitude)[..., None]
        aerosol = atmosphere.mie_density(altitude)[..., None]
        absorber = atmosphere.ozone_density(altitude)[..., None]
        rayleigh, mie = air * atmosphere.rayleigh_scattering, aerosol * atmosphere.mie_scattering
        extinction = rayleigh + aerosol * atmosphere.mie_extinction + absorber * atmosphere.ozone_absorption
        return cls(rayleigh, mie, extinction)


def _mean_survival(depth: Float[Array, "..."]) -> Float[Array, "..."]:
    """(1 - e^-x) / x: what of the light scattered along a step of optical depth x arrives at its start, on average."""
    small = depth < 1e-2
    safe = jnp.where(small, 1, depth)
    return jnp.where(small, 1 - depth / 2 + depth * depth / 6, -jnp.expm1(-safe) / safe)


def multiple_position(planet: Planet, altitude: Altitude, mu_s: Cosine, size: tuple[int, ...]) -> tuple[Array, Array]:
    """Position in Ψ_ms."""
    h, s = altitude / planet.top_altitude, (mu_s + 1) / 2
    return jnp.clip(h, 0, 1) * (size[0] - 1), jnp.clip(s, 0, 1) * (size[1] - 1)


class March(NamedTuple):
    """Sums along a ray."""

    light: Radiance
    transmittance: Transmittance


def march(
    atmosphere: Atmosphere,
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    multiple: Float[Array, "h s w"],
    altitude: Altitude,
    mu: Cosine,
    mu_s: Cosine,
    nu: Cosine,
    ends: Float[Array, "n ..."],
    *,
    every: bool = False,
) -> March:
    """Light scattered towards the start of a ray, in steps that end at ``ends`` km: section 5.5, eq. 1 with eq. 11.

    The source is that in the middle of a step, and the step's own extinction is integrated exactly (Hillaire 2015). With
    ``every`` the sums are those at the end of each step, on a leading axis, else those at the end of the ray. What
    ``altitude`` and ``mu`` have in common for several suns is computed once.
    """
    peak = phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase)[..., None]
    air = phase.rayleigh(nu)[..., None]

    def step(carry: tuple[Array, Array, Array], end: Array) -> tuple[tuple[Array, Array, Array], March | None]:
        begin, light, survives = carry
        length = end - begin
        middle = (begin + end) / 2
        here = planet.altitude_after(altitude, mu, middle)
        mu_s_here = planet.cosine_after(altitude, mu_s, nu, middle, here)
        medium = Medium.at(atmosphere, here)
        sun = atmosphere.solar_irradiance * to_sun(planet, transmittance, here, mu_s_here, SUN_ANGULAR_RADIUS)
        psi = bilinear(multiple, *multiple_position(planet, here, mu_s_here, multiple.shape[:2]))
        source = (medium.rayleigh * air + medium.mie * peak) * sun + (medium.rayleigh + medium.mie) * psi
        depth = medium.extinction * length[..., None]
        light = light + survives * source * length[..., None] * _mean_survival(depth)
        survives = survives * jnp.exp(-depth)
        return (end, light, survives), March(light, survives) if every else None

    bands = atmosphere.wavelengths.size
    rays = jnp.broadcast_shapes(altitude.shape, mu.shape, ends.shape[1:])
    dark = jnp.zeros((*jnp.broadcast_shapes(rays, mu_s.shape, nu.shape), bands), mu.dtype)
    clear = jnp.ones((*rays, bands), mu.dtype)
    (_, *last), each = jax.lax.scan(step, (jnp.zeros_like(ends[0]), dark, clear), ends)
    return March(*last) if each is None else each


def quadratic(length: Length, steps: int) -> Float[Array, "n ..."]:
    """Ends of steps that grow with distance: the air is dense where one stands."""
    fraction = (jnp.arange(1, steps + 1) / steps) ** 2
    return fraction.reshape(-1, *[1] * length.ndim) * length


def _directions(count: int) -> tuple[np.ndarray, np.ndarray]:
    """cosθ of ``count`` rings of equal solid angle, and cos φ of as many azimuths: those on one side of the sun's plane."""
    half = -(-count // 2)
    return 1 - 2 * (np.arange(count) + 0.5) / count, np.cos(np.pi * (np.arange(half) + 0.5) / half)


def compute_multiple(
    atmosphere: Atmosphere,
    planet: Planet,
    transmittance: Float[Array, "r mu w"],
    size: tuple[int, int],
    steps: int,
    directions: int,
) -> Float[Array, "h s w"]:
    """Ψ_ms (section 5.5.3): the second order L_2 and the ratio f_ms of each order to the one before, all isotropic."""
    mu_s, altitude = jnp.linspace(-1, 1, size[0]), jnp.linspace(0, 1, size[1]) * planet.top_altitude
    cosines, azimuths = (jnp.asarray(a, mu_s.dtype) for a in _directions(directions))
    # Axes: h, θ, then φ and s in one, for which the place along the ray is the same.
    start, mu = jnp.broadcast_arrays(altitude[:, None, None], cosines[:, None])
    sun_zenith = jnp.tile(mu_s, azimuths.size)
    nu = mu * sun_zenith + geometry.sine(mu) * geometry.sine(sun_zenith) * jnp.repeat(azimuths, size[0])
    ground = geometry.hits_ground(start, mu, planet.bottom_radius)
    length = geometry.distance_to_boundary(start, mu, ground, planet.bottom_radius, planet.top_altitude)
    isotropic = 1 / (4 * jnp.pi)

    def step(carry: tuple[Array, Array, Array], i: Array) -> tuple[tuple[Array, Array, Array], None]:
        second, ratio, survives = carry
        dt = length / steps
        distance = (i + 0.5) * dt
        here = planet.altitude_after(start, mu, distance)
        mu_s_here = planet.cosine_after(start, sun_zenith, nu, distance, here)
        medium = Medium.at(atmosphere, here)
        scattering = medium.rayleigh + medium.mie
        depth = medium.extinction * dt[..., None]
        within = survives * scattering * dt[..., None] * _mean_survival(depth)
        sun = to_sun(planet, transmittance, here, mu_s_here, SUN_ANGULAR_RADIUS)
        return (second + within * sun * isotropic, ratio + within, survives * jnp.exp(-depth)), None

    bands = atmosphere.wavelengths.size
    zero = jnp.zeros((*length.shape, bands), mu_s.dtype)
    dark = jnp.zeros((*nu.shape, bands), mu_s.dtype)
    (second, ratio, survives), _ = jax.lax.scan(step, (dark, zero, zero + 1), jnp.arange(steps))
    mu_s_ground = planet.cosine_after(start, sun_zenith, nu, length, 0.0)
    at_ground = to_sun(planet, transmittance, jnp.zeros_like(mu_s_ground), mu_s_ground, SUN_ANGULAR_RADIUS)
    lit = jnp.maximum(mu_s_ground, 0)[..., None] * at_ground
    reflected = atmosphere.ground_albedo / jnp.pi * survives * lit
    second = second + jnp.where(ground[..., None], reflected, 0)
    second = jnp.mean(second.reshape(*second.shape[:2], azimuths.size, size[0], bands), axis=(1, 2))
    ratio = jnp.mean(ratio, axis=1)
    # Between a white ground and conservative air the ratio nears one.
    return atmosphere.solar_irradiance * second / (1 - jnp.minimum(ratio, 0.999))


def compute(atmosphere: Atmosphere, planet: Planet, multiple_size: tuple[int, int], steps: Steps) -> Luts:
    """All tables that do not depend on the camera."""
    transmittance = compute_transmittance(atmosphere, planet, steps.transmittance)
    multiple = compute_multiple(atmosphere, planet, transmittance, multiple_size, steps.multiple, steps.directions)
    # Irradiance of the ground: the sky marched in a few directions, weighted by their cosine.
    mu_s = planet.mu_s_nodes()
    middle = (np.arange(steps.directions) + 0.5) / steps.directions
    mu = jnp.asarray(np.sqrt(middle), mu_s.dtype)[:, None]
    azimuths = jnp.repeat(jnp.asarray(np.cos(np.pi * middle), mu_s.dtype), mu_s.size)
    # Azimuths and suns in one axis, for which the place along the ray is the same.
    suns = jnp.tile(mu_s, steps.directions)
    nu = mu * suns + geometry.sine(mu) * geometry.sine(suns) * azimuths
    level = jnp.zeros_like(mu)
    length = geometry.distance_up(level, mu, planet.top_altitude, planet.bottom_radius)
    ends = quadratic(length, steps.multiple)
    light = march(atmosphere, planet, transmittance, multiple, level, mu, suns, nu, ends).light
    light = light.reshape(-1, mu_s.size, light.shape[-1])
    return Luts(transmittance, multiple, jnp.pi * jnp.mean(light, axis=0))


class SkyView(eqx.Module):
    """The sky-view table (section 5.3): scattered light from one place under one sun, by latitude about the horizon.

    v = ½ + ½ sign(l) √(|l| / l_max), with l the angle above the horizon and l_max the angle from there to the zenith (or down
    to the nadir): π/2 on the ground. Longitude is that from the sun, u = sin(φ/2): the published code's.
    """

    altitude: Scalar
    mu_s: Scalar
    horizon_angle: Scalar
    """Zenith angle of the horizon."""
    table: Float[Array, "v u w"]

    @staticmethod
    def mu_nodes(horizon_angle: Scalar, count: int) -> tuple[Float[Array, " v"], Bool[Array, " v"]]:
        """mu of the rows, the nadir's first, and which of them look at the ground."""
        half = count // 2
        x = jnp.linspace(0, 1, half)
        below = horizon_angle + (jnp.pi - horizon_angle) * x[::-1] ** 2
        above = horizon_angle * (1 - x**2)
        return jnp.cos(jnp.concatenate([below, above])), jnp.arange(2 * half) < half

    @classmethod
    def compute(
        cls,
        atmosphere: Atmosphere,
        planet: Planet,
        luts: Luts,
        altitude: Scalar,
        mu_s: Scalar,
        size: tuple[int, int],
        steps: int,
    ) -> "SkyView":
        """March along the rays of the table."""
        horizon = safe_arccos(geometry.horizon_mu(altitude, planet.bottom_radius))
        mu, ground = cls.mu_nodes(horizon, size[1])
        cosine = 1 - 2 * jnp.linspace(0, 1, size[0]) ** 2
        mu = mu[:, None]
        nu = mu * mu_s + geometry.sine(mu) * geometry.sine(mu_s) * cosine
        path = cast(atmosphere, planet, luts, altitude, mu, mu_s, nu, ground[:, None], None, steps)
        return cls(altitude, mu_s, horizon, path.inscatter)

    def look_up(self, mu: Cosine, nu: Cosine, ground: Bool[Array, "..."]) -> Radiance:
        """Scattered light in a direction; the halves above and below the horizon do not mix."""
        rows, columns = self.table.shape[:2]
        half = rows // 2
        angle = safe_arccos(mu)
        up = safe_sqrt(jnp.clip(safe_divide(self.horizon_angle - angle, self.horizon_angle), 0, 1))
        down = safe_sqrt(jnp.clip(safe_divide(angle - self.horizon_angle, jnp.pi - self.horizon_angle), 0, 1))
        v = jnp.where(ground, (half - 1) * (1 - down), half + (half - 1) * up)
        sines = geometry.sine(mu) * geometry.sine(self.mu_s)
        cosine = jnp.clip(safe_divide(nu - mu * self.mu_s, sines, 1.0), -1, 1)
        return bilinear(self.table, v, safe_sqrt((1 - cosine) / 2) * (columns - 1))


def cast(
    atmosphere: Atmosphere,
    planet: Planet,
    luts: Luts,
    altitude: Altitude,
    mu: Cosine,
    mu_s: Cosine,
    nu: Cosine,
    ground: Bool[Array, "..."] | None,
    distance: Length | None,
    steps: int,
) -> Path:
    """The ray march from anywhere to the end of the ray or to ``distance`` km."""
    radius, top = planet.bottom_radius, planet.top_altitude
    altitude, mu = jnp.broadcast_arrays(altitude, mu)
    start, mu_in, mu_s_in, moved, misses = geometry.enter_atmosphere(altitude, mu, mu_s, nu, radius, top)
    hits = geometry.hits_ground(altitude, mu, radius) if ground is None else jnp.broadcast_to(ground, mu.shape)
    end = geometry.distance_to_boundary(start, mu_in, hits, radius, top)
    if distance is not None:
        end = jnp.clip(distance - moved, 0, end)
    sums = march(
        atmosphere, planet, luts.transmittance, luts.multiple, start, mu_in, mu_s_in, nu, quadratic(end, steps)
    )
    light, survives = sums
    survives = jnp.where(misses[..., None], 1, survives)
    return Path(jnp.where(misses[..., None], 0, light), jnp.broadcast_to(survives, light.shape))
