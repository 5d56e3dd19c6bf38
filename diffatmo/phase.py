"""Phase functions: how much light turns by how much.

Every phase function is normalised to ``∫ P dΩ = 1`` over the sphere (unit sr^-1) and takes ``nu``, the cosine of the angle
between the incoming and the outgoing direction of travel: forward scattering is ``nu = +1``. Legendre moments are those of
``P(nu) = Σ_l (2l + 1)/(4π) χ_l P_l(nu)``, so ``χ_0 = 1`` and ``χ_1`` is the asymmetry.

The aerosol's is chosen by name, or is a :class:`PhaseTable`: measured, or computed by Mie's theory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffatmo._types import Cosine, Scalar
from diffatmo.numerics import gauss_legendre, safe_divide, safe_sqrt

MiePhase = Literal["henyey-greenstein", "cornette-shanks"]
MIE_PHASES: tuple[str, ...] = get_args(MiePhase)

REPEATED_DEGREE = 192
"""Degree to which a table that is convolved with itself is expanded: rings of a degree or so are lost."""


@dataclass(frozen=True)
class PhaseTable:
    """A phase function given at scattering angles, degrees, from 0 (forward) to 180; linear in nu in between.

    ``values`` may be in any unit: they are normalised where they are used. A table is data, like a name: nothing is
    differentiated by it, and the asymmetry of the atmosphere has no part in it. Raises :class:`ValueError`.
    """

    angles_deg: tuple[float, ...]
    values: tuple[float, ...]

    def __init__(self, angles_deg: Sequence[float], values: Sequence[float]) -> None:
        angles, heights = np.asarray(angles_deg, float), np.asarray(values, float)
        if angles.ndim != 1 or angles.shape != heights.shape or angles.size < 2:
            raise ValueError(f"{angles.size} angles and {heights.size} values, expected two or more of each, as many")
        if not (np.all(np.diff(angles) > 0) and angles[0] == 0 and angles[-1] == 180):
            raise ValueError("angles expected to rise from 0 to 180 degrees")
        if not (np.all(np.isfinite(heights)) and np.all(heights >= 0) and np.any(heights > 0)):
            raise ValueError("values expected to be finite and not negative, and not all 0")
        object.__setattr__(self, "angles_deg", tuple(angles.tolist()))
        object.__setattr__(self, "values", tuple(heights.tolist()))

    @property
    def asymmetry(self) -> float:
        """Mean of nu."""
        return float(_table_moments(self, 1)[1])


Shape: TypeAlias = str | PhaseTable
"""What stands for the aerosol's phase function: one of ``MIE_PHASES``, or a table."""


@lru_cache
def _nodes(table: PhaseTable) -> tuple[np.ndarray, np.ndarray]:
    """nu, rising, and the normalised values there."""
    # cos(0) and cos(π) are exact; rounding must not put an end inside.
    nu = np.cos(np.radians(np.asarray(table.angles_deg)))[::-1]
    values = np.asarray(table.values)[::-1]
    return nu, values / (2 * np.pi * np.trapezoid(values, nu))


