"""χ² of every sampler of the path tracer against the density that its weights divide by."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from diffatmo import geometry, phase
from diffatmo.atmosphere import earth
from diffatmo.models.pathtrace import columns, guide, paths
from diffatmo.numerics import gauss_legendre
from diffatmo.phase import PhaseTable

COUNT = 200_000
LEAST = 1e-4
"""p-value under which a sampler is wrong: with the fixed seeds here a right one does not fall below it."""

TABLE = PhaseTable([0, 3, 20, 90, 140, 180], [50, 20, 2, 0.2, 0.0, 0.5])


def uniform(seed, columns=1):
    return [jnp.asarray(u, jnp.float32) for u in np.random.default_rng(seed).random((columns, COUNT))]


def p_value(counts, expected):
    keep = expected > 10
    counts, expected = (np.append(a[keep], a[~keep].sum()) for a in (counts, expected))
    full = expected > 1e-9
    return stats.chisquare(counts[full], expected[full] * counts.sum() / expected[full].sum()).pvalue


def of_aerosol(g, name):
    """Sampler and density of an aerosol."""
    g = jnp.asarray(g)
    return lambda u: phase.sample_mie(u, g, name), lambda nu: phase.sampled_density(nu, g, name)


SAMPLERS = {
    "rayleigh": (phase.sample_rayleigh, phase.rayleigh),
    "henyey-greenstein backward": of_aerosol(-0.6, "henyey-greenstein"),
    "henyey-greenstein even": of_aerosol(0.0, "henyey-greenstein"),
    "henyey-greenstein forward": of_aerosol(0.9, "henyey-greenstein"),
    "cornette-shanks": of_aerosol(0.8, "cornette-shanks"),
    "table": of_aerosol(0.0, TABLE),
    "lambert": (jnp.sqrt, lambda nu: jnp.maximum(nu, 0) / jnp.pi),
}


@pytest.mark.parametrize(("sample", "density"), SAMPLERS.values(), ids=SAMPLERS)
def test_cosines(sample, density):
    """60 bins, equidistant in the angle so that peaks are resolved; Gauss's rule in each."""
    nu = np.asarray(sample(*uniform(1)))
    edges = np.cos(np.linspace(np.pi, 0, 61))
    t, w = gauss_legendre(40)
    x = edges[:-1, None] + np.diff(edges)[:, None] * t
    expected = 2 * np.pi * np.sum(np.asarray(density(jnp.asarray(x, jnp.float32))) * w, axis=1) * np.diff(edges)
    assert np.sum(expected) == pytest.approx(1, abs=2e-3)
    assert p_value(np.histogram(nu, edges)[0], COUNT * expected) > LEAST


def test_the_wrong_density_is_noticed():
    nu = np.asarray(phase.sample_henyey_greenstein(*uniform(1), jnp.asarray(0.80)))
    edges = np.cos(np.linspace(np.pi, 0, 61))
    t, w = gauss_legendre(40)
    x = edges[:-1, None] + np.diff(edges)[:, None] * t
    wrong = np.asarray(phase.henyey_greenstein(jnp.asarray(x), jnp.asarray(0.79)))
    expected = 2 * np.pi * np.sum(wrong * w, axis=1) * np.diff(edges)
    assert p_value(np.histogram(nu, edges)[0], COUNT * expected) < LEAST


@pytest.mark.parametrize(("altitude", "mu_s"), [(0.5, 0.3), (15.0, -0.05)])
def test_directions_of_the_guide(altitude, mu_s):
    """Bins of mu (24) and azimuth (12) that are not the table's own; the density is summed on a grid 40 times as fine."""
    air = earth()
    tables = guide.build(air)
    at = jnp.full(COUNT, altitude)
    node = guide.cell(at, jnp.full(COUNT, mu_s), air.top_altitude)
    horizon = geometry.horizon_mu(at, air.bottom_radius)
    mu, azimuth = guide.sample_direction(tables, node, horizon, *uniform(2, 2))
    edges = np.linspace(-1, 1, 25), np.linspace(0, np.pi, 13)
    counts = np.histogram2d(np.asarray(mu), np.abs(np.asarray(azimuth)), edges)[0]
    fine = [0.5 * (e[1:] + e[:-1]) for e in (np.linspace(-1, 1, 24 * 40 + 1), np.linspace(0, np.pi, 12 * 40 + 1))]
    m, a = (jnp.asarray(x.ravel(), jnp.float32) for x in np.meshgrid(*fine, indexing="ij"))
    density = guide.direction_density(tables, jnp.full(m.shape, node[0]), jnp.full(m.shape, horizon[0]), m, jnp.cos(a))
    shares = np.asarray(density, float).reshape(24, 40, 12, 40).sum(axis=(1, 3)) * 2 * (2 / 960) * (np.pi / 480)
    assert shares.sum() == pytest.approx(1, abs=0.01)
    # The grid blurs the edges of the table's bins by 1/40 of a bin: half a percent of a share, below the noise of the counts.
    assert p_value(counts.ravel(), COUNT * shares.ravel()) > LEAST


@pytest.mark.parametrize("mu", [0.4, -0.3])
def test_places_along_a_ray(mu):
    """Σ 1/density over the samples in a bin of distance is the bin's length; the ground's share is its probability."""
    air = earth()
    tables = guide.build(air)
    lanes = jnp.ones(COUNT)
    altitude, direction, mu_s = 2.0 * lanes, mu * lanes, 0.3 * lanes
    hits = geometry.hits_ground(altitude, direction, air.bottom_radius)
    ray = columns.segment(air, altitude, direction, hits)
    light = guide.expected(
        air, tables, ray, mu_s, 0.1 * lanes, jnp.ones((3, COUNT)), end=ray.length, sees_ground=hits,
        jitter=0.5 * lanes, panels=10,
    )  # fmt: skip
    place, _ = paths._draw_place(air, ray, light, uniform(3)[0])
    on_ground = np.asarray(place.on_ground)
    distance, density = np.asarray(place.distance, float), np.asarray(place.density, float)
    if mu < 0:
        chance = density[on_ground][0]
        assert abs(on_ground.mean() - chance) < 4 * np.sqrt(chance * (1 - chance) / COUNT)
    else:
        assert not on_ground.any()
    # Bins of equal numbers of samples.
    inside = np.sort(distance[~on_ground])
    edges = np.concatenate([[0.0], inside[:: inside.size // 20][1:-1], [float(ray.length[0])]])
    found = np.digitize(distance, edges) - 1
    for k in range(edges.size - 1):
        inverse = np.where((found == k) & ~on_ground, 1 / density, 0)
        z = (inverse.mean() - (edges[k + 1] - edges[k])) / (inverse.std() / np.sqrt(COUNT))
        assert abs(z) < 4.5
