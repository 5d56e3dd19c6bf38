"""The default model against independent Monte Carlo, against itself at other resolutions, and at its limits."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST, radiance, viewed

from diffatmo.atmosphere import earth
from diffatmo.models.moments import Moments
from diffatmo.models.moments.angular import azimuthal, norms, orders, pairs, plane, polar
from diffatmo.models.moments.shell import Directions
from diffatmo.models.pathtrace import PathTrace
from diffatmo.models.raymarch import RayMarch


def directions(zenith_deg, azimuth_deg):
    z, a = np.radians(zenith_deg), np.radians(azimuth_deg)
    return jnp.asarray(np.stack([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)], -1), jnp.result_type(float))


QUICK = Moments(
    altitudes=6, suns=10, first=Directions(4, 3, 3, 3, 4), iterate=Directions(3, 2, 3, 2, 2), last=Directions(3, 2, 4, 2, 3),
    source_degree=3, peak_azimuths=6, order=4, view_steps=4, view_sky=9, view_ground=7, view_columns=5,
    view_fine_columns=9,
)  # fmt: skip
"""Few nodes, for what does not depend on their number."""


@eqx.filter_jit
def solved(model, atmosphere):
    return model.sky(atmosphere)


@pytest.mark.parametrize(("sun_zenith_deg", "sky_limit", "all_limit"), [(60, 2e-3, 2e-3), (92, 4e-3, 1e-2)])
@pytest.mark.parametrize("how", [radiance, viewed], ids=["radiance", "viewed"])
def test_scene_s1_against_monte_carlo(shared, s1, how, sun_zenith_deg, sky_limit, all_limit):
    """RMS relative error, in float32. The tables' own standard error is 0.04 % at 60°, 0.25 % at 92°."""
    truth = np.load(shared / "reference" / f"montecarlo_s1_sza{sun_zenith_deg}.npz")
    view = directions(truth["view_zenith_deg"], truth["view_azimuth_deg"])
    got = how(solved(Moments(), s1), 0.5, view, directions(sun_zenith_deg, 0.0)).radiance
    error = np.asarray(got) / truth["radiance"] - 1
    sky = truth["view_zenith_deg"] < 90
    assert np.sqrt(np.mean(error[sky] ** 2)) < sky_limit
    assert np.sqrt(np.mean(error**2)) < all_limit


def test_scene_s1_against_successive_orders(shared, s1):
    """sasktran2 over the whole sky; it agrees with the Monte Carlo to 0.1 %."""
    truth = np.load(shared / "reference" / "sasktran2_s1_sza60.npz")
    zenith, azimuth = np.meshgrid(truth["view_zenith_deg"], truth["rel_azimuth_deg"], indexing="ij")
    got = viewed(solved(Moments(), s1), 0.5, directions(zenith, azimuth), directions(60, 0.0)).radiance
    error = np.asarray(got) / np.moveaxis(truth["radiance"], 0, -1) - 1
    assert np.sqrt(np.mean(error**2)) < 2.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("sun_zenith_deg", [30.0, 45.0])
def test_the_surroundings_of_the_sun_in_peaked_haze_against_monte_carlo(sun_zenith_deg):
    """With g = 0.9 and an optical depth of 0.06, from 5° to 30° off the sun; nodes of the sun's height that are 30° apart are
    off by 8 % there. The Monte Carlo's own error is 0.2 to 0.3 %."""
    hazy = replace(earth(), mie_g=0.9, mie_scattering=jnp.full(3, 0.05))
    off = np.array([-30.0, -20, -10, -5, 5, 10, 20, 30])
    view, sun = (
        directions(np.abs(sun_zenith_deg + off), np.where(sun_zenith_deg + off < 0, 180, 0)),
        directions(sun_zenith_deg, 0),
    )
    truth = PathTrace(samples=4096).sky(hazy).radiance(altitude=0.1, view=view, sun=sun).radiance
    np.testing.assert_allclose(viewed(solved(Moments(), hazy), 0.1, view, sun).radiance, truth, rtol=0.035)


