"""Single scattering only, integrated ray by ray: the seed of every sky tutorial, and the exact first order of the others."""

import jax.numpy as jnp

from diffatmo import geometry, rays, scattering, transmittance
from diffatmo._types import Altitude, Cosine, Irradiance, Length
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Sky


class RayMarch(Model):
    """Single scattering (Nishita et al. 1993) with Gauss-Legendre nodes, four pieces of ``steps`` nodes a ray."""

    steps: int = 12

    def sky(self, atmosphere: Atmosphere) -> "RayMarchSky":
        """Nothing to prepare."""
        return RayMarchSky(atmosphere, self.steps)


class RayMarchSky(Sky):
    """A sky of light scattered once, over a ground lit by the sun alone."""

    atmosphere: Atmosphere
    steps: int

    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        atmosphere, radius = self.atmosphere, self.atmosphere.bottom_radius
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        altitude, mu, mu_s, moved, misses = geometry.enter_atmosphere(
            altitude, mu, mu_s, nu, radius, atmosphere.top_altitude
        )
        ground = geometry.hits_ground(altitude, mu, radius)
        steps, nodes = self.steps, None
        if distance is not None:
            end = geometry.distance_to_boundary(altitude, mu, ground, radius, atmosphere.top_altitude)
            steps = 4 * self.steps
            nodes = rays.straight(altitude, mu, jnp.clip(distance - moved, 0, end), radius, steps)
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
