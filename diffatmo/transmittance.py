"""Optical depth and transmittance, shared by every model.

The atmosphere's three constituents (air, aerosol, absorber) have densities that do not depend on wavelength, so what is
computed is the *column* of each, X = ∫ density ds, km; the optical depth at any number of wavelengths is a product with
the extinction coefficients (Bruneton & Neyret 2008, eq. 5). To the top of the atmosphere the columns are known in closed
form, so no table is needed: the exponential's is Chapman's function, the absorber's layer is cut at its edges.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry, rays
from diffatmo._types import Altitude, Cosine, Length, OpticalDepth, Scalar, Transmittance
from diffatmo.atmosphere import Atmosphere
from diffatmo.numerics import ERFCX_OF_ZERO, bounded_divide, per_parameter, safe_sqrt, scaled_erfcx, weighted

_SHELL_STEPS = 3
"""Gauss nodes for the altitude, nearly quadratic in distance, between two shells."""


class Columns(NamedTuple):
    """∫ density ds along a path, km.

    The absorber's tent is the sum of three ramps, and stays in three parts until it is multiplied with its coefficients: the
    optical depth is then a product of matrices, for which XLA computes the columns once, not once per wavelength.
    """

    exponential: Float[Array, "2 ..."]
    """Air, aerosol."""
    ramps: Float[Array, "3 ..."]
    """∫ max(0, a - h) ds for the upper edge, the center and the lower edge of the absorber, km²."""


def edges(atmosphere: Atmosphere) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Altitudes a_i, km, and factors c_i, km^-1, with which the absorber's density is Σ c_i max(0, a_i - h)."""
    center, half_width = atmosphere.ozone_center_altitude, atmosphere.ozone_half_width
    return center + half_width * np.array([1.0, 0.0, -1.0]), jnp.divide(np.array([1.0, -2.0, 1.0]), half_width)


def _coefficients(atmosphere: Atmosphere) -> tuple[Float[Array, "w 2"], Float[Array, "w 3"]]:
    """What the parts of :class:`Columns` are multiplied by, km^-1 and km^-2."""
    extinction = jnp.stack([atmosphere.rayleigh_scattering, atmosphere.mie_extinction], axis=1)
    return extinction, atmosphere.ozone_absorption[:, None] * edges(atmosphere)[1]


def spectral_depth(atmosphere: Atmosphere, columns: Columns) -> Float[Array, "w ..."]:
    """Optical depth with the wavelengths outermost: long inner axes keep the vector units busy."""
    scattering, absorption = _coefficients(atmosphere)
    return jnp.tensordot(scattering, columns.exponential, axes=1, precision="highest") + jnp.tensordot(
        absorption, columns.ramps, axes=1, precision="highest"
    )


def optical_depth(atmosphere: Atmosphere, columns: Columns) -> OpticalDepth:
    """Optical depth of columns."""
    return jnp.moveaxis(spectral_depth(atmosphere, columns), 0, -1)


def scale_heights(atmosphere: Atmosphere) -> Float[Array, " 2"]:
    """Those of air and of aerosol, km."""
    return jnp.stack([atmosphere.rayleigh_scale_height, atmosphere.mie_scale_height])


def _rising(
    altitude: Altitude, perigee: Altitude, v: Length, scale_height: Scalar, radius: Scalar
) -> Float[Array, "..."]:
    """Column of exp(-h / H) from a point to infinity along a ray that rises from there, over sqrt(πH): Chapman's function.

    With v = sqrt(h - p), p the altitude of the line's perigee, distance is z = v sqrt(h + p + 2R) and the column is an
    integral of exp(-v²/H) against F = (R + h) / sqrt(h + p + 2R), which varies by H / 2R over a scale height only. Taken out
    at the mean of h under the weight, it leaves sqrt(πH) exp(-h/H) erfcx(v / sqrt(H)) F: relative error (H/R)², 2e-6 on
    Earth. The mean lies H/2 (horizontal) to H (vertical) above the point.
    """
    m = v / jnp.sqrt(scale_height)
    effective = altitude + scale_height * (1 - 0.5 / (1 + m * (2 / math.sqrt(math.pi) + m)))
    # At least R; half of it where rounding, far off a small planet, has put the perigee beyond the centre.
    factor = (radius + effective) / jnp.sqrt(jnp.maximum(effective + perigee + 2 * radius, radius / 2))
    return scaled_erfcx(m, -altitude / scale_height) * factor