@pytest.mark.parametrize("altitude", [0.001, 0.5, 12.0, 300.0])
@pytest.mark.parametrize("sun_zenith_deg", [20.0, 88.0])
def test_a_view_interpolates_what_its_sky_computes(altitude, sun_zenith_deg):
    """Off the horizon itself, where a pixel mixes sky and ground, the table of a view is good to 0.2 % RMS.

    From space the rows of the ground span day and night at once: 0.5 %.
    """
    zenith, azimuth = np.meshgrid([0.0, 5, 30, 60, 80, 88, 95, 110, 130, 180], [0.0, 20, 70, 120, 180], indexing="ij")
    view, sun = directions(zenith, azimuth), directions(sun_zenith_deg, 30.0)
    sky = solved(Moments(), earth())
    exact, table = (how(sky, altitude, view, sun) for how in (radiance, viewed))
    seen = np.asarray(exact.radiance) > 0
    ratio = np.asarray(table.radiance)[seen] / np.asarray(exact.radiance)[seen] - 1
    assert np.sqrt(np.mean(ratio**2)) < (2e-3 if altitude < 100 else 5e-3)
    np.testing.assert_allclose(table.transmittance, exact.transmittance, atol=3e-3)


def test_first_order_is_the_ray_march(s1):
    """With black ground and thin air the sky is single scattering: what is left is of second order in τ ~ 1e-4."""
    where = lambda a: (a.rayleigh_scattering, a.mie_scattering, a.mie_absorption, a.ground_albedo)
    thin = eqx.tree_at(where, s1, tuple(1e-3 * getattr(s1, n) for n in ("rayleigh_scattering", "mie_scattering",
                       "mie_absorption", "ground_albedo")))  # fmt: skip
    view, sun = directions([0.0, 40, 85, 89.9], [0.0, 50, 90, 180]), directions(60.0, 0.0)
    many, once = (radiance(solved(model, thin), 0.5, view, sun).radiance for model in (Moments(), RayMarch()))
    np.testing.assert_allclose(many, once, rtol=2e-3)


def test_an_empty_atmosphere_shows_the_sunlit_ground(s1):
    """No air, no light but albedo / π times mu_s times the sun."""
    names = ("rayleigh_scattering", "mie_scattering", "mie_absorption", "ozone_absorption")
    empty = eqx.tree_at(lambda a: tuple(getattr(a, n) for n in names), s1, (jnp.zeros(3),) * 4)
    view, sun = directions([0.0, 120.0, 180.0], [0.0, 0.0, 0.0]), directions(60.0, 0.0)
    got = radiance(solved(Moments(), empty), 0.5, view, sun)
    assert np.abs(got.radiance[0]).max() == 0
    np.testing.assert_allclose(got.radiance[2], 0.3 / np.pi * 0.5, rtol=1e-5)
    np.testing.assert_allclose(got.transmittance, 1, rtol=1e-6)


def test_flux_is_conserved_by_a_conservative_atmosphere_over_white_ground(s1):
    """Nothing absorbs, so as much light leaves through the top as comes in: net flux at the ground is zero.

    On a sphere the column above one point also trades light sideways; with the sun at the zenith of a large planet that
    is (H/R) small. Rayleigh only, so that the truncation of the aerosol's peak does not enter.
    """
    where = lambda a: (a.mie_scattering, a.mie_absorption, a.ground_albedo, a.bottom_radius, a.top_radius)
    zero = jnp.zeros(3)
    big = jnp.asarray(60000.0)
    white = eqx.tree_at(where, s1, (zero, zero, jnp.ones(3), big, big + 100))
    sky = solved(Moments(order=12), white)
    mu, weight = np.polynomial.legendre.leggauss(24)
    mu, weight = 0.5 * (mu + 1), 0.5 * weight
    down = directions(180 - np.degrees(np.arccos(mu)), 0 * mu)
    leaving = 2 * np.pi * (weight * mu) @ radiance(sky, 99.9, down, directions(0.0, 0.0)).radiance
    np.testing.assert_allclose(leaving, 1, atol=4e-3)


