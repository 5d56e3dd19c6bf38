"""Phase functions: how much light turns by how much.

Every phase function is normalised to ``∫ P dΩ = 1`` over the sphere (unit sr^-1) and takes ``nu``, the cosine of the angle
between the incoming and the outgoing direction of travel: forward scattering is ``nu = +1``. Legendre moments are those of
``P(nu) = Σ_l (2l + 1)/(4π) χ_l P_l(nu)``, so ``χ_0 = 1`` and ``χ_1`` is the asymmetry.
"""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo._types import Cosine, Scalar
from diffatmo.numerics import gauss_legendre, safe_sqrt

MiePhase = Literal["henyey-greenstein", "cornette-shanks"]
MIE_PHASES: tuple[str, ...] = get_args(MiePhase)


def rayleigh(nu: Cosine) -> Float[Array, "..."]:
    """Rayleigh's phase function 3/(16π) (1 + nu²), sr^-1 (Bruneton & Neyret 2008, eq. 2)."""
    return 3 / (16 * jnp.pi) * (1 + nu * nu)


def henyey_greenstein(nu: Cosine, g: Scalar) -> Float[Array, "..."]:
    """Henyey & Greenstein 1941: (1 - g²) / (4π (1 + g² - 2 g nu)^{3/2}), sr^-1, for |g| < 1."""
    # (1 - g)² + 2 g (1 - nu) is the same number without the cancellation at nu = 1, g -> 1.
    squared = (1 - g) * (1 - g) + 2 * g * (1 - nu)
    return (1 - g) * (1 + g) / (4 * jnp.pi * squared * safe_sqrt(squared))


def cornette_shanks(nu: Cosine, g: Scalar) -> Float[Array, "..."]:
    """Cornette & Shanks 1992, as in Bruneton & Neyret 2008, eq. 4, sr^-1, for |g| < 1."""
    return henyey_greenstein(nu, g) * 3 / 2 * (1 + nu * nu) / (2 + g * g)


def mie(nu: Cosine, g: Scalar, name: str) -> Float[Array, "..."]:
    """The aerosol phase function called ``name`` (one of ``MIE_PHASES``)."""
    if name == "henyey-greenstein":
        return henyey_greenstein(nu, g)
    if name == "cornette-shanks":
        return cornette_shanks(nu, g)
    raise ValueError(f"mie_phase: unknown phase function {name!r}; known are {', '.join(MIE_PHASES)}")


def rayleigh_moments(degree: int) -> Float[np.ndarray, " l"]:
    """χ_0 … χ_degree of Rayleigh's phase function: 1, 0, 1/10, 0, … exactly."""
    moments = np.zeros(degree + 1)
    moments[0] = 1
    if degree >= 2:
        moments[2] = 0.1
    return moments


def _powers(g: Scalar, degree: int) -> Float[Array, " l"]:
    """g^0 … g^degree as running products: value and derivative are exact at g = 0, unlike those of ``g ** l``."""
    powers = [jnp.ones_like(g)]
    for _ in range(degree):
        powers.append(powers[-1] * g)
    return jnp.stack(powers)


def mie_moments(g: Scalar, degree: int, name: str) -> Float[Array, " l"]:
    """χ_0 … χ_degree of the aerosol phase function.

    Henyey-Greenstein: g^l. Cornette-Shanks is (1 + nu²) times that, so each of its moments is a short combination of
    neighbours: nu² P_l has components at l - 2, l and l + 2 only.
    """
    if name == "henyey-greenstein":
        return _powers(g, degree)
    if name != "cornette-shanks":
        raise ValueError(f"mie_phase: unknown phase function {name!r}; known are {', '.join(MIE_PHASES)}")
    b = _powers(g, degree + 2)
    order = np.arange(degree + 1)
    # ∫ nu² P_l Σ_k (2k+1)/2 b_k P_k dnu, from (2l+1) nu P_l = (l+1) P_{l+1} + l P_{l-1} applied twice.
    above = (order + 1) * (order + 2) / ((2 * order + 1) * (2 * order + 3))
    same = (2 * order**2 + 2 * order - 1) / ((2 * order - 1.0) * (2 * order + 3))
    below = order * (order - 1) / ((2 * order + 1) * (2 * order - 1.0))
    two_below = jnp.concatenate([jnp.zeros(2, b.dtype), b])[: degree + 1]
    squared = above * b[2 : degree + 3] + same * b[: degree + 1] + below * two_below
    return 3 / 2 * (b[: degree + 1] + squared) / (2 + g * g)


def legendre(degree: int, nu: Cosine) -> Float[Array, "... l"]:
    """P_0(nu) … P_degree(nu), stacked on a new last axis."""
    values = [jnp.ones_like(nu), nu]
    for order in range(2, degree + 1):
        values.append(((2 * order - 1) * nu * values[-1] - (order - 1) * values[-2]) / order)
    return jnp.stack(values[: degree + 1], axis=-1)


def sample_henyey_greenstein(u: Float[Array, "..."], g: Scalar) -> Cosine:
    """Invert the cumulative distribution: uniform ``u`` in [0, 1) to ``nu``, without a branch or a division by g.

    1 - nu = 2 (1-g)² (1-u)(1+g u) / ((1-g) + 2 g u)²; smooth through g = 0, where nu = 2u - 1.
    """
    denominator = (1 - g) + 2 * g * u
    return 1 - 2 * (1 - g) ** 2 * (1 - u) * (1 + g * u) / (denominator * denominator)


def sample_rayleigh(u: Float[Array, "..."]) -> Cosine:
    """Invert Rayleigh's cumulative distribution: the real root of nu³ + 3 nu + 4 - 8u = 0 (Frisvad 2011)."""
    half = 2 * (1 - 2 * u)
    root = jnp.cbrt(jnp.sqrt(half * half + 1) + jnp.abs(half))
    return jnp.sign(half) * (1 / root - root)


def moments_by_quadrature(name: str, g: float, degree: int, nodes: int = 400) -> Float[Array, " l"]:
    """χ_l by brute force, 2π ∫ P(nu) P_l(nu) dnu: the independent twin of :func:`mie_moments`."""
    nu, weight = gauss_legendre(nodes, -1.0, 1.0)
    value = jax.vmap(lambda x: mie(x, jnp.asarray(g), name))(jnp.asarray(nu))
    return 2 * jnp.pi * jnp.asarray(weight) * value @ legendre(degree, jnp.asarray(nu))