def _level(altitude: Altitude, scale_height: Scalar, radius: Scalar) -> Float[Array, "..."]:
    """The same along a horizontal ray, from its perigee: v = 0."""
    effective = altitude + 0.5 * scale_height
    return (
        ERFCX_OF_ZERO
        * jnp.exp(-altitude / scale_height)
        * (radius + effective)
        / jnp.sqrt(effective + altitude + 2 * radius)
    )


def ramp_columns(
    altitudes: Float[Array, " n"], perigee: Altitude, start: Length, end: Length, radius: Scalar
) -> Float[Array, "n ..."]:
    """∫ max(0, a - h) ds, km², for altitudes a between two points of a line.

    The points are signed distances from the line's ``perigee``. The part of the line under altitude a is one interval, on
    which a - h is smooth.
    """
    t, w, _ = rays.rule(_SHELL_STEPS, jnp.result_type(start).name)
    from_center = radius + perigee
    # A square millimetre more: a vertical line has its perigee at the planet's centre, where the root is 0.
    squared = from_center * from_center + 1e-12
    a = altitudes.reshape(-1, *[1] * jnp.broadcast_arrays(perigee, start, end)[0].ndim)
    reach = safe_sqrt((a - perigee) * (a + perigee + 2 * radius))
    low, high = jnp.clip(start, -reach, reach), jnp.clip(end, -reach, reach)
    length, depth = high - low, a - perigee
    for position, weight in zip(t, w, strict=True):
        z_squared = (low + length * position) ** 2
        # Less the height above the perigee. Far off a small planet, rounding may put that well beyond the centre.
        depth = depth - weight * z_squared / jnp.maximum(jnp.sqrt(squared + z_squared) + from_center, 1e-6)
    return length * depth


def _exponentials_to_top(
    heights: Float[Array, " n"], altitude: Altitude, mu: Cosine, radius: Scalar, top: Altitude
) -> Float[Array, "n ..."]:
    """Columns of exp(-h / H) from a point to the top: to infinity, less what is above the top.

    A ray that falls to a perigee p and rises again has X(h, -mu) = 2 X(p, 0) - X(h, mu).
    """
    perigee = geometry.perigee_altitude(altitude, mu, radius)
    v = jnp.abs(mu) * jnp.sqrt((radius + altitude) / (1 + geometry.sine(mu)))
    rise = jnp.maximum(top - altitude, 0)
    v_top = v + bounded_divide(rise, v + safe_sqrt(v * v + rise))
    lowest = jnp.maximum(perigee, 0)
    scale_height = heights.reshape(-1, *[1] * v.ndim)
    here = _rising(altitude, perigee, v, scale_height, radius)
    above = _rising(altitude + rise, perigee, v_top, scale_height, radius)
    level = _level(lowest, scale_height, radius)
    return jnp.sqrt(math.pi * scale_height) * (jnp.where(mu < 0, 2 * level - here, here) - above)


_columns_to_top = per_parameter(_exponentials_to_top)
_depth_to_top = weighted(_exponentials_to_top)


def _ramps_to_top(
    atmosphere: Atmosphere, altitude: Altitude, mu: Cosine
) -> tuple[Float[Array, "3 ..."], Bool[Array, "..."]]:
    """The absorber's part of :func:`to_top`, and whether the ray is free."""
    radius, top = atmosphere.bottom_radius, atmosphere.top_altitude
    perigee = geometry.perigee_altitude(altitude, mu, radius)
    end = safe_sqrt((top - perigee) * (top + perigee + 2 * radius))
    ramps = ramp_columns(edges(atmosphere)[0], perigee, (radius + altitude) * mu, end, radius)
    return ramps, (mu >= 0) | (perigee >= 0)


