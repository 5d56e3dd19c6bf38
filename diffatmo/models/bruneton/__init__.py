"""Precomputed atmospheric scattering (Bruneton & Neyret 2008, and Bruneton's revision of 2017), as it is.

The tables are computed by :mod:`.precomputation` over the coordinates of :mod:`diffatmo.models.tables`. What the method costs
in accuracy is part of it: linear interpolation of eight entries in nu, the product of all further orders with Rayleigh's phase
function, ratios of transmittances. Where that matters, :class:`~diffatmo.models.moments.Moments` is the model to use.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, phase, transmittance
from diffatmo._types import Altitude, Cosine, Irradiance, Length, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Model, Path, Sky
from diffatmo.models.bruneton.precomputation import GAUSS, QUADRATURES, TRAPEZOID, Steps, Tables, look_up, precompute
from diffatmo.models.tables import PARAMETERISATIONS, Planet, Sizes, bilinear
from diffatmo.models.transmittance_table import SUN_ANGULAR_RADIUS, between, to_ground, to_sun, to_top
from diffatmo.numerics import safe_divide, tiny, whole_products

__all__ = ["Bruneton", "BrunetonSky", "Planet", "Sizes", "Steps", "Tables"]


class Bruneton(Model):
    """The model of Bruneton & Neyret 2008; ``parameterisation`` "2008" or "2017" says where the entries of its tables are.

    ``packed`` keeps aerosol's single scattering at one wavelength only, the first, as the paper does with its red channel, and
    recovers it at the others from the single scattering by air (paper, section 4).

    ``quadrature`` is "trapezoid", the papers' equidistant steps along a ray, or "gauss". The steps are 2 km long towards the
    zenith, longer than aerosol is high: at a scale height of 1.2 km they make its column 22 % too large (x coth(x), x half a
    step over the scale height), and that once for each order of scattering. Gauss's rule does it right with a fifth of the
    nodes.

    Raises :class:`ValueError` for sizes that cannot be.
    """

    parameterisation: str = "2017"
    sizes: Sizes = Sizes()
    steps: Steps = Steps()
    orders: int = 4
    quadrature: str = TRAPEZOID
    mu_s_min: float = -0.2
    """Cosine of the lowest sun that the tables of 2017 know."""
    sun_angular_radius: float = SUN_ANGULAR_RADIUS
    packed: bool = False

    def __check_init__(self) -> None:
        if self.parameterisation not in PARAMETERISATIONS:
            known = " or ".join(repr(name) for name in PARAMETERISATIONS)
            raise ValueError(f"parameterisation: got {self.parameterisation!r}, expected {known}")
        if self.quadrature not in QUADRATURES:
            known = " or ".join(repr(name) for name in QUADRATURES)
            raise ValueError(f"quadrature: got {self.quadrature!r}, expected {known}")
        for name, count in self.sizes._asdict().items():
            least = 4 if name == "mu" else 2
            if count < least or (name == "mu" and count % 2):
                expected = f"an even number of at least {least}" if name == "mu" else f"at least {least}"
                raise ValueError(f"sizes.{name}: got {count}, expected {expected}")
        for name, count in self.steps._asdict().items():
            if count < 2:
                raise ValueError(f"steps.{name}: got {count}, expected at least 2")
        if self.orders < 1:
            raise ValueError(f"orders: got {self.orders}, expected at least 1")

    @classmethod
    def reduced(cls) -> "Bruneton":
        """Smaller tables and fewer steps, for fits."""
        return cls(sizes=Sizes(32, 128, 8, 32, 16, 64, 24, 8), steps=Steps(64, 10, 10, 16, 16), quadrature=GAUSS)

    def planet(self, atmosphere: Atmosphere) -> Planet:
        """The coordinates of the tables."""
        radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
        return Planet(radius, top, self.mu_s_min, self.sizes, self.parameterisation)

    @whole_products
    def sky(self, atmosphere: Atmosphere) -> "BrunetonSky":
        """Precompute the tables."""
        planet = self.planet(atmosphere)
        tables = precompute(
            atmosphere, planet, orders=self.orders, steps=self.steps, quadrature=self.quadrature,
            sun_angular_radius=self.sun_angular_radius,
        )  # fmt: skip
        return BrunetonSky(atmosphere, planet, tables, self.sun_angular_radius, self.packed)


class BrunetonSky(Sky):
    """The tables of one atmosphere."""

    atmosphere: Atmosphere
    planet: Planet
    tables: Tables
    sun_angular_radius: float = eqx.field(static=True)
    packed: bool = eqx.field(static=True)

    @whole_products
    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        planet, radius, top = self.planet, self.planet.bottom_radius, self.planet.top_altitude
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        altitude, mu, mu_s, moved, misses = geometry.enter_atmosphere(altitude, mu, mu_s, nu, radius, top)
        ground = geometry.hits_ground(altitude, mu, radius)
        end = geometry.distance_to_boundary(altitude, mu, ground, radius, top)
        air, aerosol = self._scattered(altitude, mu, mu_s, nu, ground)
        down = to_ground(planet, self.tables.transmittance, altitude, mu, ground)
        survives = jnp.where(ground[..., None], down, to_top(planet, self.tables.transmittance, altitude, mu))
        if distance is not None:
            # S(a→b) = S(a→c) - T(a→b) S(b→c), c the end of the ray (paper, section 4).
            reach = jnp.clip(distance - moved, 0, end)
            whole = reach >= end
            there = planet.altitude_after(altitude, mu, reach)
            mu_there = planet.cosine_after(altitude, mu, 1.0, reach, there)
            part = self._between(altitude, mu, there, mu_there, reach, ground)
            survives = jnp.where(whole[..., None], survives, part)
            mu_s_there = planet.cosine_after(altitude, mu_s, nu, reach, there)
            beyond = self._scattered(there, mu_there, mu_s_there, nu, ground)
            air, aerosol = (
                jnp.where(whole[..., None], all_of_it, jnp.maximum(all_of_it - part * rest, 0))
                for all_of_it, rest in zip((air, aerosol), beyond, strict=True)
            )
        light = (
            phase.rayleigh(nu)[..., None] * air
            + phase.mie(nu, self.atmosphere.mie_g, self.atmosphere.mie_phase)[..., None] * aerosol
        )
        return Path(jnp.where(misses[..., None], 0, light), jnp.where(misses[..., None], 1, survives))

    def _between(
        self,
        altitude: Altitude,
        mu: Cosine,
        there: Altitude,
        mu_there: Cosine,
        reach: Length,
        ground: Bool[Array, "..."],
    ) -> Transmittance:
        """T over the first ``reach`` km of a ray, to a point at ``there``.

        A ratio of two entries of the table, where it has a number for them. Along the ground through haze it has none: there
        the difference of the two optical depths, from their closed form.
        """
        table, sign = self.tables.transmittance, jnp.where(ground, -1.0, 1.0)
        nearer_top = jnp.where(ground, altitude, there), sign * jnp.where(ground, mu, mu_there)
        known = to_top(self.planet, table, *nearer_top) > tiny(table.dtype)
        depths = [
            transmittance.optical_depth(self.atmosphere, transmittance.to_top(self.atmosphere, h, sign * m)[0])
            for h, m in ((altitude, mu), (there, mu_there))
        ]
        depth = jnp.where(known, 0, sign[..., None] * (depths[0] - depths[1]))
        return jnp.where(
            known, between(self.planet, table, altitude, mu, reach, ground), jnp.exp(-jnp.maximum(depth, 0))
        )

    def _scattered(
        self, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, ground: Bool[Array, "..."]
    ) -> tuple[Float[Array, "... w"], Float[Array, "... w"]]:
        """The two tables of scattered light, without phase functions, at a point and direction."""
        at = (altitude, mu, mu_s, nu, ground)
        air = look_up(self.planet, self.tables.rayleigh, *at)
        if not self.packed:
            return air, look_up(self.planet, self.tables.mie, *at)
        a = self.atmosphere
        first = look_up(self.planet, self.tables.mie[..., :1], *at)
        colour = safe_divide(a.rayleigh_scattering[:1], a.mie_scattering[:1]) * safe_divide(
            a.mie_scattering, a.rayleigh_scattering
        )
        return air, air * safe_divide(first, air[..., :1]) * colour

    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        falling = jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance
        altitude, mu_s = jnp.broadcast_arrays(altitude, mu_s)
        inside = jnp.minimum(altitude, self.planet.top_altitude)
        return falling * to_sun(self.planet, self.tables.transmittance, inside, mu_s, self.sun_angular_radius)

    def sky_irradiance(self, *, mu_s: Cosine, altitude: Altitude | None = None) -> Irradiance:
        """Diffuse irradiance of the sky on a horizontal plane: the ground, or one at ``altitude``."""
        altitude = jnp.zeros_like(mu_s) if altitude is None else altitude
        return bilinear(self.tables.irradiance, *self.planet.irradiance_position(altitude, mu_s))
