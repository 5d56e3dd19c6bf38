"""From moments to radiance: the last gather, along the rays that are looked at."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from diffatmo import geometry, phase, rays, scattering, table, transmittance
from diffatmo._types import Altitude, Cosine, Direction, Irradiance, Length, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.models.base import Path, Ray, Sky, View
from diffatmo.models.moments.angular import azimuthal, degrees, orders, plane, polar
from diffatmo.models.moments.shell import Shell, Ways, dusk
from diffatmo.models.moments.solve import Degrees, State, gather, source_moments
from diffatmo.numerics import once, safe_divide, safe_sqrt, whole_products

ZENITH_WIDTH = 0.02
"""Least half-width of the range of nu that is tabulated, where view or sun is at the zenith, and azimuth has no meaning."""

SKY_LINEAR = 0.02
GROUND_LINEAR = 0.1
"""Linear parts of the maps of the view's rows: mu above the horizon, distance to the ground below it."""


class Resolution(NamedTuple):
    """Static sizes of the gather: degrees of the moments, nodes along a ray, and the tables of a view."""

    degrees: Degrees
    steps: int
    sky_rows: int
    ground_rows: int
    columns: int
    fine_columns: int


class MomentsSky(Sky):
    """The solved moments of one atmosphere."""

    atmosphere: Atmosphere
    shell: Shell
    state: State
    resolution: Resolution = eqx.field(static=True)

    @whole_products
    def path(self, *, altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, distance: Length | None = None) -> Path:
        """Inscattered radiance and transmittance to the boundary, or to ``distance`` km if that is nearer."""
        atmosphere, radius, top = self.atmosphere, self.atmosphere.bottom_radius, self.atmosphere.top_altitude
        altitude, mu, mu_s, nu = jnp.broadcast_arrays(altitude, mu, mu_s, nu)
        altitude, mu, mu_s, moved, misses = geometry.enter_atmosphere(altitude, mu, mu_s, nu, radius, top)
        ground = geometry.hits_ground(altitude, mu, radius)
        steps, cut_nodes = self.resolution.steps, None
        nodes = rays.trace(altitude, mu, ground, radius, top, steps)
        if distance is not None:
            end = geometry.distance_to_boundary(altitude, mu, ground, radius, top)
            steps = 6 * steps
            nodes = cut_nodes = rays.straight(altitude, mu, jnp.clip(distance - moved, 0, end), radius, steps)
        single = scattering.integrate(
            atmosphere, altitude, mu, mu_s, nu, ground,
            steps=steps, aureole=scattering.AUREOLE_ORDERS, nodes=cut_nodes,
        )  # fmt: skip
        light = scattering.radiance(atmosphere, single, nu)
        for phase_, term in zip(self.aureole_phases(nu), single.aureole, strict=True):
            light = light + phase_[..., None] * term
        along = nodes.distance, nodes.altitude, radius
        mu_here = geometry.mu_along(altitude[..., None], mu[..., None], *along)
        mu_s_here = geometry.mu_s_along(altitude[..., None], mu_s[..., None], nu[..., None], *along)
        i, count, w, j = self.state.moments.shape
        by_position = jnp.moveaxis(self.state.moments, -1, 1).reshape(i, j, count * w)
        position = self.shell.altitude_unit(nodes.altitude), self.shell.sun_unit(mu_s_here)
        moments = table.interpolate(by_position, *position).reshape(*mu_here.shape, count, w)
        moments = moments * dusk(mu_s_here, self.shell.grazing())[..., None, None]
        degree = self.resolution.degrees.first
        around = azimuthal(degree, *plane(mu_here, mu_s_here, nu[..., None]))
        angular = polar(degree, mu_here) * jnp.stack(around, axis=-1)[..., orders(degree)]
        source = jnp.sum(moments * self._source(nodes.altitude) * angular[..., None], axis=-2)
        light = light + jnp.sum(self._survival(altitude, mu, nodes, steps) * source, axis=-2)
        return Path(jnp.where(misses[..., None], 0, light), jnp.where(misses[..., None], 1, single.transmittance))

    def _survival(self, altitude: Altitude, mu: Cosine, nodes: rays.Nodes, steps: int) -> Float[Array, "... n w"]:
        """Transmittance from the start of a ray to its nodes, times their weight, km."""
        along, _ = transmittance.columns_along(self.atmosphere, altitude, mu, nodes, steps)
        return jnp.exp(-transmittance.optical_depth(self.atmosphere, along)) * nodes.weight[..., None]

    def _source(self, altitude: Altitude) -> Float[Array, "... lm w"]:
        """Scattering coefficient times phase moment of every (l, m), km^-1."""
        degree = self.resolution.degrees.first
        return source_moments(self.atmosphere, altitude, degree)[..., degrees(degree), :]

    def aureole_phases(self, nu: Cosine) -> list[Float[Array, "..."]]:
        """Phase functions of repeated forward scattering beyond the kept moments, orders 2, 3, …"""
        degrees = (self.resolution.degrees.first, *[self.resolution.degrees.last] * (scattering.AUREOLE_ORDERS - 1))
        g, name = self.atmosphere.mie_g, self.atmosphere.mie_phase
        return [phase.repeated(nu, g, name, order, degree) for order, degree in enumerate(degrees, start=2)]

    def sun_irradiance(self, *, altitude: Altitude, mu_s: Cosine) -> Irradiance:
        """Direct irradiance of the sun on a horizontal plane."""
        falling = jnp.maximum(mu_s, 0)[..., None] * self.atmosphere.solar_irradiance
        return falling * transmittance.to_sun(self.atmosphere, altitude, mu_s)

    def sky_irradiance(self, *, mu_s: Cosine) -> Irradiance:
        """Diffuse irradiance of the sky on the ground."""
        by_sun = self.state.irradiance.T
        first, weights = table.cubic_weights(self.shell.sun_unit(mu_s), by_sun.shape[0])
        value = sum(weights[..., a, None] * by_sun[first + a] for a in range(4))
        return value * dusk(mu_s, self.shell.grazing())[..., None]

    @whole_products
    def view(self, *, altitude: Altitude, sun: Direction) -> "MomentsView":
        """Tabulate everything that is smooth in direction for one altitude and one sun."""
        sun = jnp.asarray(sun, jnp.result_type(sun, 1.0))
        return MomentsView.build(self, jnp.asarray(altitude, sun.dtype), sun)


