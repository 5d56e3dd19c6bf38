"""The angular functions of the method of moments: real spherical harmonics without a singular direction."""

import math
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo import geometry, table
from diffatmo._types import Cosine


@lru_cache
def pairs(degree: int) -> tuple[tuple[int, int], ...]:
    """All (l, m) with 0 <= m <= l <= degree, by rising degree."""
    return tuple((order, m) for order in range(degree + 1) for m in range(order + 1))


@lru_cache
def norms(degree: int) -> np.ndarray:
    """Squared norms N_lm of the real spherical harmonics."""
    return np.array(
        [
            (2 - (m == 0)) * (2 * order + 1) / (4 * math.pi) * math.factorial(order - m) / math.factorial(order + m)
            for order, m in pairs(degree)
        ]
    )


def polynomials(degree: int, mu: Cosine) -> list[list[Float[Array, "..."]]]:
    """Π_lm(mu) = d^m P_l / dmu^m as ``result[l][m]``, by the usual upward recurrence in l."""
    result: list[list[Float[Array, "..."]]] = [[] for _ in range(degree + 1)]
    for m in range(degree + 1):
        diagonal = jnp.full_like(mu, float(np.prod(np.arange(2 * m - 1, 0, -2))))
        result[m].append(diagonal)
        previous, current = jnp.zeros_like(mu), diagonal
        for order in range(m + 1, degree + 1):
            following = ((2 * order - 1) * mu * current - (order + m - 1) * previous) / (order - m)
            previous, current = current, following
            result[order].append(current)
    return result


def basis(degree: int, mu: Cosine, mu_s: Cosine, nu: Cosine) -> Float[Array, "... lm"]:
    """Π_lm(mu) C_m(w, q) for all (l, m): the angular functions of the source."""
    w = nu - mu * mu_s
    q = (1 - mu * mu) * (1 - mu_s * mu_s)
    multiple = [jnp.ones_like(w), w]
    for _ in range(2, degree + 1):
        multiple.append(2 * w * multiple[-1] - q * multiple[-2])
    by_degree = polynomials(degree, mu)
    return jnp.stack([by_degree[order][m] * multiple[m] for order, m in pairs(degree)], axis=-1)


def degrees(degree: int) -> np.ndarray:
    return np.array([order for order, _ in pairs(degree)])


def degrees_of(count: int) -> np.ndarray:
    """Degree l of each of the first ``count`` (l, m) pairs."""
    degree = next(d for d in range(count + 1) if len(pairs(d)) == count)
    return degrees(degree)


def cosines(azimuths: int, dtype: jnp.dtype) -> Float[Array, " p"]:
    """Cosines of the midpoints of ``azimuths`` equal parts of [0, π]."""
    return jnp.asarray(table.chebyshev_nodes(azimuths), dtype)


def relative_nu(mu: Cosine, mu_s: Cosine, cosine: Float[Array, "..."]) -> Cosine:
    """Cosine between view and sun from their zenith angles and the cosine of the azimuth between them."""
    return mu * mu_s + geometry.sine(mu) * geometry.sine(mu_s) * cosine
