"""Optical depth and transmittance, shared by every model.

The atmosphere's three constituents (air, aerosol, absorber) have densities that do not depend on wavelength, so what is
computed is the *column* of each, X = ∫ density ds, km; the optical depth at any number of wavelengths is a product with
the extinction coefficients (Bruneton & Neyret 2008, eq. 5). Exponential densities are integrated by Gauss's rule along
:mod:`diffatmo.rays`; the absorber's layer has edges, which a smooth rule would blur, so it is cut at them.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, rays
from diffatmo._types import Altitude, Cosine, Length, OpticalDepth, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.numerics import safe_sqrt
from diffatmo.table import interpolate, stretch, unstretch

ALTITUDE_LINEAR = 0.3
"""Linear part of the altitude map of the table."""

MU_LINEAR = 0.05
"""Linear part of its map of mu; clusters nodes at the horizon."""

_SHELL_STEPS = 4
"""Nodes for the altitude, nearly quadratic in distance, between two shells."""


def tent_column(
    atmosphere: Atmosphere, perigee: Altitude, start: Length, end: Length
) -> Float[Array, "..."]:
    """Column of the absorber's tent between two points of a line, given as signed distances from its ``perigee``, km.

    The tent is a sum of ramps, (ramp(c + w) - 2 ramp(c) + ramp(c - w)) / w with ramp(a) = max(0, a - h), and the part of
    the line under altitude a is one interval on which a - h is smooth.
    """
    radius, center, width = atmosphere.bottom_radius, atmosphere.ozone_center_altitude, atmosphere.ozone_half_width
    t, w, _ = rays.rule(_SHELL_STEPS, jnp.result_type(start).name)
    from_center = radius + perigee

    def ramp(a: Altitude) -> Float[Array, "..."]:
        reach = safe_sqrt((a - perigee) * (a + perigee + 2 * radius))
        low, high = jnp.clip(start, -reach, reach), jnp.clip(end, -reach, reach)
        total = jnp.zeros_like(low)
        for position, weight in zip(t, w, strict=True):
            z = low + (high - low) * position
            h = perigee + z * z / (safe_sqrt(from_center * from_center + z * z) + from_center)
            total = total + weight * (a - h)
        return (high - low) * total

    return (ramp(center + width) - 2 * ramp(center) + ramp(center - width)) / width


def densities(atmosphere: Atmosphere, altitude: Altitude) -> Float[Array, "... 2"]:
    """Relative densities of air and aerosol, stacked on a new last axis."""
    return jnp.stack([atmosphere.rayleigh_density(altitude), atmosphere.mie_density(altitude)], axis=-1)


def columns_along(
    atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, nodes: rays.Nodes, steps: int
) -> tuple[Float[Array, "... n 3"], Float[Array, "... 3"]]:
    """Columns, km, from the start of a ray to each of its nodes, and to its end."""
    perigee = geometry.perigee_altitude(altitude, mu, atmosphere.bottom_radius)
    start = (atmosphere.bottom_radius + altitude) * mu
    here, end = rays.accumulate(densities(atmosphere, nodes.altitude), nodes, steps)
    length = jnp.sum(nodes.weight, axis=-1)
    tent_here = tent_column(atmosphere, perigee[..., None], start[..., None], start[..., None] + nodes.distance)
    tent_end = tent_column(atmosphere, perigee, start, start + length)
    return (
        jnp.concatenate([here, tent_here[..., None]], axis=-1),
        jnp.concatenate([end, tent_end[..., None]], axis=-1),
    )


def integrate(
    atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, ground: Bool[Array, "..."], steps: int = 8
) -> Float[Array, "... 3"]:
    """Columns, km, from a point inside the atmosphere to the end of a ray, without a table."""
    altitude, mu = jnp.broadcast_arrays(altitude, mu)
    nodes = rays.trace(altitude, mu, ground, atmosphere.bottom_radius, atmosphere.top_altitude, steps)
    smooth = jnp.sum(nodes.weight[..., None] * densities(atmosphere, nodes.altitude), axis=-2)
    start = (atmosphere.bottom_radius + altitude) * mu
    end = start + jnp.sum(nodes.weight, axis=-1)
    perigee = geometry.perigee_altitude(altitude, mu, atmosphere.bottom_radius)
    return jnp.concatenate([smooth, tent_column(atmosphere, perigee, start, end)[..., None]], axis=-1)


def extinction(atmosphere: Atmosphere) -> Float[Array, "3 w"]:
    """Extinction per unit density of the three constituents, km^-1."""
    return jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_extinction, atmosphere.ozone_absorption])


def optical_depth(atmosphere: Atmosphere, columns: Float[Array, "... 3"]) -> OpticalDepth:
    """Optical depth of columns (km) of the three constituents."""
    # Written out: a matrix product over an axis of three would block the fusion with what comes before and after.
    coefficients = extinction(atmosphere)
    return sum(columns[..., i, None] * coefficients[i] for i in range(3))


class Columns(eqx.Module):
    """Table of the columns to the top of the atmosphere along rays that do not meet the ground.

    Tabulated for mu >= 0 only: a line that descends to a perigee p and rises again has X(h, -mu) = 2 X(p, 0) - X(h, mu).
    Stored is ``log(column + floor)`` of air and aerosol, nearly linear in altitude and smooth to the top, where the column
    vanishes (the floor is a thousandth of the vertical column), and the absorber's column as it is.
    """

    table: Float[Array, "nh nmu 3"]
    levels: Float[Array, "n 3"]
    floor: Float[Array, "2"]
    bottom_radius: Scalar
    top_altitude: Scalar

    @classmethod
    def build(
        cls, atmosphere: Atmosphere, *, altitudes: int = 32, mus: int = 48, levels: int = 320, steps: int = 8
    ) -> "Columns":
        """Integrate the densities along every ray of the table, and along the horizontal ray of many ``levels``."""
        top = atmosphere.top_altitude
        altitude = top * stretch(jnp.linspace(0, 1, altitudes), ALTITUDE_LINEAR)[:, None]
        mu = stretch(jnp.linspace(0, 1, mus), MU_LINEAR)
        column = integrate(atmosphere, altitude, mu, jnp.zeros((altitudes, mus), bool), steps)
        perigee = jnp.linspace(0, 1, levels) * top
        level = integrate(atmosphere, perigee, jnp.zeros(levels), jnp.zeros(levels, bool), steps)
        floor = 1e-3 * column[0, -1, :2] + jnp.finfo(column.dtype).tiny ** 0.5
        encode = lambda x: jnp.concatenate([jnp.log(x[..., :2] + floor), x[..., 2:]], axis=-1)  # noqa: E731
        return cls(encode(column), encode(level), floor, atmosphere.bottom_radius, top)

    def altitude_unit(self, altitude: Altitude) -> Float[Array, "..."]:
        """Unit coordinate of an altitude, km."""
        return unstretch(jnp.clip(altitude / self.top_altitude, 0, 1), ALTITUDE_LINEAR)

    def decode(self, entry: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Table entries -> columns, km."""
        return jnp.concatenate([jnp.exp(entry[..., :2]) - self.floor, entry[..., 2:]], axis=-1)

    def level(self, altitude: Altitude) -> Float[Array, "... 3"]:
        """Columns of horizontal rays, km; linear between many levels, which the absorber's edges ask for."""
        position = jnp.clip(altitude / self.top_altitude, 0, 1) * (self.levels.shape[0] - 1)
        first = jnp.minimum(position.astype(jnp.int32), self.levels.shape[0] - 2)
        fraction = (position - first)[..., None]
        return self.decode((1 - fraction) * self.levels[first] + fraction * self.levels[first + 1])

    def join(
        self, upward: Float[Array, "... 3"], altitude: Altitude, mu: Cosine
    ) -> tuple[Float[Array, "... 3"], Bool[Array, "..."]]:
        """Columns of rays with any ``mu`` from those with ``|mu|``, and whether the ray is free of the ground."""
        perigee = geometry.perigee_altitude(altitude, mu, self.bottom_radius)
        falling = 2 * self.level(perigee) - upward
        free = (mu >= 0) | (perigee >= 0)
        return jnp.where((mu < 0)[..., None], falling, upward), free

    def __call__(self, altitude: Altitude, mu: Cosine) -> tuple[Float[Array, "... 3"], Bool[Array, "..."]]:
        """Columns, km, from a point to the top along a ray, and whether the ray is free (does not meet the ground)."""
        y = unstretch(jnp.minimum(jnp.abs(mu), 1), MU_LINEAR)
        return self.join(self.decode(interpolate(self.table, self.altitude_unit(altitude), y)), altitude, mu)


def along(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, distance: Length, steps: int = 48) -> Transmittance:
    """Transmittance of the first ``distance`` km of a ray inside the atmosphere, without a table."""
    nodes = rays.straight(altitude, mu, distance, atmosphere.bottom_radius, steps)
    return jnp.exp(-optical_depth(atmosphere, columns_along(atmosphere, altitude, mu, nodes, steps)[1]))


def sun_transmittance(atmosphere: Atmosphere, columns: Columns, altitude: Altitude, mu_s: Cosine) -> Transmittance:
    """Transmittance from a point to the sun; 0 in the planet's shadow (Bruneton & Neyret 2008, L_0)."""
    column, free = columns(altitude, mu_s)
    # The column of a blocked ray may be meaningless: put a finite one under the exponential.
    depth = optical_depth(atmosphere, jnp.where(free[..., None], column, 0))
    return jnp.where(free[..., None], jnp.exp(-depth), 0)
