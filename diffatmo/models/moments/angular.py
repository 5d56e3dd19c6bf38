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


def degrees(degree: int) -> np.ndarray:
    """l of every pair."""
    return np.array([order for order, _ in pairs(degree)])


def orders(degree: int) -> np.ndarray:
    """m of every pair."""
    return np.array([m for _, m in pairs(degree)])


@lru_cache
def norms(degree: int) -> np.ndarray:
    """Squared norms N_lm of the real spherical harmonics."""
    return np.array(
        [
            (2 - (m == 0)) * (2 * order + 1) / (4 * math.pi) * math.factorial(order - m) / math.factorial(order + m)
            for order, m in pairs(degree)
        ]
    )


@lru_cache
def _expansion(degree: int) -> np.ndarray:
    """Coefficients of every Π_lm = d^m P_l / dmu^m in T_0 … T_degree, in which they are well conditioned."""
    matrix = np.zeros((degree + 1, len(pairs(degree))))
    for column, (order, m) in enumerate(pairs(degree)):
        derivative = np.polynomial.legendre.legder(np.eye(order + 1)[order], m)
        chebyshev = np.polynomial.chebyshev.poly2cheb(np.polynomial.legendre.leg2poly(derivative))
        matrix[: chebyshev.size, column] = chebyshev
    return matrix


def polar(degree: int, mu: Cosine) -> Float[Array, "... lm"]:
    """Π_lm(mu) for all (l, m)."""
    return table.chebyshev(degree + 1, mu) @ jnp.asarray(_expansion(degree), mu.dtype)


def plane(mu: Cosine, mu_s: Cosine, nu: Cosine) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """w = sinθ sinθ_s cos φ and q = (sinθ sinθ_s)²."""
    return nu - mu * mu_s, (1 - mu * mu) * (1 - mu_s * mu_s)


def azimuthal(degree: int, w: Float[Array, "..."], q: Float[Array, "..."]) -> list[Float[Array, "..."]]:
    """C_m(w, q) = (sinθ sinθ_s)^m cos(m φ) for m = 0 … degree: multiples of an angle without the angle."""
    multiple = [jnp.ones_like(w), w]
    for _ in range(2, degree + 1):
        multiple.append(2 * w * multiple[-1] - q * multiple[-2])
    return multiple[: degree + 1]


def projection(degree: int, mu: Cosine) -> Float[Array, "... lm"]:
    """N_lm Π_lm(mu) sin^m θ for all (l, m): what a radiance is multiplied by to find its moments."""
    powers = [jnp.ones_like(mu)]
    for _ in range(degree):
        powers.append(powers[-1] * geometry.sine(mu))
    sines = jnp.stack(powers, axis=-1)[..., orders(degree)]
    return jnp.asarray(norms(degree), mu.dtype) * polar(degree, mu) * sines


def cosines(azimuths: int, dtype: jnp.dtype) -> Float[Array, " p"]:
    """Cosines of the midpoints of ``azimuths`` equal parts of [0, π]."""
    return jnp.asarray(table.chebyshev_nodes(azimuths), dtype)


def relative_nu(mu: Cosine, mu_s: Cosine, cosine: Float[Array, "..."]) -> Cosine:
    """Cosine between view and sun from their zenith angles and the cosine of the azimuth between them."""
    return mu * mu_s + geometry.sine(mu) * geometry.sine(mu_s) * cosine
