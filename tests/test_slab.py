"""The path tracer in a plane-parallel slab, where transfer has closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import phase
from diffatmo.models.pathtrace import PathTrace, slab
from diffatmo.numerics import gauss_legendre

MU, MU_S, AZIMUTH = (a.ravel() for a in np.meshgrid([0.2, 0.5, 0.9], [0.3, 0.8], [0.0, 2.0], indexing="ij"))
"""Cosines of the angles of view and sun from the vertical, and the azimuth between the two."""


def unit(mu, azimuth):
    sine = np.sqrt(1 - mu**2)
    return jnp.asarray(np.stack([sine * np.sin(azimuth), sine * np.cos(azimuth), mu], -1), jnp.result_type(float))


def traced(air, *, mu, mu_s, azimuth, altitude, samples=4096, panels=10):
    """Orders of the light seen at ``altitude`` (0 or 1) in the direction mu."""
    sky = PathTrace(samples=samples, panels=panels).sky(air)
    return sky.orders(altitude=jnp.asarray(altitude), view=unit(mu, azimuth), sun=unit(mu_s, 0 * mu_s))


def total(orders):
    return np.asarray(sum(part.radiance for part in orders))


def spread(orders):
    """At most the standard error of the sum."""
    return np.asarray(sum(part.stderr for part in orders))


def scattered_once(tau, albedo, weights, mu, mu_s, azimuth, down):
    """Chandrasekhar 1950: light scattered once, seen from below (``mu`` > 0 there) or from above."""
    sines = np.sqrt(1 - mu**2) * np.sqrt(1 - mu_s**2) * np.cos(azimuth)
    nu = jnp.asarray((-mu if down else mu) * mu_s + sines)
    phases = np.asarray(weights[0] * phase.rayleigh(nu) + weights[1] * phase.henyey_greenstein(nu, jnp.asarray(0.7)))
    if down:
        share = mu_s / (mu + mu_s) * (1 - np.exp(-tau * (1 / mu + 1 / mu_s)))
    else:
        share = mu_s / (mu - mu_s) * (np.exp(-tau / mu) - np.exp(-tau / mu_s))
    return albedo * phases * share


def test_light_scattered_once_and_the_ground_seen_directly():
    """Air of optical depth 0.3 and aerosol of 0.5 that absorbs a fifth, from above and from below, to 4 standard errors."""
    air, aerosol, absorbed, ground = 0.3, 0.5, 0.2, 0.4
    matter = slab(
        rayleigh_optical_depth=[air],
        mie_optical_depth=[aerosol],
        mie_albedo=1 - absorbed,
        mie_g=0.7,
        ground_albedo=ground,
    )
    tau = air + aerosol
    bright = aerosol * (1 - absorbed)
    albedo = (air + bright) / tau
    weights = air / (air + bright), bright / (air + bright)
    for down, altitude in ((True, 1.0), (False, 0.0)):
        got = traced(matter, mu=-MU if down else MU, mu_s=MU_S, azimuth=AZIMUTH, altitude=altitude)
        expected = scattered_once(tau, albedo, weights, MU, MU_S, AZIMUTH, down)
        off = np.asarray(got.single.radiance)[:, 0] - expected
        # The sampling follows single scattering so closely that its error is near that of float32's cosines.
        assert np.all(np.abs(off) < 4 * np.asarray(got.single.stderr)[:, 0] + 3e-4 * expected)
        seen = ground / np.pi * MU_S * np.exp(-tau * (1 / MU + 1 / MU_S)) if down else 0 * MU
        np.testing.assert_allclose(
            np.asarray(got.ground.radiance)[:, 0], seen, atol=1e-9 + 4 * np.asarray(got.ground.stderr).max(), rtol=1e-3
        )
    assert np.all(np.asarray(got.second.radiance) > 0)


def h_function(albedo, mu, nodes=64):
    """Chandrasekhar's H for isotropic scattering: the fixed point of 1/H = √(1-ω) + ω/2 ∫ x H(x) / (mu + x) dx."""
    x, w = gauss_legendre(nodes)
    h = np.ones(nodes)

    def inverse(at):
        return np.sqrt(1 - albedo) + albedo / 2 * np.sum(w * x * h / (at[:, None] + x), axis=1)

    for _ in range(200):
        h = 1 / inverse(x)
    return 1 / inverse(mu)


def test_bottomless_isotropic_slab_has_chandrasekhars_reflection():
    """ω/4 μ_s/(μ + μ_s) H(μ) H(μ_s) F/π, at optical depth 12: what comes back from below that is some 1e-5.

    Half an optical depth to a panel, as the samples follow the panels.
    """
    albedo = 0.9
    matter = slab(rayleigh_optical_depth=[0.0], mie_optical_depth=[12.0], mie_albedo=albedo)
    got = traced(matter, mu=-MU, mu_s=MU_S, azimuth=AZIMUTH, altitude=1.0, panels=24)
    expected = albedo / (4 * np.pi) * MU_S / (MU + MU_S) * h_function(albedo, MU) * h_function(albedo, MU_S)
    assert np.all(np.abs(total(got)[:, 0] - expected) < 4 * spread(got)[:, 0])
    assert np.mean(total(got)[:, 0] / expected) == pytest.approx(1, abs=0.01)


def test_view_and_sun_change_places():
    """Reciprocity: L(view, sun) / μ_s is the same with the two exchanged, also over a ground."""
    matter = slab(rayleigh_optical_depth=[0.4], mie_optical_depth=[1.0], mie_albedo=0.9, mie_g=0.7, ground_albedo=0.5)
    one = traced(matter, mu=-MU, mu_s=MU_S, azimuth=AZIMUTH, altitude=1.0)
    # Seen from above the view points down: the ray back towards the camera is its opposite, at azimuth + π for both.
    other = traced(matter, mu=-MU_S, mu_s=MU, azimuth=AZIMUTH, altitude=1.0)
    a, b = total(one)[:, 0] / MU_S, total(other)[:, 0] / MU
    assert np.all(np.abs(a - b) < 4 * np.hypot(spread(one)[:, 0] / MU_S, spread(other)[:, 0] / MU))


@pytest.mark.slow
def test_what_falls_in_comes_out():
    """A conservative slab over a white ground sends back all that falls on it.

    Gauss-Legendre over mu and midpoints in azimuth integrate the reflected radiance to some 1e-4. With 65536 samples and eight
    azimuths the light sent back was 1.00001 ± 0.0003; here it is known to 0.1 %.
    """
    mu_s = 0.6
    matter = slab(rayleigh_optical_depth=[0.5], mie_optical_depth=[0.5], mie_albedo=1.0, mie_g=0.5, ground_albedo=1.0)
    mu, weight = gauss_legendre(8)
    azimuths = (np.arange(4) + 0.5) * np.pi / 4
    m, a = (x.ravel() for x in np.meshgrid(mu, azimuths, indexing="ij"))
    got = traced(matter, mu=-m, mu_s=np.full_like(m, mu_s), azimuth=a, altitude=1.0, samples=16384)
    shares = 2 * np.pi * np.repeat(weight * mu, azimuths.size) / azimuths.size
    flux = np.sum(shares * total(got)[:, 0])
    error = np.sqrt(np.sum((shares * spread(got)[:, 0]) ** 2))
    assert error / mu_s < 1.5e-3
    assert flux / mu_s == pytest.approx(1, abs=2e-3)