@pytest.mark.parametrize(("albedo", "limit"), [(0.3, 2e-4), (1.0, 6e-3)])
def test_orders_beyond_the_last_are_a_geometric_series(s1, albedo, limit):
    """Against twice as many orders one by one; a white ground, which sends light up and down, is the hardest case."""
    ground = eqx.tree_at(lambda a: a.ground_albedo, s1, jnp.full(3, albedo))
    few, many = (solved(replace(QUICK, order=order), ground).state for order in (4, 9))
    np.testing.assert_allclose(few.irradiance[:, -1], many.irradiance[:, -1], rtol=limit)
    np.testing.assert_allclose(few.moments[0, 0, :, -1], many.moments[0, 0, :, -1], rtol=limit)


def test_wavelengths_do_not_see_each_other(s1):
    """Channel w depends on the parameters at wavelength w only: what lets a fit share tangents between channels."""
    view, sun = directions([30.0], [40.0]), directions(50.0, 0.0)
    changed = eqx.tree_at(lambda a: a.rayleigh_scattering, s1, s1.rayleigh_scattering * jnp.array([1.0, 2.0, 1.0]))
    a, b = (radiance(solved(Moments(), air), 0.5, view, sun).radiance for air in (s1, changed))
    np.testing.assert_array_equal(a[..., [0, 2]], b[..., [0, 2]])
    assert np.abs(b[..., 1] / a[..., 1] - 1).max() > 0.1


def test_a_red_sun_and_a_blue_sky(s1):
    """At noon the zenith is blue; at sunset the direct light is red."""
    sky = solved(Moments(), s1)
    zenith = radiance(sky, 0.1, directions(0.0, 0.0), directions(30.0, 0.0)).radiance
    assert zenith[2] > zenith[1] > zenith[0]
    sunset = sky.sun_irradiance(altitude=jnp.asarray(0.1), mu_s=jnp.asarray(0.01))
    assert sunset[0] > 3 * sunset[1] > 9 * sunset[2]


def test_angular_functions_are_the_spherical_harmonics_addition_theorem(x64):
    """Σ_m N_lm Π_lm(mu) C_m / (its own value towards the sun) ... = (2l+1)/(4π) P_l(nu), for any two directions."""
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 50, 3))
    a, b = a / np.linalg.norm(a, axis=-1, keepdims=True), b / np.linalg.norm(b, axis=-1, keepdims=True)
    mu, mu_s, nu = jnp.asarray(a[:, 2]), jnp.asarray(b[:, 2]), jnp.sum(jnp.asarray(a * b), -1)
    terms = (
        norms(8)
        * polar(8, mu)
        * polar(8, mu_s)
        * jnp.stack(azimuthal(8, *plane(mu, mu_s, nu)), axis=-1)[..., orders(8)]
    )
    for order in range(9):
        chosen = np.array([pair[0] == order for pair in pairs(8)])
        legendre = np.polynomial.legendre.legval(np.asarray(nu), np.eye(9)[order])
        np.testing.assert_allclose(terms[:, chosen].sum(-1), (2 * order + 1) / (4 * np.pi) * legendre, atol=1e-12)


@pytest.mark.parametrize("sun_zenith_deg", [0.0, 90.0, 108.0])
def test_no_nan_in_value_at_special_points(s1, sun_zenith_deg):
    view, sky = directions([0.0, 90.0, 90.0, 180.0, 91.0], [0.0, 0.0, 180.0, 0.0, 0.0]), solved(Moments(), s1)
    for altitude in (0.0, 100.0, 5000.0):
        for how in (radiance, viewed):
            got = how(sky, altitude, view, directions(sun_zenith_deg, 0.0))
            assert jax.tree.all(jax.tree.map(lambda x: bool(np.isfinite(x).all()), got))
            assert float(got.radiance.min()) >= -1e-9