def to_top(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine) -> tuple[Columns, Bool[Array, "..."]]:
    """Columns from a point inside the atmosphere to the top, and whether the ray is free (does not meet the ground).

    The columns of a ray that is not free are finite but mean nothing.
    """
    ramps, free = _ramps_to_top(atmosphere, altitude, mu)
    planet = atmosphere.bottom_radius, atmosphere.top_altitude
    return Columns(_columns_to_top(scale_heights(atmosphere), altitude, mu, *planet), ramps), free


@per_parameter
def exponentials(heights: Float[Array, " n"], altitude: Altitude) -> Float[Array, "n ..."]:
    """exp(-h / H): with two scale heights the relative densities of air and of aerosol."""
    return jnp.exp(-altitude / heights.reshape(-1, *[1] * altitude.ndim))


def columns_along(
    atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, nodes: rays.Nodes, steps: int
) -> tuple[Columns, Columns]:
    """Columns from the start of a ray to each of its nodes, and to its end."""
    both = columns_to(atmosphere, altitude, mu, nodes, steps)
    return jax.tree.map(lambda x: x[..., :-1], both), jax.tree.map(lambda x: x[..., -1], both)


def columns_to(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, nodes: rays.Nodes, steps: int) -> Columns:
    """The same in one: to the nodes and, last, to the end."""
    radius = atmosphere.bottom_radius
    perigee = geometry.perigee_altitude(altitude, mu, radius)
    start = (radius + altitude) * mu
    densities = exponentials(scale_heights(atmosphere), nodes.altitude)
    inside, whole = rays.accumulate(densities, nodes, steps)
    tops, _ = edges(atmosphere)
    length = jnp.sum(nodes.weight, axis=-1, keepdims=True)
    ends = start[..., None] + jnp.concatenate([nodes.distance, length], axis=-1)
    ramps = ramp_columns(tops, perigee[..., None], start[..., None], ends, radius)
    return Columns(jnp.concatenate([inside, whole[..., None]], axis=-1), ramps)


def along(atmosphere: Atmosphere, altitude: Altitude, mu: Cosine, distance: Length, steps: int = 48) -> Transmittance:
    """Transmittance of the first ``distance`` km of a ray inside the atmosphere."""
    nodes = rays.straight(altitude, mu, distance, atmosphere.bottom_radius, steps)
    return jnp.exp(-optical_depth(atmosphere, columns_along(atmosphere, altitude, mu, nodes, steps)[1]))


def spectral_to_sun(atmosphere: Atmosphere, altitude: Altitude, mu_s: Cosine) -> Float[Array, "w ..."]:
    """:func:`to_sun` with the wavelengths outermost, as in :func:`spectral_depth`.

    Its derivative costs less than that of :func:`to_top`: columns for every tangent are not made.
    """
    ramps, free = _ramps_to_top(atmosphere, altitude, mu_s)
    planet = atmosphere.bottom_radius, atmosphere.top_altitude
    scattering, absorption = _coefficients(atmosphere)
    depth = _depth_to_top(scattering, scale_heights(atmosphere), altitude, mu_s, *planet)
    depth = depth + jnp.tensordot(absorption, ramps, axes=1, precision="highest")
    # The columns of a blocked ray mean nothing: put nothing under the exponential.
    return jnp.exp(-jnp.where(free, depth, 0)) * free


def to_sun(atmosphere: Atmosphere, altitude: Altitude, mu_s: Cosine) -> Transmittance:
    """Transmittance from a point to the sun; 0 in the planet's shadow (Bruneton & Neyret 2008, L_0)."""
    return jnp.moveaxis(spectral_to_sun(atmosphere, altitude, mu_s), 0, -1)
