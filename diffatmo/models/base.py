"""The one interface of every sky model.

``model.sky(atmosphere)`` does the work that does not depend on where one looks and returns an immutable :class:`Sky`;
the sky answers for any batch of rays. ``sky.view(altitude=…, sun=…)`` fixes the place and the sun, which is what a camera
has: models that can exploit it return a faster :class:`View`.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Direction, Irradiance, Length, Radiance, Transmittance
from diffatmo.atmosphere import Atmosphere


class Path(NamedTuple):
    """What happens along a ray: light scattered into it, and the fraction of the light behind it that survives."""

    inscatter: Radiance
    transmittance: Transmittance


class Ray(NamedTuple):
    """Light arriving along a ray, and its transmittance to where it ends (ground or top of the atmosphere)."""

    radiance: Radiance
    transmittance: Transmittance


class View(eqx.Module):
    """A sky seen from one altitude under one sun."""

    @abstractmethod
    def radiance(self, *, view: Direction) -> Ray:
        """Radiance (ground included, sun's disc not) and transmittance along unit vectors ``view``, shape (..., 3)."""


class Sky(eqx.Module):
    """A sky ready to answer for any batch of rays."""

    atmosphere: eqx.AbstractVar[Atmosphere]

    @abstractmethod
    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer.

        ``altitude`` km, ``mu`` and ``mu_s`` the cosines of the zenith angles of view and sun, ``nu`` the cosine between
        them; all broadcast against each other. Light of the ground itself is not included.
        """

    @abstractmethod
    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""

    @abstractmethod
    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Diffuse irradiance of the sky on the ground."""

    def ground_radiance(self, *, mu_s: Cosine) -> Radiance:
        """Radiance of the Lambertian ground: albedo / π times all that falls on it (Bruneton & Neyret 2008, eq. 9)."""
        falling = self.sun_irradiance(altitude=jnp.zeros_like(mu_s), mu_s=mu_s) + self.sky_irradiance(mu_s=mu_s)
        return self.atmosphere.ground_albedo / jnp.pi * falling

    def radiance(self, *, altitude: Altitude, view: Direction, sun: Direction) -> Ray:
        """Radiance and transmittance along unit vectors ``view`` for a sun in direction ``sun``, shapes (..., 3).

        The ground is included where the ray meets it, the sun's disc is not. The frame is local: x east, y north, z up.
        """
        view = jnp.asarray(view, jnp.result_type(view, 1.0))
        altitude = jnp.asarray(altitude, dtype=view.dtype)
        mu, mu_s, nu = view[..., 2], sun[..., 2], jnp.sum(view * sun, axis=-1)
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        scattered, transmittance = self.path(altitude=altitude, mu=mu, mu_s=mu_s, nu=nu)
        radius = self.atmosphere.bottom_radius
        ground = geometry.hits_ground(altitude, mu, radius)
        to_ground = geometry.distance_down(altitude, mu, jnp.zeros_like(altitude), radius)
        mu_s_ground = ((radius + altitude) * mu_s + to_ground * nu) / radius
        below = self.ground_radiance(mu_s=jnp.clip(mu_s_ground, -1, 1))
        return Ray(scattered + jnp.where(ground[..., None], transmittance * below, 0), transmittance)

    def view(self, *, altitude: Altitude, sun: Direction) -> View:
        """This sky seen from ``altitude`` km under a sun in direction ``sun``; models may return something faster."""
        return _DirectView(self, altitude, sun)


class _DirectView(View):
    """Every ray on its own."""

    sky: Sky
    altitude: Altitude
    sun: Direction

    def radiance(self, *, view: Direction) -> Ray:
        return self.sky.radiance(altitude=self.altitude, view=view, sun=self.sun)


class Model(eqx.Module):
    """A way to compute the sky; its fields are resolutions, never physics."""

    @abstractmethod
    def sky(self, atmosphere: Atmosphere) -> Sky:
        """The sky of ``atmosphere``."""

    def finer(self) -> "Model | None":
        """The same model at a higher resolution, by which a fit judges and corrects its own; None if there is none."""
        return None