def test_haze_does_not_depend_on_the_resolution(s1):
    """Two discretisations with nothing in common but the equations.

    Aerosol of optical depth 0.05: degree 3 against 6 in the iteration; without the delta-M method they differ by 1 %. With
    g = 0.9 what neither resolves is the outskirts of the aureole; there 1 %. Of optical depth 0.31: the last gather needs its
    nodes along the rays; with four instead of five the default is off by 0.8 %.
    """

    def haze(scattering: float, scale_height: float, g: float):
        full = lambda value: jnp.full_like(s1.mie_scattering, value)
        where = lambda a: (a.mie_scattering, a.mie_absorption, a.mie_scale_height, a.mie_g)
        new = full(scattering), full(scattering / 9), jnp.asarray(scale_height), jnp.asarray(g)
        return eqx.tree_at(where, s1, new)

    view = directions([0.0, 40, 70, 85, 89, 120, 100], [0.0, 120, 60, 170, 90, 30, 150])
    for air, sun_zenith_deg, limit in (
        (haze(0.03996, 1.2, 0.8), 75.0, 3e-3),
        (haze(0.03996, 1.2, 0.9), 40.0, 1e-2),
        (haze(0.13, 2.2, 0.66), 35.0, 3e-3),
    ):
        sun = directions(sun_zenith_deg, 0.0)
        default, finer = (
            radiance(solved(model, air), 0.5, view, sun).radiance for model in (Moments(), Moments().finer())
        )
        error = default / finer - 1
        assert np.sqrt(np.mean(error**2)) < limit


@partial(jax.jit, compiler_options=COMPILE_FAST)
def seen_and_slopes(radius, top, altitude):
    """Radiance upwards, straight down and just beside that, and its derivatives by the radii and the altitude."""
    view = jnp.asarray([[0.0, 0.6, 0.8], [0.0, 0.0, -1.0], [0.0, 0.005, -0.9999875]])

    def light(radius, top, altitude):
        air = eqx.tree_at(lambda a: (a.bottom_radius, a.top_radius), earth(), (radius, radius + top))
        return QUICK.sky(air).view(altitude=altitude, sun=directions(50.0, 0.0)).radiance(view=view).radiance

    # One tangent after another: with all three in a batch, XLA's program crashes on some processors without AVX-512.
    at = radius, top, altitude
    values, slopes = jax.lax.map(lambda v: jax.jvp(light, at, tuple(v)), jnp.eye(3, dtype=radius.dtype))
    return values[0], slopes


def test_thin_shells_and_far_observers_are_finite():
    """In float32: the fall of the light at dusk, and a planet smaller than a degree."""
    for place in (
        (6360.0, 1.0, 0.1), (6360.0, 20.0, 0.1), (70000.0, 80.0, 0.1), (1000.0, 0.1, 0.01), (6360.0, 100.0, 4e5),
    ):  # fmt: skip
        value, slopes = seen_and_slopes(*[jnp.asarray(x, jnp.float32) for x in place])
        assert bool((value >= 0).all()), place
        assert bool((value[1] > 0).all()), place
        assert all(bool(jnp.isfinite(slope).all()) for slope in slopes), place


@pytest.mark.parametrize(
    ("resolution", "message"),
    [
        ({"order": 3}, "order: got 3, expected at least 4"),
        ({"suns": 0}, "suns: got 0, expected at least 1"),
        ({"view_sky": 0}, "view_sky: got 0, expected at least 1"),
        ({"first": Directions(0, 6, 5, 8, 10)}, r"first: got Directions\(sky=0, .* expected at least 1 of each"),
        ({"iterate": Directions(5, 4, 4, 6, 3)}, "iterate and last: .* 6 and 5 steps; expected as many"),
        ({"source_degree": 2}, r"iterate\.degree: got 3, expected at most source_degree, which is 2"),
        ({"last": Directions(8, 5, 7, 5, 12)}, r"last\.degree: got 12, expected at most first\.degree, which is 10"),
    ],
)
def test_resolutions_that_do_not_fit_together_are_refused(resolution, message):
    with pytest.raises(ValueError, match=message):
        Moments(**resolution)