@lru_cache
def _table_moments(table: PhaseTable, degree: int) -> np.ndarray:
    """χ_0 … χ_degree: Gauss's rule on every segment, exact for a line times P_l."""
    nu, values = _nodes(table)
    t, w = gauss_legendre(degree // 2 + 2)
    step = np.diff(nu)[:, None]
    x = nu[:-1, None] + step * t
    p = values[:-1, None] * (1 - t) + values[1:, None] * t
    return np.asarray(2 * np.pi * np.einsum("st,stl->l", p * step * w, np.polynomial.legendre.legvander(x, degree)))


@lru_cache
def _table_repeated(table: PhaseTable, order: int, degree: int) -> np.ndarray:
    """The table convolved ``order`` times with itself, less its moments up to ``degree``, at the nodes."""
    nu, _ = _nodes(table)
    moments = _table_moments(table, REPEATED_DEGREE) ** order
    moments[: degree + 1] = 0
    weight = (2 * np.arange(moments.size) + 1) / (4 * np.pi)
    return np.asarray(np.polynomial.legendre.legvander(nu, REPEATED_DEGREE) @ (weight * moments))


def _interpolate(nu: Cosine, table: PhaseTable, values: np.ndarray) -> Float[Array, "..."]:
    nodes, _ = _nodes(table)
    return jnp.interp(nu, jnp.asarray(nodes, nu.dtype), jnp.asarray(values, nu.dtype))


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


def mie(nu: Cosine, g: Scalar, name: Shape) -> Float[Array, "..."]:
    """The aerosol phase function called ``name`` (one of ``MIE_PHASES``), or that of a table."""
    if isinstance(name, PhaseTable):
        return _interpolate(nu, name, _nodes(name)[1])
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


def mie_moments(g: Scalar, degree: int, name: Shape) -> Float[Array, " l"]:
    """χ_0 … χ_degree of the aerosol phase function.

    Henyey-Greenstein: g^l. Cornette-Shanks is (1 + nu²) times that, so each of its moments is a short combination of
    neighbours: nu² P_l has components at l - 2, l and l + 2 only.
    """
    if isinstance(name, PhaseTable):
        return jnp.asarray(_table_moments(name, degree), g.dtype)
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


def repeated(nu: Cosine, g: Scalar, name: Shape, order: int, degree: int) -> Float[Array, "..."]:
    """Phase function of ``order`` aerosol scatterings in a row, less its moments up to ``degree``, sr^-1.

    A phase function convolved n times with itself has its moments to the power of n: Henyey-Greenstein is then that of g^n.
    The peak of Cornette-Shanks is that of Henyey-Greenstein times 3 / (2 + g²).
    """
    if isinstance(name, PhaseTable):
        return _interpolate(nu, name, _table_repeated(name, order, degree))
    height = 1.0 if name == "henyey-greenstein" else (3 / (2 + g**2)) ** order
    kept = ((2 * np.arange(degree + 1) + 1) / (4 * np.pi)).astype(nu.dtype)
    low = legendre(degree, nu) @ (kept * _powers(g**order, degree))
    return height * (henyey_greenstein(nu, g**order) - low)


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


def _sample_table(u: Float[Array, "..."], table: PhaseTable) -> Cosine:
    """Invert the cumulative distribution of a table, which between its nodes is a quadratic."""
    nodes, values = (jnp.asarray(a, u.dtype) for a in _nodes(table))
    step = jnp.diff(nodes)
    mass = jnp.pi * step * (values[1:] + values[:-1])
    before = jnp.cumsum(mass) - mass
    segment = jnp.clip(jnp.searchsorted(before, u, side="right") - 1, 0, step.size - 1)
    inside = jnp.clip(safe_divide(u - before[segment], mass[segment]), 0, 1)
    low, high = values[segment], values[segment + 1]
    slope = safe_divide(high - low, high + low)
    root = safe_sqrt((1 - slope) * (1 - slope) + 4 * slope * inside)
    return nodes[segment] + step[segment] * jnp.clip(safe_divide(2 * inside, 1 - slope + root), 0, 1)


def sample_mie(u: Float[Array, "..."], g: Scalar, name: Shape) -> Cosine:
    """A cosine distributed by :func:`sampled_density` from uniform ``u`` in [0, 1)."""
    return _sample_table(u, name) if isinstance(name, PhaseTable) else sample_henyey_greenstein(u, g)


def sampled_density(nu: Cosine, g: Scalar, name: Shape) -> Float[Array, "..."]:
    """Density, sr^-1, of :func:`sample_mie`: that of the phase function, but of Henyey-Greenstein for Cornette-Shanks.

    The two differ by a factor between 3/2 / (2 + g²) and 3 / (2 + g²), which weights can bear.
    """
    return mie(nu, g, name) if isinstance(name, PhaseTable) else henyey_greenstein(nu, g)


def sample_rayleigh(u: Float[Array, "..."]) -> Cosine:
    """Invert Rayleigh's cumulative distribution: the real root of nu³ + 3 nu + 4 - 8u = 0 (Frisvad 2011)."""
    half = 2 * (1 - 2 * u)
    root = jnp.cbrt(jnp.sqrt(half * half + 1) + jnp.abs(half))
    return jnp.sign(half) * (1 / root - root)


def moments_by_quadrature(name: Shape, g: float, degree: int, nodes: int = 400) -> Float[Array, " l"]:
    """χ_l by brute force, 2π ∫ P(nu) P_l(nu) dnu: the independent twin of :func:`mie_moments`."""
    nu, weight = gauss_legendre(nodes, -1.0, 1.0)
    value = jax.vmap(lambda x: mie(x, jnp.asarray(g), name))(jnp.asarray(nu))
    return 2 * jnp.pi * jnp.asarray(weight) * value @ legendre(degree, jnp.asarray(nu))
