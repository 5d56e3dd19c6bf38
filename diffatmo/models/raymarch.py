"""Single scattering only, integrated ray by ray: the seed of every sky tutorial, and the exact first order of the others."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffatmo import geometry, rays, scattering, transmittance
from diffatmo._types import Altitude, Cosine, Irradiance, Length, OpticalDepth
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Sky
from diffatmo.numerics import whole_products


class RayMarch(Model):
    """Single scattering (Nishita et al. 1993) with Gauss-Legendre nodes, four pieces of ``steps`` nodes a ray.

    With ``light_steps`` it is the naive march of the tutorials instead: ``steps`` equal steps along the view, each sampled in
    its middle, and from there ``light_steps`` equal steps towards the sun; a sample counts for nothing if one of those is below
    the ground. ``RayMarch(steps=64, light_steps=4)`` gives their numbers, errors included. Raises :class:`ValueError` for
    fewer than one step.
    """

    steps: int = 12
    light_steps: int | None = None

    def __check_init__(self) -> None:
        for name in ("steps", "light_steps"):
            count = getattr(self, name)
            if count is not None and count < 1:
                raise ValueError(f"{name}: got {count}, expected at least 1")

    @whole_products
    def sky(self, atmosphere: Atmosphere) -> "RayMarchSky":
        """Nothing to prepare."""
        return RayMarchSky(atmosphere, self.steps, self.light_steps)


def naive(
    atmosphere: Atmosphere,
    altitude: Altitude,
    mu: Cosine,
    mu_s: Cosine,
    nu: Cosine,
    length: Length,
    steps: int,
    light_steps: int,
) -> scattering.Single:
    """Single scattering over ``length`` km by midpoint sums along the view and from each sample towards the sun."""
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    heights = transmittance.scale_heights(atmosphere)
    coefficients = jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_extinction])

    def densities(h: Altitude) -> Float[Array, "3 ..."]:
        return jnp.concatenate([transmittance.exponentials(heights, h), atmosphere.ozone_density(h)[None]])

    def depth(columns: Float[Array, "3 ..."]) -> OpticalDepth:
        extinction = jnp.concatenate([coefficients, atmosphere.ozone_absorption[None]])
        return jnp.tensordot(columns, extinction, axes=(0, 0), precision="highest")

    # Axes of what follows: view samples last, then light samples.
    ds = length[..., None] / steps
    distance = (jnp.arange(steps) + 0.5) * ds
    here = geometry.altitude_along(altitude[..., None], mu[..., None], distance, radius)
    mu_s_here = geometry.mu_s_along(altitude[..., None], mu_s[..., None], nu[..., None], distance, here, radius)
    columns = densities(here) * ds
    along = jnp.cumsum(columns, axis=-1)
    dl = (geometry.distance_up(here, mu_s_here, top, radius) / light_steps)[..., None]
    towards = geometry.altitude_along(
        here[..., None], mu_s_here[..., None], (jnp.arange(light_steps) + 0.5) * dl, radius
    )
    lit = jnp.all(towards >= 0, axis=-1)
    # The air of a path through the ground would overflow; it counts for nothing.
    to_sun = jnp.sum(densities(jnp.maximum(towards, 0)) * dl, axis=-1)
    light = jnp.exp(-depth(along + to_sun)) * lit[..., None] * atmosphere.solar_irradiance
    air, aerosol = (jnp.sum(columns[i][..., None] * light, axis=-2) for i in (0, 1))
    return scattering.Single(
        atmosphere.rayleigh_scattering * air, atmosphere.mie_scattering * aerosol, (), jnp.exp(-depth(along[..., -1]))
    )


class RayMarchSky(Sky):
    """A sky of light scattered once, over a ground lit by the sun alone."""

    atmosphere: Atmosphere
    steps: int = eqx.field(static=True)
    light_steps: int | None = eqx.field(static=True)

    @whole_products
    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        atmosphere, radius = self.atmosphere, self.atmosphere.bottom_radius
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        altitude, mu, mu_s, moved, misses = geometry.enter_atmosphere(
            altitude, mu, mu_s, nu, radius, atmosphere.top_altitude
        )
        ground = geometry.hits_ground(altitude, mu, radius)
        end = geometry.distance_to_boundary(altitude, mu, ground, radius, atmosphere.top_altitude)
        if distance is not None:
            end = jnp.clip(distance - moved, 0, end)
        if self.light_steps is not None:
            single = naive(atmosphere, altitude, mu, mu_s, nu, end, self.steps, self.light_steps)
        else:
            steps, nodes = self.steps, None
            if distance is not None:
                steps = 4 * self.steps
                nodes = rays.straight(altitude, mu, end, radius, steps)
            single = scattering.integrate(atmosphere, altitude, mu, mu_s, nu, ground, steps=steps, nodes=nodes)
        light = scattering.radiance(atmosphere, single, nu)
        return Path(jnp.where(misses[..., None], 0, light), jnp.where(misses[..., None], 1, single.transmittance))

    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        falling = jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance
        return falling * transmittance.to_sun(self.atmosphere, altitude, mu_s)

    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Zero: this model's ground sees the sun only."""
        return jnp.zeros((*mu_s.shape, self.atmosphere.wavelengths.size), mu_s.dtype)
