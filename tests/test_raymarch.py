"""Single scattering as the tutorials march it, against their program written out, and against the exact integral."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo.atmosphere import Atmosphere, earth
from diffatmo.models.raymarch import RayMarch

BETA_R, BETA_M, H_R, H_M, G = (5.19673e-6, 12.1427e-6, 29.6453e-6), 21e-6, 8000.0, 1200.0, 0.76
GROUND, TOP = 6360e3, 6420e3


def tutorial(view, sun, *, steps=64, light_steps=4, altitude=1.0):
    """A sky tutorial's loop, in metres: aerosol extinction is 1.1 times its scattering."""

    def end(origin, direction):
        b = origin @ direction
        return -b + math.sqrt(b * b - origin @ origin + TOP**2)

    origin = np.array([0.0, 0.0, GROUND + altitude])
    ds = end(origin, view) / steps
    total_r, total_m, depth_r, depth_m = np.zeros(3), np.zeros(3), 0.0, 0.0
    for i in range(steps):
        point = origin + view * (i + 0.5) * ds
        height = np.linalg.norm(point) - GROUND
        here_r, here_m = math.exp(-height / H_R) * ds, math.exp(-height / H_M) * ds
        depth_r, depth_m = depth_r + here_r, depth_m + here_m
        dl = end(point, sun) / light_steps
        light_r = light_m = 0.0
        for j in range(light_steps):
            above = np.linalg.norm(point + sun * (j + 0.5) * dl) - GROUND
            if above < 0:
                break
            light_r, light_m = light_r + math.exp(-above / H_R) * dl, light_m + math.exp(-above / H_M) * dl
        else:
            tau = np.array(BETA_R) * (depth_r + light_r) + 1.1 * BETA_M * (depth_m + light_m)
            total_r, total_m = total_r + np.exp(-tau) * here_r, total_m + np.exp(-tau) * here_m
    nu = view @ sun
    rayleigh = 3 / (16 * math.pi) * (1 + nu * nu)
    peak = 3 / (8 * math.pi) * (1 - G * G) * (1 + nu * nu) / ((2 + G * G) * (1 + G * G - 2 * G * nu) ** 1.5)
    return total_r * BETA_R * rayleigh + total_m * BETA_M * peak


def air():
    return Atmosphere(
        wavelengths=[680.0, 550.0, 440.0], solar_irradiance=[1.0] * 3, bottom_radius=GROUND / 1e3, top_radius=TOP / 1e3,
        rayleigh_scattering=1e3 * np.array(BETA_R), rayleigh_scale_height=H_R / 1e3, mie_scattering=[1e3 * BETA_M] * 3,
        mie_absorption=[100 * BETA_M] * 3, mie_scale_height=H_M / 1e3, mie_g=G, ozone_absorption=[0.0] * 3,
        ground_albedo=[0.0] * 3, mie_phase="cornette-shanks",
    )  # fmt: skip


@eqx.filter_jit
def seen(model, **rays):
    return model.sky(air()).radiance(**rays).radiance


def unit(zenith_deg, azimuth_deg):
    z, a = np.radians(zenith_deg), np.radians(azimuth_deg)
    return np.array([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)])


@pytest.mark.parametrize("sun_zenith_deg", [0.0, 45.0, 88.0, 93.0])
def test_a_tutorial_s_numbers_come_out(x64, sun_zenith_deg):
    """The same sums in the same order of approximation: equal to rounding, above the horizon."""
    sun = unit(sun_zenith_deg, 30.0)
    views = np.stack([unit(z, a) for z in (0.0, 40.0, 75.0, 89.0) for a in (0.0, 100.0)])
    got = seen(
        RayMarch(steps=64, light_steps=4), altitude=jnp.asarray(1e-3), view=jnp.asarray(views), sun=jnp.asarray(sun)
    )
    np.testing.assert_allclose(got, [tutorial(view, sun) for view in views], rtol=1e-9)


def test_many_naive_steps_approach_the_exact_integral(x64):
    """Their optical depth counts the whole step that a sample is the middle of: half the error for twice the steps."""
    views, sun = np.stack([unit(20.0, 0.0), unit(70.0, 120.0)]), unit(50.0, 0.0)
    given = {"altitude": jnp.asarray(0.1), "view": jnp.asarray(views), "sun": jnp.asarray(sun)}
    exact = seen(RayMarch(steps=24), **given)
    coarse, fine = (np.abs(seen(RayMarch(steps=n, light_steps=n), **given) / exact - 1).max() for n in (200, 400))
    assert fine < 5e-3
    assert 0.4 < fine / coarse < 0.6


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="light_steps"):
        RayMarch(light_steps=0)


@pytest.mark.parametrize("altitude", [99.9, 99.99, 99.9995])
def test_all_but_horizontal_just_below_the_top(altitude):
    """The cosine of 90° is 6e-17 or 4e-8, and single precision knows small climbs badly: the light is that of the horizontal.

    Over mu = 4e-8 the light changes by 1e-3 of itself there at most, and its slope by as much; reverse mode has to add
    slopes that may not drown each other.
    """
    sun = jnp.array([0.0, math.sin(math.radians(60)), 0.5], jnp.float32)

    def light(altitude, mu):
        view = jnp.stack([jnp.sqrt(1 - mu * mu), jnp.zeros_like(mu), mu])
        seen = RayMarch().sky(earth()).radiance(altitude=altitude, view=view, sun=sun)
        return jnp.sum(seen.radiance), seen.transmittance

    mu = np.array([0.0, 6e-17, 4.37e-8, -4.37e-8], np.float32)
    both = jax.jit(jax.vmap(jax.value_and_grad(light, has_aux=True), in_axes=(None, 0)))
    (radiance, transmittance), slope = both(np.float32(altitude), mu)
    np.testing.assert_allclose(radiance[1:], radiance[0], rtol=5e-3)
    np.testing.assert_allclose(slope[1:], slope[0], rtol=5e-3)
    assert np.all(transmittance > 0.99999)
    # The path to the top is √(2 R d) long, in air whose density changes little over d.
    np.testing.assert_allclose(slope[0] * 2 * (100 - np.float32(altitude)), -radiance[0], rtol=0.05)


def test_a_small_planet_from_far_is_finite():
    """Rounding of the distance is larger there than the planet."""
    small = eqx.tree_at(lambda a: (a.bottom_radius, a.top_radius), earth(), (jnp.float32(1), jnp.float32(101)))
    sun = jnp.array([0.0, math.sqrt(0.5), math.sqrt(0.5)], jnp.float32)

    def light(view):
        return jnp.sum(RayMarch().sky(small).radiance(altitude=jnp.float32(1e5), view=view, sun=sun).radiance)

    down = np.radians([179.95, 179.99, 179.999, 180.0])
    view = np.stack([0 * down, np.sin(down), np.cos(down)], axis=-1).astype(np.float32)
    radiance, slopes = jax.jit(jax.vmap(jax.value_and_grad(light)))(view)
    assert np.all(np.isfinite(radiance))
    assert np.all(np.isfinite(slopes))
    assert radiance[-1] > 0
