"""Numerical building blocks whose value *and* derivative are finite everywhere.

The rule: guard the input of ``sqrt``, ``log``, ``arccos`` and ``/``, never their output. ``where(x > 0, sqrt(x), 0)``
has a NaN derivative at ``x <= 0``, because the untaken branch is differentiated as well and 0 * inf is NaN.
"""

import math
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

P = ParamSpec("P")
T = TypeVar("T")


def tiny(dtype: jnp.dtype) -> float:
    """The smallest number whose square root and reciprocal, and the square of that, do not overflow in ``dtype``."""
    return 2 * float(np.sqrt(np.finfo(dtype).tiny))


def array(value: Any, dtype: Any = None) -> Array:
    """``value`` in the ``dtype``, by default that of real numbers at present.

    What NumPy or Python hold is moved as it is, where ``jnp.asarray`` compiles a program for every shape. What is too large
    for single precision becomes infinite, without a warning.
    """
    dtype = jnp.result_type(float) if dtype is None else dtype
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
        return jnp.asarray(value, dtype)
    with np.errstate(over="ignore"):
        return jax.device_put(np.asarray(value, dtype))


def whole_products(function: Callable[P, T]) -> Callable[P, T]:
    """``function``, with products of matrices in the precision of their numbers.

    Accelerators round single precision to 10 bits there unless they are told not to, which a sky shows: 1.5e-4.
    """

    @wraps(function)
    def exact(*args: P.args, **kwargs: P.kwargs) -> T:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return exact


def once(value: T) -> T:
    """``value``, whose arrays are computed once and kept.

    XLA repeats cheap formulas in every loop that uses what comes of them: more than half of a model's operations were such
    copies. The barrier forbids it, for values and derivatives alike, where the compiler is told not to take it down before it
    merges loops, as :func:`diffatmo.compiler_options` does.
    """
    # One barrier for each array: those that do not change with what is differentiated would else be given derivatives.
    kept: T = jax.tree.map(jax.lax.optimization_barrier, value)
    return kept


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """sqrt(x) for x > 0 and 0 otherwise; the derivative is 0 where x <= 0."""
    x = jnp.asarray(x)
    positive, one, zero = x > 0, jax.lax.full_like(x, 1), jax.lax.full_like(x, 0)
    return jax.lax.select(positive, jax.lax.sqrt(jax.lax.select(positive, x, one)), zero)


def safe_divide(
    numerator: Float[Array, "..."], denominator: Float[Array, "..."], otherwise: float = 0.0
) -> Float[Array, "..."]:
    """numerator / denominator, and ``otherwise`` (with derivative 0) where the denominator is 0."""
    zero = denominator == 0
    return jnp.where(zero, otherwise, numerator / jnp.where(zero, 1, denominator))


def bounded_divide(
    numerator: Float[Array, "..."], denominator: Float[Array, "..."], otherwise: float = 0.0
) -> Float[Array, "..."]:
    """numerator / denominator, and ``otherwise`` (with derivative 0) where the denominator is too near 0 for the derivative.

    The derivative has the square of the denominator, which vanishes long before the denominator does.
    """
    near = jnp.abs(denominator) <= tiny(jnp.asarray(denominator).dtype)
    return jnp.where(near, otherwise, numerator / jnp.where(near, 1, denominator))


