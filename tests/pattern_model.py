"""A sky whose radiance is a sum of patterns, linear in the ground's albedo, ozone, and one over the aerosol's scale height."""

import jax.numpy as jnp
import numpy as np
import toy_sky

import fitting
from diffatmo.models.base import Ray


class PatternSky(toy_sky.ToySky):
    def radiance(self, *, altitude, view, sun):
        a = self.atmosphere
        x, y, z = (view[..., axis, None] for axis in range(3))
        value = 1 + a.ground_albedo * (0.5 + x) + 100 * a.ozone_absorption * (0.6 + x * z) + y / a.mie_scale_height
        return Ray(a.solar_irradiance * value, jnp.ones_like(value))


class Pattern(toy_sky.Toy):
    def sky(self, atmosphere):
        return PatternSky(atmosphere)


class TwinSky(toy_sky.ToySky):
    def radiance(self, *, altitude, view, sun):
        value = 1 + (self.atmosphere.mie_g**2 + self.tilt * self.atmosphere.mie_g) * view[..., 2:] * jnp.ones(3)
        return Ray(value, jnp.ones_like(value))

    tilt: float


class Twin(toy_sky.Toy):
    """Two values of g look alike, exactly if ``tilt`` is zero: g² + tilt g."""

    tilt: float = 0.0

    def sky(self, atmosphere):
        return TwinSky(atmosphere, self.tilt)


SUN = toy_sky.towards_sun(60)


def observation(model, atmosphere, noise=0.02, stated=None, seed=0, **options):
    """An image with the same noise in every pixel, so that least squares is linear where the model is."""
    view = model.sky(atmosphere).view(altitude=0.1, sun=SUN).radiance(view=toy_sky.DIRECTIONS).radiance
    pixels = np.asarray(view) + noise * np.random.default_rng(seed).standard_normal(view.shape)
    said = {"noise": 0.0, "noise_floor": stated or noise, "camera": toy_sky.CAMERA, "altitude": 0.1, "sun": SUN}
    return fitting.observe(pixels, **said | options)
