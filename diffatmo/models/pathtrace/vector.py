"""Vectors as three separate arrays: XLA turns a stacked one back into branches inside its loops, at five times the cost."""

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffatmo._types import Cosine
from diffatmo.numerics import safe_sqrt

Vector: TypeAlias = tuple[Float[Array, " lanes"], Float[Array, " lanes"], Float[Array, " lanes"]]


def dot(a: Vector, b: Vector) -> Float[Array, " lanes"]:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cosine(a: Vector, b: Vector) -> Cosine:
    """Cosine of the angle between unit vectors, never beyond ±1."""
    return jnp.clip(dot(a, b), -1, 1)


def combine(*terms: tuple[Float[Array, " lanes"], Vector]) -> Vector:
    """Sum of (factor, vector) pairs."""
    x, y, z = (sum(factor * vector[i] for factor, vector in terms) for i in range(3))
    return x, y, z


def unit(a: Vector) -> Vector:
    """Scaled to length 1."""
    return combine((jax.lax.rsqrt(dot(a, a)), a))


def where(condition: Bool[Array, " lanes"], a: Vector, b: Vector) -> Vector:
    """``a`` where the condition holds, else ``b``."""
    return jnp.where(condition, a[0], b[0]), jnp.where(condition, a[1], b[1]), jnp.where(condition, a[2], b[2])


def towards(axis: Vector, aim: Vector) -> Vector:
    """The unit vector perpendicular to ``axis`` on the side of ``aim``; any perpendicular one where the two agree."""
    toward = combine((1.0, aim), (-dot(axis, aim), axis))
    steep = jnp.abs(axis[2]) > 0.9
    other = (jnp.where(steep, 1.0, 0.0), jnp.zeros_like(axis[0]), jnp.where(steep, 0.0, 1.0))
    return unit(where(dot(toward, toward) < 1e-6, combine((1.0, other), (-dot(axis, other), axis)), toward))


def around(axis: Vector, aim: Vector, cos_angle: Cosine, azimuth: Float[Array, " lanes"]) -> Vector:
    """The direction at an angle from ``axis``, ``azimuth`` counted from the side of ``aim``."""
    x = towards(axis, aim)
    y = (
        axis[1] * x[2] - axis[2] * x[1],
        axis[2] * x[0] - axis[0] * x[2],
        axis[0] * x[1] - axis[1] * x[0],
    )
    sine = safe_sqrt((1 - cos_angle) * (1 + cos_angle))
    return unit(combine((cos_angle, axis), (sine * jnp.cos(azimuth), x), (sine * jnp.sin(azimuth), y)))
