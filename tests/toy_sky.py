"""A sky in closed form that depends on every parameter and compiles at once: for tests of the fit, not of physics."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import fitting
from diffatmo import phase
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Equirectangular
from diffatmo.models.base import Model, Ray, Sky

FREE = ["rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_scale_height", "mie_g"]
FREE += ["mie_absorption", "ozone_absorption", "ground_albedo"]


class ToySky(Sky):
    atmosphere: Atmosphere

    def path(self, **_):
        raise NotImplementedError

    def sun_irradiance(self, **_):
        raise NotImplementedError

    def sky_irradiance(self, **_):
        raise NotImplementedError

    def radiance(self, *, altitude, view, sun):
        a = self.atmosphere
        mu, mu_s = jnp.maximum(view[..., 2:], 0), jnp.abs(sun[2])
        nu = jnp.sum(view * sun, axis=-1, keepdims=True)

        def air_mass(cosine, height):
            # The bend near the horizon depends on the height, as on a round planet: it separates height from density.
            return 1 / (cosine + 0.15 * jnp.sqrt(height / 8) * jnp.exp(-3 * cosine))

        air = a.rayleigh_optical_depth * jnp.exp(-altitude / a.rayleigh_scale_height)
        haze = a.mie_optical_depth * jnp.exp(-altitude / a.mie_scale_height)
        bright = a.mie_scattering / a.mie_extinction * haze
        m_air, m_haze = air_mass(mu, a.rayleigh_scale_height), air_mass(mu, 6 * a.mie_scale_height)
        m_sun = air_mass(mu_s, a.rayleigh_scale_height)
        source = air * phase.rayleigh(nu) * m_air + bright * phase.mie(nu, a.mie_g, a.mie_phase) * m_haze
        source += a.ground_albedo * mu_s * (0.3 * air + 0.2 * bright) * m_air / (4 * jnp.pi)
        depth = 0.5 * (air * m_air + haze * m_haze + (air + haze) * m_sun) + 15 * a.ozone_absorption * m_sun
        return Ray(a.solar_irradiance * source * jnp.exp(-depth), jnp.exp(-air * m_air))


class Toy(Model):
    def sky(self, atmosphere):
        return ToySky(atmosphere)


CAMERA = Equirectangular(16, 64, upper=True)
DIRECTIONS = np.asarray(CAMERA.directions())


class Hasty(Toy):
    """The toy sky with an error that grows with the aerosol, and the toy sky itself as the finer model."""

    growth: float = 15.0

    def finer(self):
        return Toy()

    def sky(self, atmosphere):
        return HastySky(atmosphere, self.growth)


class HastySky(ToySky):
    growth: float

    def radiance(self, *, altitude, view, sun):
        exact = super().radiance(altitude=altitude, view=view, sun=sun)
        wrong = 1 - self.growth * self.atmosphere.mie_scattering * jnp.exp(4 * (view @ sun - 1))[..., None]
        return Ray(exact.radiance * wrong, exact.transmittance)


def truth() -> Atmosphere:
    return Atmosphere(
        wavelengths=[680.0, 550.0, 440.0],
        solar_irradiance=[1.0, 1.0, 1.0],
        bottom_radius=6360.0,
        top_radius=6460.0,
        rayleigh_scattering=[5.802e-3, 13.558e-3, 33.1e-3],
        rayleigh_scale_height=8.0,
        mie_scattering=[3.996e-3] * 3,
        mie_absorption=[0.444e-3] * 3,
        mie_scale_height=1.2,
        mie_g=0.8,
        ozone_absorption=[0.7e-3, 1.9e-3, 0.1e-3],
        ground_albedo=[0.3] * 3,
    )


def change(atmosphere: Atmosphere, **values) -> Atmosphere:
    """`atmosphere` with other values; numbers are spread over the wavelengths."""
    names = list(values)
    new = [jnp.broadcast_to(jnp.asarray(values[name], float), getattr(atmosphere, name).shape) for name in names]
    return eqx.tree_at(lambda a: [getattr(a, name) for name in names], atmosphere, new)


def start(factor: float = 1.3, g: float = 0.6) -> Atmosphere:
    """The truth with everything free changed by `factor`, and another g."""
    own = truth()
    return change(own, mie_g=g, **{name: factor * getattr(own, name) for name in FREE if name != "mie_g"})


@jax.jit
def _image(atmosphere, towards, directions):
    return ToySky(atmosphere).view(altitude=0.1, sun=towards).radiance(view=directions).radiance


def towards_sun(zenith: float) -> np.ndarray:
    return np.array([0.0, np.sin(np.radians(zenith)), np.cos(np.radians(zenith))])


def image(atmosphere: Atmosphere, zenith: float) -> np.ndarray:
    return np.asarray(_image(atmosphere, towards_sun(zenith), DIRECTIONS))


def observations(
    seed=0,
    noise=0.01,
    stated=None,
    zeniths=(30.0, 60.0, 80.0),
    atmosphere=None,
    factors=(1, 1, 1),
    exposure=("fixed",) * 3,
    **options,
):
    """Images of the truth under several suns, times `factors`, with relative noise (and that which is `stated`)."""
    random = np.random.default_rng(seed)
    result = []
    for zenith, factor, group in zip(zeniths, factors, exposure, strict=False):
        pixels = factor * image(truth() if atmosphere is None else atmosphere, zenith)
        noisy = pixels * (1 + noise * random.standard_normal(pixels.shape))
        settings = {"noise": stated or noise or 0.01, "name": f"sun {zenith:g}", "exposure": group} | options
        result.append(fitting.observe(noisy, camera=CAMERA, altitude=0.1, sun=towards_sun(zenith), **settings))
    return result


@functools.cache
def result() -> fitting.FitResult:
    """The fit that several tests look at."""
    return fitting.fit(observations(), init=start(), free=FREE, model=Toy())
