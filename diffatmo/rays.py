"""Quadrature nodes along a ray through the shell.

A ray is cut into pieces on which its altitude is monotonic: down to its lowest point (perigee or ground), then up. Along a
piece the distance from the perigee is ``z(h) = sqrt((h - p)(h + p + 2R))`` with ``p`` the perigee's altitude, so with
``v = sqrt(h - p)`` distance is a smooth function of ``v``, through the perigee as well. Nodes are Gauss-Legendre in a
variable ``s`` that is linear in ``v`` at the lower end and turns into ``1 - exp(-h / stretch)`` higher up: an exponential
density becomes a polynomial of degree ``stretch / scale height`` in ``s``, which Gauss's rule integrates exactly.
"""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffatmo import geometry
from diffatmo._types import Altitude, Cosine, Length, Scalar
from diffatmo.numerics import bounded_divide, gauss_legendre, once, safe_divide, safe_sqrt

STRETCH = 0.15
"""Stretch of the altitude map as a fraction of the atmosphere's thickness: 15 km on Earth, above every scale height."""


PIECES = 2
"""Pieces of a ray that is not cut at the planet's shadow."""


class Nodes(NamedTuple):
    """Quadrature along rays, in path order. ``n`` counts the nodes of all pieces."""

    altitude: Float[Array, "... n"]
    """km."""
    distance: Float[Array, "... n"]
    """From the start of the ray, km."""
    weight: Float[Array, "... n"]
    """km: the integral of f along the ray is ``sum(weight * f)``."""