class _Rows(eqx.Module):
    """Rows of a view's table: directions of equal mu, the sky's from the horizon up, the ground's from the nadir out."""

    altitude: Scalar
    horizon: Cosine
    highest: Cosine
    widening: Scalar
    """Least half-width of the range of nu that is tabulated; from afar, that of the planet is small as well."""
    nadir_distance: Length
    horizon_distance: Length
    sky: int = eqx.field(static=True)
    ground: int = eqx.field(static=True)

    @classmethod
    def build(cls, atmosphere: Atmosphere, altitude: Scalar, resolution: Resolution) -> "_Rows":
        radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
        outside = altitude > top
        # Seen from space, the sky ends where rays pass over the top.
        over = jnp.where(outside, altitude - top, 0)
        highest = jnp.where(outside, geometry.horizon_mu(over, radius + top), 1.0)
        reach = safe_sqrt(altitude * (altitude + 2 * radius))
        return cls(
            altitude, geometry.horizon_mu(altitude, radius), highest,
            ZENITH_WIDTH * jnp.where(outside, geometry.sine(highest), 1.0), altitude, reach,
            resolution.sky_rows, resolution.ground_rows,
        )  # fmt: skip

    def mu(self, radius: Scalar) -> Cosine:
        """mu of every row."""
        up = table.stretch(jnp.linspace(0, 1, self.sky), SKY_LINEAR)
        sky = self.horizon + (self.highest - self.horizon) * up
        out = table.stretch(jnp.linspace(0, 1, self.ground), GROUND_LINEAR)
        distance = self.nadir_distance + (self.horizon_distance - self.nadir_distance) * out
        r, h = radius + self.altitude, self.altitude
        ground = -safe_divide(h * (h + 2 * radius) + distance * distance, 2 * r * distance, 1.0)
        return jnp.concatenate([sky, jnp.clip(ground, -1, self.horizon)])

    def half_width(self, mu: Cosine, mu_s: Cosine) -> Cosine:
        """Half-width of the range of nu tabulated at ``mu``: sinθ sinθ_s, kept from vanishing."""
        return once(safe_sqrt((1 - mu * mu) * (1 - mu_s * mu_s) + self.widening * self.widening))

    def locate(self, mu: Cosine, ground: Bool[Array, "..."], radius: Scalar) -> tuple[Int[Array, "..."], Array]:
        """First row and four weights for interpolation at ``mu``; the two parts of the table do not mix."""
        up = jnp.clip(safe_divide(mu - self.horizon, self.highest - self.horizon), 0, 1)
        distance = geometry.distance_down(self.altitude, mu, jnp.zeros_like(mu), radius)
        out = safe_divide(distance - self.nadir_distance, self.horizon_distance - self.nadir_distance)
        above = table.cubic_weights(table.unstretch(up, SKY_LINEAR), self.sky)
        below = table.cubic_weights(table.unstretch(jnp.clip(out, 0, 1), GROUND_LINEAR), self.ground)
        return (
            jnp.where(ground, self.sky + below[0], above[0]),
            jnp.where(ground[..., None], below[1], above[1]),
        )


