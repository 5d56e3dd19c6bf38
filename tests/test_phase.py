"""Phase functions: normalisation, moments, limits, samplers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import phase
from diffatmo.numerics import gauss_legendre

G = [-0.9, -0.3, 0.0, 0.3, 0.8, 0.95]


@pytest.mark.parametrize("name", phase.MIE_PHASES)
@pytest.mark.parametrize("g", G)
def test_moments_agree_with_quadrature(x64, name, g):
    """χ_0 = 1 is the normalisation. 400 Gauss nodes integrate the peak at |g| = 0.95 to 1e-9."""
    nu, weight = gauss_legendre(400, -1.0, 1.0)
    value = np.asarray(phase.mie(jnp.asarray(nu), jnp.asarray(g), name))
    brute = 2 * np.pi * (weight * value) @ np.asarray(phase.legendre(8, jnp.asarray(nu)))
    np.testing.assert_allclose(phase.mie_moments(jnp.asarray(g), 8, name), brute, atol=1e-9)
    assert brute[0] == pytest.approx(1, abs=1e-9)


def test_rayleigh_has_degree_two(x64):
    nu, weight = gauss_legendre(8, -1.0, 1.0)
    brute = 2 * np.pi * (weight * np.asarray(phase.rayleigh(jnp.asarray(nu)))) @ phase.legendre(6, jnp.asarray(nu))
    np.testing.assert_allclose(brute, phase.rayleigh_moments(6), atol=1e-14)


def test_forward_is_plus_one_and_g_positive():
    assert phase.henyey_greenstein(jnp.asarray(1.0), jnp.asarray(0.8)) > phase.henyey_greenstein(
        jnp.asarray(-1.0), jnp.asarray(0.8)
    )


def test_cornette_shanks_is_rayleigh_at_g_zero():
    nu = jnp.linspace(-1, 1, 9)
    np.testing.assert_allclose(phase.cornette_shanks(nu, jnp.asarray(0.0)), phase.rayleigh(nu), rtol=1e-6)


def mie_and_slopes(name, x):
    f = lambda x: phase.mie(x[0], x[1], name)
    return f(x), jax.grad(f)(x), jax.jacfwd(lambda g: phase.mie_moments(g, 6, name))(x[1])


MIE_AND_SLOPES = {name: jax.jit(functools.partial(mie_and_slopes, name)) for name in phase.MIE_PHASES}


@pytest.mark.parametrize("name", phase.MIE_PHASES)
@pytest.mark.parametrize("nu", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("g", [-0.9, 0.0, 0.9])
def test_derivative_in_g_and_nu(x64, name, nu, g):
    """Central differences of step 1e-6 are good to about 1e-9 of the peak value."""
    x = np.array([nu, g])
    _, exact, moments = MIE_AND_SLOPES[name](x)
    numeric = [
        (MIE_AND_SLOPES[name](x + step)[0] - MIE_AND_SLOPES[name](x - step)[0]) / 2e-6 for step in 1e-6 * np.eye(2)
    ]
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8)
    assert np.isfinite(moments).all()


@pytest.mark.parametrize("g", G)
def test_henyey_greenstein_sampler_inverts_its_distribution(x64, g):
    """The distribution function of the sampled cosine at quantile u is u."""
    u = jnp.array([0.01, 0.3, 0.5, 0.9, 0.999])
    for quantile, nu in zip(u, phase.sample_henyey_greenstein(u, jnp.asarray(g)), strict=True):
        x, w = gauss_legendre(400, -1.0, float(nu))
        below = 2 * np.pi * w @ np.asarray(phase.henyey_greenstein(jnp.asarray(x), jnp.asarray(g)))
        assert below == pytest.approx(float(quantile), abs=1e-9)


def test_rayleigh_sampler_inverts_its_distribution(x64):
    u = jnp.array([0.001, 0.2, 0.5, 0.8, 0.999])
    nu = phase.sample_rayleigh(u)
    below = 3 / 8 * (nu + nu**3 / 3) + 0.5
    # Backward half of the symmetric function first or last: either way the quantiles are these.
    np.testing.assert_allclose(jnp.sort(below), u, atol=1e-12)
