"""Optical depth and transmittance, shared by every model.

The atmosphere's three constituents (air, aerosol, absorber) have densities that do not depend on wavelength, so what is
computed is the *column* of each, X = ∫ density ds, km; the optical depth at any number of wavelengths is a product with
the extinction coefficients (Bruneton & Neyret 2008, eq. 5). To the top of the atmosphere the columns are known in closed
form, so no table is needed: the exponential's is Chapman's function, the absorber's layer is cut at its edges.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, rays
from diffatmo._types import Altitude, Cosine, Length, OpticalDepth, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.numerics import safe_divide, safe_sqrt, scaled_erfcx

_SHELL_STEPS = 3
"""Gauss nodes for the altitude, nearly quadratic in distance, between two shells."""


class Columns(NamedTuple):
    """∫ density ds along a path, km, of the three constituents."""

    air: Float[Array, "..."]
    aerosol: Float[Array, "..."]
    absorber: Float[Array, "..."]


def extinction(atmosphere: Atmosphere) -> Float[Array, "3 w"]:
    """Extinction per unit density of the three constituents, km^-1."""
    return jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_extinction, atmosphere.ozone_absorption])


def optical_depth(atmosphere: Atmosphere, columns: Columns) -> OpticalDepth:
    """Optical depth of columns (km) of the three constituents."""
    return (
        columns.air[..., None] * atmosphere.rayleigh_scattering
        + columns.aerosol[..., None] * atmosphere.mie_extinction
        + columns.absorber[..., None] * atmosphere.ozone_absorption
    )


def _rising(
    altitude: Altitude, perigee: Altitude, v: Length, scale_height: Scalar, radius: Scalar
) -> Float[Array, "..."]:
    """Column of exp(-h / H) from a point to infinity along a ray that rises from there, over sqrt(πH): Chapman's function.

    With v = sqrt(h - p), p the altitude of the line's perigee, distance is z = v sqrt(h + p + 2R) and the column is an
    integral of exp(-v²/H) against F = (R + h) / sqrt(h + p + 2R), which varies by H / 2R over a scale height only. Taken out
    at the mean of h under the weight, it leaves sqrt(πH) exp(-h/H) erfcx(v / sqrt(H)) F: relative error (H/R)², 2e-6 on
    Earth. The mean lies H/2 (horizontal) to H (vertical) above the point.
    """
    m = v / safe_sqrt(scale_height)
    effective = altitude + scale_height * (1 - 0.5 / (1 + m * (2 / math.sqrt(math.pi) + m)))
    factor = (radius + effective) / safe_sqrt(effective + perigee + 2 * radius)
    return scaled_erfcx(m, -altitude / scale_height) * factor


def tent_column(atmosphere: Atmosphere, perigee: Altitude, start: Length, end: Length) -> Float[Array, "..."]:
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
            h = perigee + safe_divide(z * z, safe_sqrt(from_center * from_center + z * z) + from_center)
            total = total + weight * (a - h)
        return (high - low) * total

    return (ramp(center + width) - 2 * ramp(center) + ramp(center - width)) / width


def to_top(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine) -> tuple[Columns, Bool[Array, "..."]]:
    """Columns from a point inside the atmosphere to the top, and whether the ray is free (does not meet the ground).

    A ray that falls to a perigee p and rises again has X(h, -mu) = 2 X(p, 0) - X(h, mu). The columns of a ray that is not
    free are finite but mean nothing.
    """
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    perigee = geometry.perigee_altitude(altitude, mu, radius)
    falls = mu < 0
    v = jnp.abs(mu) * safe_sqrt((radius + altitude) / (1 + geometry.sine(mu)))
    rise = jnp.maximum(top - altitude, 0)
    v_top = v + safe_divide(rise, v + safe_sqrt(v * v + rise))
    lowest = jnp.maximum(perigee, 0)

    def column(scale_height: Scalar) -> Float[Array, "..."]:
        here = _rising(altitude, perigee, v, scale_height, radius)
        above = _rising(altitude + rise, perigee, v_top, scale_height, radius)
        level = _rising(lowest, lowest, jnp.zeros_like(v), scale_height, radius)
        return safe_sqrt(math.pi * scale_height) * (jnp.where(falls, 2 * level - here, here) - above)

    start = (radius + altitude) * mu
    end = safe_sqrt((top - perigee) * (top + perigee + 2 * radius))
    columns = Columns(
        column(atmosphere.rayleigh_scale_height),
        column(atmosphere.mie_scale_height),
        tent_column(atmosphere, perigee, start, end),
    )
    return columns, ~falls | (perigee >= 0)


def columns_along(
    atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, nodes: rays.Nodes, steps: int
) -> tuple[Columns, Columns]:
    """Columns from the start of a ray to each of its nodes, and to its end."""
    perigee = geometry.perigee_altitude(altitude, mu, atmosphere.bottom_radius)
    start = (atmosphere.bottom_radius + altitude) * mu
    air, all_air = rays.accumulate(atmosphere.rayleigh_density(nodes.altitude), nodes, steps)
    aerosol, all_aerosol = rays.accumulate(atmosphere.mie_density(nodes.altitude), nodes, steps)
    absorber = tent_column(atmosphere, perigee[..., None], start[..., None], start[..., None] + nodes.distance)
    all_absorber = tent_column(atmosphere, perigee, start, start + jnp.sum(nodes.weight, axis=-1))
    return Columns(air, aerosol, absorber), Columns(all_air, all_aerosol, all_absorber)


def along(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, distance: Length, steps: int = 48) -> Transmittance:
    """Transmittance of the first ``distance`` km of a ray inside the atmosphere."""
    nodes = rays.straight(altitude, mu, distance, atmosphere.bottom_radius, steps)
    return jnp.exp(-optical_depth(atmosphere, columns_along(atmosphere, altitude, mu, nodes, steps)[1]))


def to_sun(atmosphere: Atmosphere, altitude: Altitude, mu_s: Cosine) -> Transmittance:
    """Transmittance from a point to the sun; 0 in the planet's shadow (Bruneton & Neyret 2008, L_0)."""
    columns, free = to_top(atmosphere, altitude, mu_s)
    # The columns of a blocked ray mean nothing: put nothing under the exponential.
    depth = jnp.where(free[..., None], optical_depth(atmosphere, columns), 0)
    return jnp.where(free[..., None], jnp.exp(-depth), 0)
