"""The tables of precomputed atmospheric scattering: which point of the atmosphere each entry stands for.

Bruneton & Neyret 2008, section 4, tabulate the transmittance over (r, mu) and the scattered light over (r, mu, mu_s, nu), with
non-linear maps that put the entries where the functions change: at the horizon, and where the sun sets. Bruneton's revision of
2017 (``precomputed_atmospheric_scattering``, ``functions.glsl``) changed three of the maps. ``"2008"`` and ``"2017"`` choose:

==============  =======================================  ==============================================
coordinate      2008                                     2017
==============  =======================================  ==============================================
T: r, mu        √((r-R_g)/(R_t-R_g)); an arctangent      ρ/H; the distance to the top, from least to most
S: mu           the distance to the boundary, from 0     the same, from the least distance possible
S: mu_s         1 - exp(-3 mu_s - 0.6), scaled           a rational function of the distance to the top
E: mu_s         (mu_s + 0.2) / 1.2                       (mu_s + 1) / 2
==============  =======================================  ==============================================

ρ = √(r² - R_g²) is the distance to the horizon, H its value at the top. The radii r of S are equidistant in ρ/H, those
of E in r; nu is equidistant. A *position* is a place in a table, 0 at the first entry and n - 1 at the last.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Length, Scalar
from diffatmo.numerics import once, safe_divide, safe_sqrt

PARAMETERISATIONS = ("2017", "2008")

_T_MU_MIN, _T_MU_SLOPE = 0.15, 1.5
"""2008: T is tabulated for mu >= -0.15, through tan(1.5 u)."""


class Sizes(NamedTuple):
    """Number of entries along each axis; the defaults are those of both papers."""

    transmittance_r: int = 64
    transmittance_mu: int = 256
    irradiance_r: int = 16
    irradiance_mu_s: int = 64
    r: int = 32
    mu: int = 128
    """Half of them for rays that meet the ground."""
    mu_s: int = 32
    nu: int = 8


class Planet(eqx.Module):
    """What the maps depend on."""

    bottom_radius: Scalar
    top_altitude: Scalar
    mu_s_min: float = eqx.field(static=True)
    sizes: Sizes = eqx.field(static=True)
    parameterisation: str = eqx.field(static=True)

    @property
    def _revised(self) -> bool:
        return self.parameterisation == "2017"

    @property
    def horizon_at_top(self) -> Scalar:
        """H, km: distance from the top to the horizon."""
        return self._rho(self.top_altitude)

    def _rho(self, altitude: Altitude) -> Float[Array, "..."]:
        return safe_sqrt(altitude * (altitude + 2 * self.bottom_radius))

    def _altitude_of_rho(self, rho: Float[Array, "..."]) -> Altitude:
        radius = self.bottom_radius
        return rho * rho / (radius + jnp.sqrt(rho * rho + radius * radius))

    def _mu_up(self, altitude: Altitude, distance: Float[Array, "..."]) -> Cosine:
        """mu of the ray that reaches the top after ``distance``."""
        radius = self.bottom_radius
        gap = (self.top_altitude - altitude) * (self.top_altitude + altitude + 2 * radius)
        return jnp.clip(safe_divide(gap - distance * distance, 2 * (radius + altitude) * distance, 1.0), -1, 1)

    # Along a ray

    def altitude_after(self, altitude: Altitude, mu: Cosine, distance: Length) -> Altitude:
        """Altitude after ``distance`` km along a ray, kept inside the tables."""
        return jnp.clip(geometry.altitude_along(altitude, mu, distance, self.bottom_radius), 0, self.top_altitude)

    def cosine_after(
        self, altitude: Altitude, cosine: Cosine, nu: Cosine | float, distance: Length, there: Altitude | float
    ) -> Cosine:
        """Cosine of a direction's zenith angle at altitude ``there``, after ``distance`` km along a ray.

        ``cosine`` is that at the start and ``nu`` that of the angle to the ray: 1 for the direction of the ray itself.
        """
        radius = self.bottom_radius
        return jnp.clip(((radius + altitude) * cosine + distance * nu) / (radius + there), -1, 1)

    # T(r, mu)

    def transmittance_nodes(self) -> tuple[Float[Array, " r"], Float[Array, "r mu"]]:
        """Altitude and mu of the entries of T."""
        x_r, x_mu = _unit(self.sizes.transmittance_r), _unit(self.sizes.transmittance_mu)
        if not self._revised:
            end = math.tan(_T_MU_SLOPE)
            mu = (1 + _T_MU_MIN) * jnp.tan(_T_MU_SLOPE * x_mu) / end - _T_MU_MIN
            return self.top_altitude * x_r * x_r, jnp.broadcast_to(mu, (x_r.size, x_mu.size))
        rho = x_r * self.horizon_at_top
        altitude = self._altitude_of_rho(rho)
        nearest = self.top_altitude - altitude
        distance = nearest[:, None] + x_mu * (rho + self.horizon_at_top - nearest)[:, None]
        return altitude, self._mu_up(altitude[:, None], distance)

    def transmittance_position(self, altitude: Altitude, mu: Cosine) -> tuple[Array, Array]:
        """Positions in T; mu of a ray that does not meet the ground."""
        n_r, n_mu = self.sizes.transmittance_r, self.sizes.transmittance_mu
        if not self._revised:
            x_r = safe_sqrt(altitude / self.top_altitude)
            end = math.tan(_T_MU_SLOPE)
            x_mu = jnp.arctan((mu + _T_MU_MIN) / (1 + _T_MU_MIN) * end) / _T_MU_SLOPE
        else:
            rho = self._rho(altitude)
            x_r = rho / self.horizon_at_top
            nearest = self.top_altitude - altitude
            distance = geometry.distance_up(altitude, mu, self.top_altitude, self.bottom_radius)
            x_mu = safe_divide(distance - nearest, rho + self.horizon_at_top - nearest)
        return _position(x_r, n_r), _position(x_mu, n_mu)

    # E(r, mu_s)

    def irradiance_nodes(self) -> tuple[Float[Array, " r"], Float[Array, " mu_s"]]:
        """Altitude and mu_s of the entries of E."""
        x = _unit(self.sizes.irradiance_mu_s)
        mu_s = 2 * x - 1 if self._revised else 1.2 * x - 0.2
        return self.top_altitude * _unit(self.sizes.irradiance_r), mu_s

    def irradiance_position(self, altitude: Altitude, mu_s: Cosine) -> tuple[Array, Array]:
        """Positions in E."""
        x_mu_s = (mu_s + 1) / 2 if self._revised else (mu_s + 0.2) / 1.2
        return (
            _position(altitude / self.top_altitude, self.sizes.irradiance_r),
            _position(x_mu_s, self.sizes.irradiance_mu_s),
        )

    # S(r, mu, mu_s, nu)

    def altitudes(self) -> Float[Array, " r"]:
        """Altitude of the entries of S."""
        return self._altitude_of_rho(_unit(self.sizes.r) * self.horizon_at_top)

    def altitude_position(self, altitude: Altitude) -> Array:
        """Position on the axis r of S."""
        return _position(self._rho(altitude) / self.horizon_at_top, self.sizes.r)

    def _spans(self, altitude: Altitude) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Least and greatest distance, as tabulated, to the ground and to the top."""
        rho = self._rho(altitude)
        far = rho + self.horizon_at_top
        if self._revised:
            return (altitude, rho), (self.top_altitude - altitude, far)
        return (jnp.zeros_like(rho), rho), (jnp.zeros_like(far), far)

    def mu_nodes(self, altitude: Scalar) -> Float[Array, " mu"]:
        """mu of the entries of S at one altitude: from the horizon down to the nadir, then from the zenith to the horizon."""
        x = _unit(self.sizes.mu // 2)
        (low, high), (nearest, farthest) = self._spans(altitude)
        radius = self.bottom_radius
        down = jnp.clip(low + (high - low) * x[::-1], altitude, high)
        squares = altitude * (altitude + 2 * radius) + down * down
        falling = -safe_divide(squares, 2 * (radius + altitude) * down, 1.0)
        up = jnp.maximum(nearest + (farthest - nearest) * x, self.top_altitude - altitude)
        horizon = geometry.horizon_mu(altitude, radius)
        # From the ground, rounding would else let the horizontal ray dip below the horizon.
        return jnp.concatenate([jnp.clip(falling, -1, horizon), jnp.maximum(self._mu_up(altitude, up), horizon)])

    def ground_nodes(self) -> Bool[Array, " mu"]:
        """Which of them are for rays that meet the ground."""
        return jnp.arange(self.sizes.mu) < self.sizes.mu // 2

    def mu_position(self, altitude: Altitude, mu: Cosine, ground: Bool[Array, "..."]) -> Array:
        """Position on the axis mu of S; the two halves do not mix."""
        half = self.sizes.mu // 2
        (low, high), (nearest, farthest) = self._spans(altitude)
        down = geometry.distance_down(altitude, mu, jnp.zeros_like(altitude), self.bottom_radius)
        up = geometry.distance_up(altitude, mu, self.top_altitude, self.bottom_radius)
        below = (half - 1) * (1 - jnp.clip(safe_divide(down - low, high - low), 0, 1))
        above = half + (half - 1) * jnp.clip(safe_divide(up - nearest, farthest - nearest), 0, 1)
        return jnp.where(ground, below, above)

    def mu_s_nodes(self) -> Float[Array, " mu_s"]:
        """mu_s of the entries of S."""
        x = _unit(self.sizes.mu_s)
        if not self._revised:
            return -(jnp.log1p(-x * (1 - math.exp(-3.6))) + 0.6) / 3
        nearest, farthest = self.top_altitude, self.horizon_at_top
        lowest_a = self._mu_s_ratio(jnp.asarray(self.mu_s_min, x.dtype))
        a = lowest_a * (1 - x) / (1 + x * lowest_a)
        distance = nearest + a * (farthest - nearest)
        return self._mu_up(jnp.zeros_like(distance), distance)

    def _mu_s_ratio(self, mu_s: Cosine) -> Float[Array, "..."]:
        """a: the distance to the top from the ground towards the sun, as if the ground were not there; 0 at the zenith."""
        nearest, farthest = self.top_altitude, self.horizon_at_top
        r_mu = self.bottom_radius * mu_s
        # The farther crossing of the top, also where the sun is below the horizon.
        root = jnp.sqrt(r_mu * r_mu + farthest * farthest)
        distance = jnp.where(mu_s > 0, farthest * farthest / (jnp.abs(r_mu) + root), root - r_mu)
        return (distance - nearest) / (farthest - nearest)

    def mu_s_position(self, mu_s: Cosine) -> Array:
        """Position on the axis mu_s of S; suns below the lowest tabulated count as that."""
        if not self._revised:
            x = (1 - jnp.exp(-3 * mu_s - 0.6)) / (1 - math.exp(-3.6))
        else:
            a = self._mu_s_ratio(mu_s)
            lowest_a = self._mu_s_ratio(jnp.asarray(self.mu_s_min, mu_s.dtype))
            x = jnp.maximum(1 - a / lowest_a, 0) / (1 + a)
        return _position(x, self.sizes.mu_s)

    def nu_nodes(self) -> Float[Array, " nu"]:
        """nu of the entries of S, before :func:`possible`."""
        return 2 * _unit(self.sizes.nu) - 1

    def nu_position(self, nu: Cosine) -> Array:
        """Position on the axis nu of S."""
        return _position((nu + 1) / 2, self.sizes.nu)


def possible(mu: Cosine, mu_s: Cosine, nu: Cosine) -> Cosine:
    """``nu``, brought into the range that it can have with ``mu`` and ``mu_s``."""
    reach = geometry.sine(mu) * geometry.sine(mu_s)
    return jnp.clip(nu, mu * mu_s - reach, mu * mu_s + reach)


def _unit(count: int) -> Float[Array, " n"]:
    return jnp.linspace(0, 1, count)


def _position(x: Float[Array, "..."], count: int) -> Float[Array, "..."]:
    return once(jnp.clip(x, 0, 1) * (count - 1))


def taps(position: Float[Array, "..."], count: int) -> tuple[Int[Array, "..."], Float[Array, "..."]]:
    """The entry before a position, and how far it is to the next one."""
    first = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, count - 2)
    return once((first, position - first))


