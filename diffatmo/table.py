"""Lookup tables: a unit coordinate for each axis, and local cubic interpolation in it.

A table is a plain array with ``n`` values at the unit positions ``0, 1/(n-1), …, 1`` of each tabulated axis. How a unit
position maps to a physical quantity belongs to whoever made the table; the two maps here are the ones that are needed
again and again. Interpolation is Lagrange's through the four nearest nodes (fourth-order accurate); positions outside
[0, 1] extrapolate the end cubic.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def stretch(unit: Float[Array, "..."], linear: float) -> Float[Array, "..."]:
    """[0, 1] -> [0, 1], quadratic with a linear part: ``a u + (1 - a) u²``; clusters values at 0."""
    return unit * (linear + (1 - linear) * unit)


def unstretch(value: Float[Array, "..."], linear: float) -> Float[Array, "..."]:
    """Inverse of :func:`stretch`; its slope at 0 is the finite ``1 / linear``, where a bare square root has none."""
    return 2 * value / (linear + jnp.sqrt(linear * linear + 4 * (1 - linear) * value))


class Stencil(NamedTuple):
    """Four neighbouring nodes of an axis, and the weight of each: a small thing to keep where dense rows are a large one."""

    first: Int[Array, "..."]
    """The first of the nodes."""
    weights: tuple[Float[Array, "..."], ...]

    def scaled(self, factor: Float[Array, "..."]) -> "Stencil":
        """What is looked up, times ``factor``."""
        return Stencil(self.first, tuple(factor * weight for weight in self.weights))

    def rows(self, count: int, axis: int = -1) -> Float[Array, "... n"]:
        """The weights as dense rows over all ``count`` nodes, on a new ``axis``, for interpolation by matrix product."""
        axis = axis % (self.first.ndim + 1)
        nodes = jnp.expand_dims(jnp.arange(count), [a for a in range(self.first.ndim + 1) if a != axis])
        offset = nodes - jnp.expand_dims(self.first, axis)
        rows = jnp.zeros((), self.weights[0].dtype)
        for number, weight in enumerate(self.weights):
            rows = jnp.where(offset == number, jnp.expand_dims(weight, axis), rows)
        return rows


def cubic(unit: Float[Array, "..."], count: int) -> Stencil:
    """The nodes and Lagrange weights for interpolation at ``unit`` in ``count`` equidistant nodes on [0, 1]."""
    position = unit * (count - 1)
    first = jnp.clip(jnp.floor(position).astype(jnp.int32) - 1, 0, count - 4)
    t = position - first
    return Stencil(
        first,
        (
            (t - 1) * (t - 2) * (3 - t) / 6,
            t * (t - 2) * (t - 3) / 2,
            t * (t - 1) * (3 - t) / 2,
            t * (t - 1) * (t - 2) / 6,
        ),
    )


def cubic_weights(unit: Float[Array, "..."], count: int) -> tuple[Int[Array, "..."], Float[Array, "... 4"]]:
    """The first node of :func:`cubic`, and its weights in one array."""
    first, weights = cubic(unit, count)
    return first, jnp.stack(weights, axis=-1)


def interpolate(
    table: Float[Array, "nx ny c"], x: Float[Array, "..."], y: Float[Array, "..."]
) -> Float[Array, "... c"]:
    """Bicubic lookup of a two-dimensional table of ``c`` components at unit positions ``x`` and ``y``."""
    nx, ny, components = table.shape
    ix, wx = cubic_weights(x, nx)
    iy, wy = cubic_weights(y, ny)
    flat = table.reshape(nx * ny, components)
    result = jnp.zeros((*jnp.broadcast_shapes(x.shape, y.shape), components), table.dtype)
    for a in range(4):
        for b in range(4):
            corner = flat[(ix + a) * ny + iy + b]
            result = result + (wx[..., a] * wy[..., b])[..., None] * corner
    return result


def chebyshev(count: int, x: Float[Array, "..."]) -> Float[Array, "... k"]:
    """T_0(x) … T_{count-1}(x), stacked on a new last axis."""
    values = [jnp.ones_like(x), x]
    for _ in range(2, count):
        values.append(2 * x * values[-1] - values[-2])
    return jnp.stack(values[:count], axis=-1)


def chebyshev_nodes(count: int) -> Float[np.ndarray, " k"]:
    """The zeros of T_count: cosines of equidistant angles, strictly inside (-1, 1), descending."""
    return np.cos(np.pi * (np.arange(count) + 0.5) / count)


def chebyshev_coefficients(count: int) -> Float[np.ndarray, "k k"]:
    """Matrix from values at :func:`chebyshev_nodes` to the coefficients of T_0 … T_{count-1} (discrete cosines)."""
    angle = np.pi * (np.arange(count) + 0.5) / count
    matrix = 2 / count * np.cos(np.arange(count)[:, None] * angle)
    matrix[0] /= 2
    return matrix
