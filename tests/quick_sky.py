"""A sky of a few operations and images of it, for tests of the command line: quick, smooth, and nothing like a sky."""

import math

import jax.numpy as jnp
import numpy as np

from diffatmo import atmosphere, scene, sun
from diffatmo.camera import Equirectangular
from diffatmo.models.base import Model, Sky
from diffatmo.models.base import Path as RayPath
from diffatmo.render import Scene

TOY_FREE = ["--free", "rayleigh_scattering,mie_g"]


class Toy(Model):
    """Light in proportion to the coefficients; nothing like a sky, but quick, smooth and different for every ray."""

    def sky(self, atmosphere):
        return ToySky(atmosphere)


class ToySky(Sky):
    atmosphere: atmosphere.Atmosphere

    def path(self, *, altitude, mu, mu_s, nu, distance=None):
        air = self.atmosphere
        molecules = air.rayleigh_scattering * (1 + nu[..., None] ** 2) * (2 + mu_s[..., None])
        aerosol = air.mie_scattering * jnp.exp(air.mie_g * nu[..., None]) * (2 - mu[..., None])
        transmittance = jnp.exp(-air.rayleigh_scattering / (1 + altitude[..., None]))
        return RayPath(molecules + aerosol, transmittance)

    def sun_irradiance(self, *, altitude, mu_s):
        return jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance

    def sky_irradiance(self, *, mu_s):
        return jnp.zeros((*mu_s.shape, self.atmosphere.wavelengths.size), mu_s.dtype)


def toy_image(path, air, *, zenith, noise=0.01, seed=0, height=8, width=32):
    """An image of the toy sky with its scene in the header."""
    camera = Equirectangular(height, width, upper=True)
    towards = sun.direction(zenith=math.radians(zenith), azimuth=0.3)
    view = camera.directions()
    pixels = np.asarray(ToySky(air).radiance(altitude=jnp.asarray(0.1), view=view, sun=towards).radiance)
    pixels = pixels * (1 + noise * np.random.default_rng(seed).standard_normal(pixels.shape))
    scene.save(path, pixels.astype(np.float32), Scene(air, camera, 0.1, towards), notes={"noise": noise})
    return str(path)