def _linear(table: Float[Array, "nx *c"], x: Float[Array, "..."]) -> Float[Array, "..."]:
    first, part = taps(x, table.shape[0])
    weight = part.reshape(*part.shape, *(1,) * (table.ndim - 1))
    return table[first] * (1 - weight) + table[first + 1] * weight


def _along_rows(rows: Float[Array, "..."], y: Float[Array, "... k"]) -> Float[Array, "..."]:
    """Linear lookup in a table of its own for each of the leading entries of ``y``."""
    lead, ny = y.shape[:-1], rows.shape[y.ndim - 1]
    flat = rows.reshape(-1, *rows.shape[y.ndim :])
    start = (np.arange(math.prod(lead)) * ny).reshape(*lead, 1)
    first, part = taps(y, ny)
    weight = part.reshape(*part.shape, *(1,) * (flat.ndim - 1))
    return flat[start + first] * (1 - weight) + flat[start + first + 1] * weight


def bilinear(table: Float[Array, "nx ny *c"], x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
    """Bilinear lookup at positions ``x`` and ``y`` of the two leading axes.

    Where ``x`` has one entry for all along the last axis of ``y``, it is interpolated first, once for all of them.
    """
    nx, ny = table.shape[:2]
    if x.ndim == y.ndim > 0 and x.shape[-1] == 1 < y.shape[-1] and x.shape[:-1] == y.shape[:-1]:
        return _along_rows(_linear(table, x[..., 0]), y)
    flat = table.reshape(nx * ny, *table.shape[2:])
    (ix, fx), (iy, fy) = taps(x, nx), taps(y, ny)
    extra = (1,) * (table.ndim - 2)
    result = jnp.zeros((), table.dtype)
    for dx, wx in ((0, 1 - fx), (1, fx)):
        for dy, wy in ((0, 1 - fy), (1, fy)):
            weight = wx * wy
            result = result + weight.reshape(*weight.shape, *extra) * flat[(ix + dx) * ny + iy + dy]
    return result