def safe_log(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """log(x), held at the log of the smallest safe number (derivative 0) below it."""
    floor = tiny(jnp.asarray(x).dtype)
    above = x > floor
    return jnp.where(above, jnp.log(jnp.where(above, x, 1)), np.log(floor))


def safe_arccos(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """arccos(x) clamped to [-1, 1]; the derivative is 0 at and beyond the ends."""
    inside = jnp.abs(x) < 1
    return jnp.where(inside, jnp.arccos(jnp.where(inside, x, 0)), jnp.where(x > 0, 0, jnp.pi))


def arcsinh(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """arcsinh(x) to an *absolute* rounding error, with one logarithm: XLA computes three, so that small ones are exact."""
    negative = x < 0
    # Not abs(x), whose derivative at 0 is 0.
    size = jnp.where(negative, -x, x)
    value = jnp.log(size + jnp.sqrt(size * size + 1))
    return jnp.where(negative, -value, value)


def safe_norm(x: Float[Array, "... n"]) -> Float[Array, "..."]:
    """Euclidean length over the last axis; the derivative is 0 at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))


_ERFCX = (
    -1.26551223, 1.00002368, 0.37409196, 0.09678418, -0.18628806,
    0.27886807, -1.13520398, 1.48851587, -0.82215223, 0.17087277,
)  # fmt: skip


ERFCX_OF_ZERO = math.exp(sum(_ERFCX))
"""What :func:`scaled_erfcx` is at 0: 1 but for its error."""


def scaled_erfcx(x: Float[Array, "..."], exponent: Float[Array, "..."]) -> Float[Array, "..."]:
    """exp(exponent) exp(x²) erfc(x) for x >= 0, to 1.2e-7, with a single exponential.

    The Chebyshev fit of Press et al., Numerical Recipes, section 6.2.
    """
    t = 2 / (2 + x)
    polynomial = jnp.zeros_like(t)
    for coefficient in reversed(_ERFCX):
        polynomial = polynomial * t + coefficient
    return t * jnp.exp(polynomial + exponent)


def _moved(
    function: Callable[..., Float[Array, "n ..."]], arrays: list[Any], tangents: list[Any]
) -> Float[Array, "n ..."] | None:
    """Tangent of ``function(*arrays)``; ``None`` where all ``tangents`` are known to be zero."""
    flat, structure = jax.tree.flatten(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
    if all(isinstance(t, SymbolicZero) for t in flat):
        return None
    dense = [jnp.zeros(t.shape, t.dtype) if isinstance(t, SymbolicZero) else t for t in flat]
    tangent: Float[Array, "n ..."] = jax.jvp(function, tuple(arrays), tuple(jax.tree.unflatten(structure, dense)))[1]
    return tangent


def _product(weights: Float[Array, "w n"], rows: Float[Array, "n ..."]) -> Float[Array, "w ..."]:
    return jnp.tensordot(weights, rows, axes=1, precision="highest")


def per_parameter(function: Callable[..., Float[Array, "n ..."]]) -> Callable[..., Float[Array, "n ..."]]:
    """``function(parameters, *arrays)``, whose derivatives by the ``parameters`` are computed once for all tangents.

    Row i of the value depends on parameter i only. A Jacobian in many parameters batches every operation over its
    tangents; here the batch is only the product of the slopes with the tangents of the parameters, and arrays whose
    tangents are known to be zero cost nothing. The product is one of matrices, because XLA would fuse a product of numbers
    with what computes the slopes, and so compute them anew for every tangent.
    """
    shared = jax.custom_jvp(function)

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        parameters, *arrays = primals
        towards, *moving = tangents
        value, slopes = jax.jvp(lambda p: function(p, *arrays), (parameters,), (jnp.ones_like(parameters),))
        tangent = jnp.zeros_like(value)
        if not isinstance(towards, SymbolicZero):
            tangent = _product(jnp.diag(towards), slopes)
        moved = _moved(lambda *a: function(parameters, *a), arrays, moving)
        return value, tangent if moved is None else tangent + moved

    shared.defjvp(rule, symbolic_zeros=True)
    return shared


def weighted(function: Callable[..., Float[Array, "n ..."]]) -> Callable[..., Float[Array, "w ..."]]:
    """``weights @ function(parameters, *arrays)``, called with the weights first, for a function as in :func:`per_parameter`.

    Its derivative by weights and parameters is one product of matrices, and the rows' own derivatives are never written out.
    """

    @jax.custom_jvp
    def combined(weights: Float[Array, "w n"], parameters: Float[Array, " n"], *arrays: Any) -> Float[Array, "w ..."]:
        return _product(weights, function(parameters, *arrays))

    def rule(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        weights, parameters, *arrays = primals
        heavier, towards, *moving = tangents
        rows, slopes = jax.jvp(lambda p: function(p, *arrays), (parameters,), (jnp.ones_like(parameters),))
        value = _product(weights, rows)
        terms = [(heavier, rows)] if not isinstance(heavier, SymbolicZero) else []
        if not isinstance(towards, SymbolicZero):
            terms.append((weights * towards, slopes))
        tangent = jnp.zeros_like(value)
        if terms:
            factors, parts = zip(*terms, strict=True)
            tangent = _product(jnp.concatenate(factors, axis=1), jnp.concatenate(parts))
        moved = _moved(lambda *a: function(parameters, *a), arrays, moving)
        return value, tangent if moved is None else tangent + _product(weights, moved)

    combined.defjvp(rule, symbolic_zeros=True)
    return combined


def gauss_legendre(count: int, lower: float = 0.0, upper: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the ``count``-point Gauss-Legendre rule on [lower, upper], as float64 NumPy arrays."""
    x, w = np.polynomial.legendre.leggauss(count)
    half = 0.5 * (upper - lower)
    return lower + half * (x + 1), half * w
