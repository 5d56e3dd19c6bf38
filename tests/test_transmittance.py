"""Columns and transmittance against brute-force sums, closed forms and each other."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import geometry, rays, transmittance
from diffatmo.atmosphere import earth

# Compiled as a whole: one operation after another, each is a program of its own.
to_top, to_sun = jax.jit(transmittance.to_top), jax.jit(transmittance.to_sun)
trace, columns_along = (jax.jit(f, static_argnums=n) for f, n in ((rays.trace, 5), (transmittance.columns_along, 4)))
densities = jax.jit(lambda a, h: [jnp.mean(f(h)) for f in (a.rayleigh_density, a.mie_density, a.ozone_density)])


def planet(radius, thickness):
    where = lambda a: (a.bottom_radius, a.top_radius)
    return eqx.tree_at(where, earth(), (jnp.asarray(radius), jnp.asarray(radius + thickness)))


def brute(atmosphere, h, mu, length, steps=40000):
    """Midpoint sum in double precision: error below 1e-6 of the column."""
    d = (np.arange(steps) + 0.5) / steps * length
    r = float(atmosphere.bottom_radius) + h
    altitude = np.sqrt(r * r + 2 * r * mu * d + d * d) - float(atmosphere.bottom_radius)
    return length * np.array(densities(atmosphere, altitude))


def of_constituents(atmosphere, columns):
    """Columns of air, aerosol and absorber, km."""
    _, factors = transmittance.edges(atmosphere)
    return np.concatenate([columns.exponential, np.tensordot(factors, columns.ramps, axes=1)[None]])


@pytest.mark.parametrize(("radius", "thickness"), [(6360.0, 100.0), (1000.0, 60.0)])
@pytest.mark.parametrize(
    ("h", "mu"),
    [(0.0, 1.0), (0.0, 0.0), (0.5, 0.01), (3.0, 0.2), (30.0, -0.05), (30.0, 0.0), (45.0, -0.1), (59.0, 0.5)],
)
def test_columns_to_the_top(x64, radius, thickness, h, mu):
    """Chapman's function is good to (H/R)², 2e-6 on Earth and 6e-5 on the small planet."""
    atmosphere = planet(radius, thickness)
    at = np.asarray(h), np.asarray(mu)
    columns, free = to_top(atmosphere, *at)
    assert bool(free)
    length = float(geometry.distance_up(*at, atmosphere.top_altitude, atmosphere.bottom_radius))
    want = brute(atmosphere, h, mu, length)
    np.testing.assert_allclose(
        of_constituents(atmosphere, columns), want, rtol=2e-4 if radius < 2000 else 1e-5, atol=1e-4
    )
    # The same by quadrature along the ray, which knows nothing of Chapman's function. On the small planet the map's
    # stretch, 9 km, is hardly above the scale height and the integrand no polynomial any more.
    nodes = trace(*at, np.asarray(False), atmosphere.bottom_radius, atmosphere.top_altitude, 12)
    np.testing.assert_allclose(
        of_constituents(atmosphere, columns_along(atmosphere, *at, nodes, 12)[1]),
        want,
        rtol=1e-4,
        atol=1e-5,
    )


def test_columns_along_a_ray_to_the_ground(x64):
    atmosphere = earth()
    at = np.asarray(12.0), np.asarray(-0.3)
    nodes = trace(*at, np.asarray(True), atmosphere.bottom_radius, atmosphere.top_altitude, 12)
    here, end = columns_along(atmosphere, *at, nodes, 12)
    length = float(geometry.distance_down(*at, jnp.zeros(()), atmosphere.bottom_radius))
    assert float(np.sum(nodes.weight)) == pytest.approx(length, rel=1e-9)
    np.testing.assert_allclose(
        of_constituents(atmosphere, end), brute(atmosphere, 12.0, -0.3, length), rtol=1e-5, atol=1e-6
    )
    middle = 9
    want = brute(atmosphere, 12.0, -0.3, float(nodes.distance[middle]))
    np.testing.assert_allclose(of_constituents(atmosphere, here)[:, middle], want, rtol=1e-4, atol=1e-4)


def test_float32_agrees_with_float64():
    h, mu = np.meshgrid([0.0, 0.001, 1.0, 20.0], [0.0, 0.001, 0.1, 1.0])
    single = to_sun(earth(), h.astype(np.float32), mu.astype(np.float32))
    with jax.enable_x64(True):
        double = to_sun(earth(), h, mu)
    np.testing.assert_allclose(single, double, atol=5e-6)


def test_there_is_no_sun_in_the_shadow():
    h = np.array([0.0, 1.0, 10.0], np.float32)
    horizon = np.asarray(geometry.horizon_mu(h, earth().bottom_radius))
    assert to_sun(earth(), h, horizon - 1e-4).max() == 0
    assert to_sun(earth(), h, horizon + 1e-4)[2:].min() > 0


def test_shadow_crossing_lies_on_the_edge(x64):
    """At the crossing the sun stands on the local horizon: mu_s there is horizon_mu there."""
    radius = 6360.0
    h, mu, mu_s, nu = (jnp.asarray(x) for x in (0.5, 0.3, -0.05, 0.2))
    _, leaves = rays.shadow_crossings(h, mu, mu_s, nu, radius)
    there = geometry.altitude_along(h, mu, leaves, radius)
    mu_s_there = geometry.mu_s_along(h, mu_s, nu, leaves, there, radius)
    assert float(leaves) > 0
    assert float(mu_s_there) == pytest.approx(float(geometry.horizon_mu(there, radius)), abs=1e-9)
    # High sun: no shadow anywhere on the ray.
    assert float(max(rays.shadow_crossings(h, mu, jnp.asarray(0.9), nu, radius))) < 0


survives = jax.jit(lambda x: jnp.sum(transmittance.to_sun(earth(), x[0], x[1])))
slope = jax.jit(jax.grad(survives))


@pytest.mark.parametrize("mu", [-1.0, -0.02, 0.0, 0.02, 1.0])
@pytest.mark.parametrize("h", [0.0, 0.1, 100.0])
def test_derivatives_are_finite_and_right(x64, h, mu):
    """Ordinary points agree with central differences to 1e-5; special ones are finite."""
    x = np.array([h, mu])
    exact = slope(x)
    assert np.isfinite(exact).all()
    if h == 0.1 and mu == 0.02:
        numeric = [(survives(x + step) - survives(x - step)) / 2e-5 for step in 1e-5 * np.eye(2)]
        np.testing.assert_allclose(exact, numeric, rtol=1e-5)


def test_derivatives_at_the_top_along_a_ray_that_is_horizontal_but_for_rounding():
    """Nothing is left to cross, and the square of the cosine is less than the least number."""

    def columns(altitude, mu):
        return transmittance.to_top(earth(), altitude, mu)[0]

    at = np.float32(100.0), np.float32(1e-25)
    np.testing.assert_allclose(jax.jit(columns)(*at).exponential, 0, atol=1e-4)
    for derivative in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(derivative(columns, argnums=(0, 1)))(*at)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))
