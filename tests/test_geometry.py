"""Geometry of the shell, against double precision done the naive way and against identities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import geometry

RADII = [6360.0, 1000.0, 3389.5]


def everything(x):
    h, mu = x
    ground = geometry.hits_ground(h, mu, 6360.0)
    d = geometry.distance_to_boundary(h, mu, ground, 6360.0, 100.0)
    there = geometry.altitude_along(h, mu, d, 6360.0)
    return jnp.stack([
        d, geometry.altitude_along(h, mu, 0.5 * d, 6360.0), geometry.mu_along(h, mu, d, there, 6360.0),
        geometry.perigee_altitude(h, mu, 6360.0), geometry.horizon_mu(h, 6360.0), geometry.sine(mu),
    ])  # fmt: skip


# Compiled as a whole: one operation after another, each is a program of its own.
value_and_slopes = jax.jit(lambda x: (everything(x), jax.jacfwd(everything)(x), jax.jacrev(everything)(x)))


def naive_distance_up(h, mu, target, radius):
    """In extended precision the textbook formula is accurate."""
    h, mu, target, radius = (np.longdouble(x) for x in (h, mu, target, radius))
    r = radius + h
    return -r * mu + np.sqrt(r * r * (mu * mu - 1) + (radius + target) ** 2)


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("h", [0.0, 0.001, 0.002, 0.5, 30.0])
@pytest.mark.parametrize("mu", [0.0, 1e-3, 0.1, 1.0])
def test_distance_up_in_float32(radius, h, mu):
    got = geometry.distance_up(jnp.float32(h), jnp.float32(mu), jnp.float32(60.0), jnp.float32(radius))
    want = naive_distance_up(np.float32(h), np.float32(mu), np.float32(60.0), np.float32(radius))
    assert float(got) == pytest.approx(float(want), rel=2e-6)


@pytest.mark.parametrize("h", [1e-3, 2e-3, 0.1, 10.0])
def test_horizon_in_float32(h):
    """The naive sqrt(r² - R²) is off by percents at one metre; this is good to rounding."""
    want = -np.sqrt(np.longdouble(h) * (np.longdouble(h) + 2 * 6360)) / (6360 + np.longdouble(h))
    assert float(geometry.horizon_mu(jnp.float32(h), jnp.float32(6360))) == pytest.approx(float(want), rel=1e-6)
    naive = np.sqrt(np.float32(6360 + np.float32(h)) ** 2 - np.float32(6360) ** 2) / np.float32(6360 + h)
    if h < 2e-3:
        assert abs(float(naive) / -float(want) - 1) > 1e-3


@pytest.mark.parametrize("radius", RADII)
def test_along_a_ray_is_consistent(x64, radius):
    """Walk a distance, then walk back: same altitude, opposite mu; nu is conserved by construction of mu_s."""
    h, mu, mu_s, nu, d = 12.0, -0.03, 0.2, 0.5, 150.0
    h2 = geometry.altitude_along(h, mu, d, radius)
    mu2 = geometry.mu_along(h, mu, d, h2, radius)
    mu_s2 = geometry.mu_s_along(h, mu_s, nu, d, h2, radius)
    assert float(geometry.altitude_along(h2, -mu2, d, radius)) == pytest.approx(h, abs=1e-9)
    assert float(geometry.mu_along(h2, -mu2, d, h, radius)) == pytest.approx(-mu, abs=1e-12)
    assert float(geometry.mu_s_along(h2, mu_s2, -nu, d, h, radius)) == pytest.approx(mu_s, abs=1e-12)
    # The perigee is a property of the line, not of the point on it.
    p = float(geometry.perigee_altitude(h, mu, radius))
    assert float(geometry.perigee_altitude(h2, mu2, radius)) == pytest.approx(p, abs=1e-9)


@pytest.mark.parametrize("radius", RADII)
def test_down_meets_the_ground_it_aims_at(x64, radius):
    h, mu = 5.0, -0.2
    d = geometry.distance_down(h, mu, jnp.zeros(()), radius)
    assert float(geometry.altitude_along(h, mu, d, radius)) == pytest.approx(0, abs=1e-9)
    assert geometry.hits_ground(jnp.asarray(h), jnp.asarray(mu), radius)
    horizon = geometry.horizon_mu(jnp.asarray(h), radius)
    assert not geometry.hits_ground(jnp.asarray(h), horizon + 1e-9, radius)
    assert geometry.hits_ground(jnp.asarray(h), horizon - 1e-9, radius)
    assert float(geometry.perigee_altitude(h, horizon, radius)) == pytest.approx(0, abs=1e-9)


def test_a_ray_from_space_enters_at_the_top(x64):
    h, top, radius = 400.0, 100.0, 6360.0
    down = geometry.enter_atmosphere(*(jnp.asarray(x) for x in (h, -1.0, 0.3, -0.3)), radius, top)
    assert down[0] == top
    assert float(down[3]) == pytest.approx(300.0)
    assert not down[4]
    assert geometry.enter_atmosphere(*(jnp.asarray(x) for x in (h, 0.1, 0.3, 0.5)), radius, top)[4]
    limb = geometry.horizon_mu(jnp.asarray(h - top), radius + top)
    assert geometry.enter_atmosphere(jnp.asarray(h), limb + 1e-9, *(jnp.zeros(()),) * 2, radius, top)[4]
    assert not geometry.enter_atmosphere(jnp.asarray(h), limb - 1e-9, *(jnp.zeros(()),) * 2, radius, top)[4]


@pytest.mark.parametrize("mu_s", [-1.0, 1.0])
def test_cosines_are_cosines_after_a_long_way(mu_s):
    """From ten thousand radii away float32 rounds the cosines at the top of a small planet by a percent: not beyond 1."""
    entered = geometry.enter_atmosphere(
        *map(jnp.float32, (1e5, -1.0, mu_s, -mu_s)), jnp.float32(10.0), jnp.float32(100.0)
    )
    assert entered[1] == -1
    assert abs(entered[2]) <= 1


@pytest.mark.parametrize("mu", [-1.0, -0.5, 0.0, 0.5, 1.0])
@pytest.mark.parametrize("h", [0.0, 1.0, 100.0])
def test_derivatives_are_finite(x64, h, mu):
    assert all(np.isfinite(part).all() for part in value_and_slopes(np.array([h, mu])))


@pytest.mark.parametrize("mu", [1e-25, -1e-25])
@pytest.mark.parametrize("function", [geometry.distance_up, geometry.distance_down])
def test_derivatives_along_a_ray_that_is_horizontal_but_for_rounding(function, mu):
    """From the target itself: the cosine is there, its square is not."""
    at = jnp.float32(100.0), jnp.float32(mu), jnp.float32(100.0), jnp.float32(6360.0)
    assert float(function(*at)) == pytest.approx(0, abs=1e-15)
    for derivative in (jax.grad, jax.jacfwd):
        assert all(np.isfinite(slope) for slope in jax.jit(derivative(function, argnums=(0, 1, 2, 3)))(*at))