@lru_cache
def rule(count: int, dtype: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [0, 1], and the matrix of integrals from 0 to each node, as ``dtype``.

    Row n of the matrix integrates the polynomial through the values at all nodes from 0 to node n: spectral accuracy.
    """
    t, w = gauss_legendre(count)
    coefficients = np.linalg.inv(np.polynomial.legendre.legvander(2 * t - 1, count - 1))
    integral = np.stack(
        [
            np.polynomial.legendre.legval(2 * t - 1, np.polynomial.legendre.legint(row, lbnd=-1))
            for row in np.eye(count)
        ],
        axis=-1,
    )
    return t.astype(dtype), w.astype(dtype), (0.5 * integral @ coefficients).astype(dtype)


def _piece(
    lower: Altitude,
    upper: Altitude,
    v_lower: Length,
    perigee: Altitude,
    radius: Scalar,
    stretch: Length,
    s: Float[Array, "... n"],
) -> tuple[Float[Array, "... n"], Float[Array, "... n"], Float[Array, "... n"]]:
    """Altitude, distance from the perigee and d(distance)/ds at positions ``s`` of [0, 1] between two altitudes."""
    lower, v, perigee = lower[..., None], v_lower[..., None], perigee[..., None]
    span = stretch * -jnp.expm1(-(upper[..., None] - lower) / stretch)
    # v + k s reaches sqrt(v² + span) at s = 1.
    end = safe_sqrt(v * v + span)
    k = bounded_divide(span, v + end)
    risen = k * s * (2 * v + k * s)
    shrink = 1 - risen / stretch
    # Not log(shrink): of small climbs it is a rounding error, by which v_here may be far from v + k s.
    climb = -stretch * jnp.log1p(-risen / stretch)
    altitude = lower + climb
    v_here = safe_sqrt(v * v + climb)
    root = jnp.sqrt(altitude + perigee + 2 * radius)
    slope = 2 * k * bounded_divide(v + k * s, shrink * v_here, 1.0) * ((radius + altitude) / root)
    return altitude, v_here * root, slope


def shadow_crossings(altitude: Altitude, mu: Cosine, mu_s: Cosine, nu: Cosine, radius: Scalar) -> tuple[Length, Length]:
    """Distances at which the ray's line enters and leaves the planet's shadow, km; negative where it does not.

    The shadow is the half-cylinder of radius R behind the planet: distance from the sun's axis R, behind the terminator.
    """
    r = radius + altitude
    a = (1 - nu) * (1 + nu)
    b = r * (mu - mu_s * nu)
    c = altitude * (altitude + 2 * radius) - (r * mu_s) ** 2
    discriminant = b * b - a * c
    root = safe_sqrt(discriminant)
    crossings = []
    for sign in (-1, 1):
        distance = safe_divide(sign * root - b, a, -1.0)
        behind = (discriminant > 0) & (r * mu_s + distance * nu < 0)
        crossings.append(jnp.where(behind, distance, -1.0))
    return once((crossings[0], crossings[1]))


def trace(
    altitude: Altitude,
    mu: Cosine,
    ground: Bool[Array, "..."],
    radius: Scalar,
    top_altitude: Altitude,
    steps: int,
    crossings: tuple[Length, Length] | None = None,
) -> Nodes:
    """Nodes from a start inside the atmosphere to the end of the ray: :func:`place` by Gauss's rule of ``steps`` nodes."""
    s, w, _ = rule(steps, jnp.result_type(mu).name)
    by_piece = place(altitude, mu, ground, radius, top_altitude, s, w, crossings)
    return Nodes(*(part.reshape(*part.shape[:-2], -1) for part in by_piece))


def place(
    altitude: Altitude,
    mu: Cosine,
    ground: Bool[Array, "..."],
    radius: Scalar,
    top_altitude: Altitude,
    s: Float[np.ndarray, "... n"],
    w: Float[np.ndarray, "... n"],
    crossings: tuple[Length, Length] | None = None,
) -> Nodes:
    """Nodes at positions ``s``, with weights ``w``, of [0, 1] on every piece of a ray; pieces have an axis before the nodes'.

    Without ``crossings`` two pieces: one on either side of the perigee, or of the middle of a ray that only rises or only
    falls (onto the ``ground``). With ``crossings``, two distances (km, negative for none) at which the integrand jumps,
    four pieces: each of the two is cut once more, and the cuts fall on the crossings.
    """
    altitude, mu, top = jnp.broadcast_arrays(altitude, mu, top_altitude)
    stretch = STRETCH * top
    perigee = geometry.perigee_altitude(altitude, mu, radius)
    r_mu = (radius + altitude) * mu
    limb = (mu < 0) & ~ground
    # |v| at the lowest point: where the ray starts, without the square root that has no derivative at the horizontal.
    v_start = jnp.abs(mu) * jnp.sqrt((radius + altitude) / (1 + geometry.sine(mu)))
    bottom = jnp.where(limb, perigee, jnp.where(ground, 0.0, altitude))
    v_bottom = jnp.where(limb, 0.0, jnp.where(ground, safe_sqrt(jnp.where(ground, -perigee, 0)), v_start))
    heights = [
        jnp.where(d > 0, geometry.altitude_along(altitude, mu, jnp.maximum(d, 0), radius), -1.0)
        for d in (crossings or ())
    ]

    def cut(low: Altitude, high: Altitude, sign: Length, candidates: list[int]) -> Altitude:
        """Where a leg between two altitudes is cut: at the first crossing on it, else in the middle of its map."""
        middle = low - stretch * jnp.log1p(0.5 * jnp.expm1(-(high - low) / stretch))
        for index in reversed(candidates):
            here, distance = heights[index], crossings[index] if crossings else 0.0
            on_leg = (here > low) & (here < high) & (sign * (r_mu + distance) >= 0)
            middle = jnp.where(on_leg, here, middle)
        return middle

    rises = jnp.where(ground, -1.0, 1.0)
    first_sign = jnp.where(limb, -1.0, rises)
    far = jnp.where(ground, altitude, top)
    # Leaving the shadow is the crossing that lights the ray: prefer it for the cut that every ray has.
    waist = jnp.where(limb, perigee, cut(bottom, far, rises, [1, 0] if crossings else []))
    legs = [
        (jnp.where(limb | ground, waist, bottom), jnp.where(limb | ground, altitude, waist), first_sign),
        (jnp.where(ground, bottom, waist), jnp.where(ground, waist, top), rises),
    ]
    pieces = []
    for low, high, sign in legs:
        if crossings is None:
            pieces.append((low, high, sign))
            continue
        between = cut(low, high, sign, [0, 1])
        ascending = sign > 0
        pieces.append((jnp.where(ascending, low, between), jnp.where(ascending, between, high), sign))
        pieces.append((jnp.where(ascending, between, low), jnp.where(ascending, high, between), sign))

    low, high, sign = once(tuple(jnp.stack(parts, axis=-1) for parts in zip(*pieces, strict=True)))
    v_bottom, bottom, perigee, r_mu = once(
        (v_bottom[..., None], bottom[..., None], perigee[..., None], r_mu[..., None])
    )
    # With no derivative where it is 0: of a ray that starts all but horizontally it would be 1 / v, and drown all others.
    rise = jnp.where(low > bottom, low - bottom, 0)
    v_low = once(v_bottom + bounded_divide(rise, v_bottom + safe_sqrt(v_bottom * v_bottom + rise)))
    position = jnp.where(sign[..., None] > 0, s, 1 - s)
    h, z, slope = _piece(low, high, v_low, perigee, radius, stretch[..., None, None], position)
    distance = jnp.maximum(sign[..., None] * z - r_mu[..., None], 0)
    return once(Nodes(h, distance, slope * w))


def straight(altitude: Altitude, mu: Cosine, length: Length, radius: Scalar, steps: int) -> Nodes:
    """Nodes on the first ``length`` km of a ray: one piece, Gauss-Legendre in distance."""
    t, w, _ = rule(steps, length.dtype.name)
    distance = length[..., None] * t
    there = geometry.altitude_along(altitude[..., None], mu[..., None], distance, radius)
    return Nodes(jnp.maximum(there, 0), distance, jnp.broadcast_to(length[..., None] * w, distance.shape))


def accumulate(
    values: Float[Array, "... n"], nodes: Nodes, steps: int
) -> tuple[Float[Array, "... n"], Float[Array, "..."]]:
    """Integrals of ``values`` from the start of the ray to each node, and to its end."""
    _, w, cumulative = rule(steps, values.dtype.name)
    pieces = nodes.weight.shape[-1] // steps
    per_unit = (values * (nodes.weight / np.tile(w, pieces))).reshape(*values.shape[:-1], pieces, steps)
    whole = per_unit @ w
    before = jnp.cumsum(whole, axis=-1) - whole
    within = per_unit @ cumulative.T
    return (within + before[..., None]).reshape(values.shape), jnp.sum(whole, axis=-1)