class MomentsView(View):
    """Phase-free components on a small grid of directions, interpolated; the phase functions are exact at every pixel.

    Along a row (constant mu) every component is a smooth function of nu, tabulated around mu mu_s, the value at right angles
    to the sun's plane. nu, unlike azimuth, has a meaning at the zenith.
    """

    sky: MomentsSky
    altitude: Scalar
    sun: Direction
    rows: _Rows
    table: Float[Array, "row column cw"]
    log_transmittance: Float[Array, "row w"]

    @classmethod
    def build(cls, sky: MomentsSky, altitude: Scalar, sun: Direction) -> "MomentsView":
        """Integrate along the rays of the grid."""
        atmosphere, size = sky.atmosphere, sky.resolution
        radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
        rows = _Rows.build(atmosphere, altitude, size)
        mu = rows.mu(radius)
        ground = jnp.arange(mu.size) >= size.sky_rows
        x = jnp.asarray(table.chebyshev_nodes(size.columns), mu.dtype)
        mu_s = sun[2]
        nu = mu[:, None] * mu_s + rows.half_width(mu, mu_s)[:, None] * x
        start, mu_in, mu_s_in, _, misses = geometry.enter_atmosphere(
            jnp.broadcast_to(altitude, (mu.size, 1)), mu[:, None], mu_s, nu, radius, top
        )
        single = scattering.integrate(
            atmosphere, start, mu_in, mu_s_in, nu, ground[:, None], steps=size.steps, aureole=scattering.AUREOLE_ORDERS
        )
        multiple = cls._multiple(sky, start[:, 0], mu_in[:, 0], jnp.broadcast_to(mu_s_in, nu.shape), nu, ground)
        reach = geometry.distance_down(start, mu_in, jnp.zeros_like(start), radius)
        mu_s_ground = jnp.clip(((radius + start) * mu_s_in + reach * nu) / radius, -1, 1)
        below = single.transmittance * sky.ground_radiance(mu_s=mu_s_ground)
        multiple = multiple + jnp.where(ground[:, None, None], below, 0)
        components = jnp.stack([multiple, single.rayleigh, single.mie, *single.aureole], axis=-2)
        components = jnp.where(misses[..., None, None], 0, components)
        # From Chebyshev nodes to equidistant ones, between which a local cubic is enough.
        fine = jnp.linspace(-1, 1, size.fine_columns)
        resample = table.chebyshev(size.columns, fine) @ jnp.asarray(
            table.chebyshev_coefficients(size.columns), fine.dtype
        )
        grid = jnp.einsum("fx,rxc->rfc", resample, components.reshape(*nu.shape, -1))
        depth = jnp.where(misses[:, :1], 0, jnp.log(jnp.maximum(single.transmittance[:, 0], 1e-30)))
        return cls(sky, altitude, sun, rows, grid, depth)

    @staticmethod
    def _multiple(
        sky: MomentsSky,
        altitude: Float[Array, " r"],
        mu: Float[Array, " r"],
        mu_s: Float[Array, "r x"],
        nu: Float[Array, "r x"],
        ground: Bool[Array, " r"],
    ) -> Float[Array, "r x w"]:
        """Multiple scattering along the rays of the grid: like ``path``, but nodes do not depend on nu, so that the
        interpolation in altitude is one matrix product.
        """
        size, shell = sky.resolution, sky.shell
        radius, top = sky.atmosphere.bottom_radius, sky.atmosphere.top_altitude
        nodes = rays.trace(altitude, mu, ground, radius, top, size.steps)
        start, along = altitude[:, None, None], (nodes.distance[..., None], nodes.altitude[..., None], radius)
        mu_here = geometry.mu_along(start, mu[:, None, None], *along)
        mu_s_here = geometry.mu_s_along(start, mu_s[:, None], nu[:, None], *along)
        altitude_rows = table.cubic(shell.altitude_unit(nodes.altitude), shell.altitude.size).rows(shell.altitude.size)
        ways = Ways(
            altitude_rows,
            table.cubic(shell.sun_unit(mu_s_here), shell.mu_s.size).scaled(dusk(mu_s_here, shell.grazing())),
            *plane(mu_here, mu_s_here, nu[:, None]),
        )
        weight = sky._source(nodes.altitude) * sky._survival(altitude, mu, nodes, size.steps)[..., None, :]
        weight = weight * polar(size.degrees.first, mu_here[..., 0])[..., None]
        parts = jax.tree.map(lambda part: part[:, None], (ways, weight))
        m_of = orders(size.degrees.first)
        light = jax.lax.map(lambda part: gather(sky.state.moments, part[0], part[1], m_of)[0], parts)
        return jnp.moveaxis(light, 1, 2)

    def _lookup(
        self, view: Direction
    ) -> tuple[Float[Array, "... c w"], Int[Array, "..."], Float[Array, "... 4"], Cosine]:
        radius = self.sky.atmosphere.bottom_radius
        mu, mu_s, nu = view[..., 2], self.sun[2], view @ self.sun
        ground = mu < self.rows.horizon
        row, row_weights = self.rows.locate(mu, ground, radius)
        x = (nu - mu * mu_s) / self.rows.half_width(mu, mu_s)
        columns = self.table.shape[1]
        column, column_weights = table.cubic_weights(0.5 * (jnp.clip(x, -1, 1) + 1), columns)
        patch = jax.vmap(lambda r, c: jax.lax.dynamic_slice(self.table, (r, c, 0 * r), (4, 4, self.table.shape[2])))
        corners = patch(row.reshape(-1), column.reshape(-1)).reshape(
            *mu.shape, 4, 4, -1, self.log_transmittance.shape[1]
        )
        weights = (row_weights[..., :, None] * column_weights[..., None, :])[..., None, None]
        return jnp.sum(corners * weights, axis=(-4, -3)), row, row_weights, nu

    @whole_products
    def radiance(self, *, view: Direction) -> Ray:
        """Radiance (ground included, sun's disc not) and transmittance along unit vectors ``view``, shape (..., 3)."""
        components, row, row_weights, nu = self._lookup(view)
        atmosphere = self.sky.atmosphere
        phases = [
            jnp.ones_like(nu),
            phase.rayleigh(nu),
            phase.mie(nu, atmosphere.mie_g, atmosphere.mie_phase),
            *self.sky.aureole_phases(nu),
        ]
        light = sum(p[..., None] * components[..., c, :] for c, p in enumerate(phases))
        seen = view[..., 2] <= self.rows.highest
        depth = sum(row_weights[..., a, None] * self.log_transmittance[row + a] for a in range(4))
        transmittance_: Transmittance = jnp.exp(jnp.minimum(depth, 0))
        # Between light and darkness a local cubic may undershoot.
        return Ray(jnp.where(seen[..., None], jnp.maximum(light, 0), 0), jnp.where(seen[..., None], transmittance_, 1))
