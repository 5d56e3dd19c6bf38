"""The guarded primitives: values where they are defined, finite derivatives everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from diffatmo import numerics


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(
    ("function", "points"),
    [
        (numerics.safe_sqrt, [-1.0, 0.0, 1e-30, 2.0]),
        (numerics.safe_log, [-1.0, 0.0, 1e-30, 2.0]),
        (numerics.safe_arccos, [-2.0, -1.0, 0.3, 1.0, 2.0]),
        (numerics.arcsinh, [-1e9, -1.0, 0.0, 1e-30, 1e9]),
        (lambda x: numerics.safe_divide(1 + x, x), [0.0, 2.0]),
        (lambda x: numerics.bounded_divide(1 + x, x), [0.0, 1e-30, -1e-30, 2.0]),
        (lambda x: numerics.safe_norm(jnp.stack([x, x])), [0.0, 1.0]),
    ],
)
def test_value_and_derivative_are_finite(x64, dtype, function, points):
    x = jnp.asarray(points, dtype)
    assert jnp.isfinite(jax.vmap(function)(x)).all()
    assert jnp.isfinite(jax.vmap(jax.grad(function))(x)).all()
    assert jnp.isfinite(jax.vmap(jax.jacfwd(function))(x)).all()


def test_values_agree_with_numpy_where_it_has_one():
    x = jnp.linspace(0.1, 0.9, 9)
    np.testing.assert_allclose(numerics.safe_sqrt(x), np.sqrt(x), rtol=1e-6)
    np.testing.assert_allclose(numerics.safe_log(x), np.log(x), rtol=1e-6)
    np.testing.assert_allclose(numerics.safe_arccos(x), np.arccos(x), rtol=1e-5)


def test_what_is_computed_once_is_what_it_was():
    """Value and derivatives, of each array by what it depends on only: the others have none."""
    function = lambda x: {"moving": jnp.sin(x), "still": jnp.cos(2.0 * jnp.ones(3)), "index": jnp.arange(3)}
    of = lambda keep, x: (keep(function(x))["moving"] * keep(function(x))["still"]).sum()
    x = jnp.linspace(0, 1, 3)
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        expected = jax.vmap(derivative(lambda x: of(lambda y: y, x)))(x[:, None])
        np.testing.assert_array_equal(jax.vmap(derivative(lambda x: of(numerics.once, x)))(x[:, None]), expected)
    tangents = jax.make_jaxpr(lambda x: jax.jvp(lambda x: numerics.once(function(x)), (x,), (x,)))(x)
    assert sum(eqn.primitive.name == "optimization_barrier" for eqn in tangents.eqns) == 4


@pytest.mark.parametrize(("dtype", "bound"), [(np.float32, 6e-7), (np.float64, 1e-14)])
def test_arcsinh_is_numpys_and_so_is_its_slope(x64, dtype, bound):
    """To three roundings of values up to 3; 0 is a point like any other."""
    x = jnp.asarray(np.append(np.linspace(-10, 10, 400), 0), dtype)
    np.testing.assert_allclose(numerics.arcsinh(x), np.arcsinh(np.asarray(x, float)), rtol=0, atol=bound)
    slope = jax.vmap(jax.grad(numerics.arcsinh))(x)
    np.testing.assert_allclose(slope, 1 / np.hypot(np.asarray(x, float), 1), rtol=0, atol=bound)


def test_scaled_erfcx_agrees_with_scipy(x64):
    """1.2e-7 is the stated accuracy of the fit."""
    x = jnp.linspace(0, 120, 500)
    np.testing.assert_allclose(numerics.scaled_erfcx(x, jnp.zeros_like(x)), special.erfcx(np.asarray(x)), rtol=2e-7)
    np.testing.assert_allclose(
        numerics.scaled_erfcx(x, x * 0 - 2), np.exp(-2) * special.erfcx(np.asarray(x)), rtol=2e-7
    )


def test_gauss_legendre_is_exact_to_degree_2n_minus_1():
    x, w = numerics.gauss_legendre(4, 1.0, 3.0)
    for degree in range(8):
        assert w @ x**degree == pytest.approx((3.0 ** (degree + 1) - 1) / (degree + 1), rel=1e-13)
    assert w @ x**8 != pytest.approx((3.0**9 - 1) / 9, rel=1e-7)


def test_slopes_shared_by_tangents_are_the_derivatives(x64):
    """Forward, reverse and batched; by the parameters, by an array, and by neither."""

    def plain(parameters, x):
        return jnp.exp(-x[None] / parameters[:, None]) * x

    shared = numerics.per_parameter(plain)
    parameters, x = jnp.array([1.5, 3.0]), jnp.linspace(0.2, 2.0, 5)
    np.testing.assert_allclose(shared(parameters, x), plain(parameters, x))
    for number in (0, 1):
        want = jax.jacfwd(plain, number)(parameters, x)
        np.testing.assert_allclose(jax.jacfwd(shared, number)(parameters, x), want, rtol=1e-12)
        np.testing.assert_allclose(jax.jacrev(shared, number)(parameters, x), want, rtol=1e-12)
    both = lambda f: jax.hessian(lambda p: f(p, x * p[0]).sum())(parameters)
    np.testing.assert_allclose(both(shared), both(plain), rtol=1e-10)
    assert float(jnp.abs(jax.grad(lambda c: c * shared(parameters, x).sum())(1.0))) > 0


def test_the_derivative_of_weighted_rows_is_that_of_the_product(x64):
    """By weights, parameters, an array, all of them and none; forward, reverse and twice."""

    def rows(parameters, x):
        return jnp.exp(-x[None] / parameters[:, None]) * x

    combined, plain = numerics.weighted(rows), lambda weights, *rest: weights @ rows(*rest)
    at = jnp.array([[0.3, 1.0], [2.0, -0.4], [0.0, 0.7]]), jnp.array([1.5, 3.0]), jnp.linspace(0.2, 2.0, 5)
    np.testing.assert_allclose(combined(*at), plain(*at))
    for numbers in (0, 2, (0, 1, 2)):
        want = jax.tree.leaves(jax.jit(jax.jacfwd(plain, numbers))(*at))
        for derivative in (jax.jacfwd, jax.jacrev):
            for one, other in zip(jax.tree.leaves(jax.jit(derivative(combined, numbers))(*at)), want, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14)
    bent = lambda f: jax.jit(jax.hessian(lambda p: f(at[0] * p[0], p, at[2] * p[1]).sum()))(at[1])
    np.testing.assert_allclose(bent(combined), bent(plain), rtol=1e-10)
    assert float(jax.grad(lambda c: c * combined(*at).sum())(1.0)) == pytest.approx(float(plain(*at).sum()))
