"""Precomputed scattering against Bruneton's own program, against exact single scattering, and at its limits."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

from diffatmo.atmosphere import earth
from diffatmo.models.bruneton import Bruneton, Planet, Sizes, Steps
from diffatmo.models.bruneton.precomputation import look_up
from diffatmo.models.raymarch import RayMarch
from diffatmo.models.tables import PARAMETERISATIONS, bilinear
from diffatmo.models.transmittance_table import between, to_top

SMALL = Bruneton(sizes=Sizes(32, 128, 8, 32, 16, 64, 24, 8), steps=Steps(64, 20, 20, 8, 16), orders=2)
TINY = replace(SMALL, sizes=Sizes(8, 16, 4, 8, 4, 8, 6, 4), orders=1)
"""For what is exact at its entries: it takes no time but that of the compiler."""
RAYS = 600
"""Fewer are made as many, as each number would be a program of its own."""


@eqx.filter_jit
def solved(model, atmosphere):
    return model.sky(atmosphere)


@cache
def small_sky():
    return solved(SMALL, earth())


quickly = partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
"""For what is so small that what takes long is compilation."""


@quickly
def _seen(sky, altitude, mu, mu_s, nu, distance):
    return sky.path(altitude=altitude, mu=mu, mu_s=mu_s, nu=nu, distance=distance)


def seen(sky, altitude, mu, mu_s, nu, distance=None):
    arrays = [altitude, mu, mu_s, nu] if distance is None else [altitude, mu, mu_s, nu, distance]
    count = len(mu)
    arrays = [np.pad(np.asarray(x), (0, max(RAYS - count, 0)), mode="edge") for x in arrays]
    found = _seen(sky, *arrays[:4], None if distance is None else arrays[4])
    return jax.tree.map(lambda x: np.asarray(x)[:count], found)


def rays(count, seed=0):
    """Directions inside a clear atmosphere: altitude, mu, mu_s, nu."""
    rng = np.random.default_rng(seed)
    altitude, mu, mu_s = rng.uniform(0.1, 60, count), rng.uniform(-1, 1, count), rng.uniform(0.05, 1, count)
    nu = mu * mu_s + np.sqrt((1 - mu**2) * (1 - mu_s**2)) * np.cos(rng.uniform(0, np.pi, count))
    return [jnp.asarray(x, jnp.result_type(float)) for x in (altitude, mu, mu_s, nu)]


@pytest.fixture(scope="module")
def reference(shared):
    """A folder, and the sky of scene S1 (with ozone, if asked) at the sizes that the reference used."""
    skies = {}

    def ask(s1, ozone):
        if ozone not in skies:
            absorption = jnp.array([0.650e-3, 1.881e-3, 0.085e-3]) if ozone else jnp.zeros(3)
            air = replace(s1, mie_phase="cornette-shanks", ozone_absorption=absorption)
            skies[ozone] = solved(Bruneton(), air)
        return shared / "reference", skies[ozone]

    return ask


def test_the_tables_are_those_of_brunetons_program(reference, s1):
    """float32 against double: 2e-6 in T.

    Two of the 16384 entries of the reference's T, at the very horizon, are off by 1e-3; ours agree with the same sum in double
    precision. S is compared where it is not dark, in sum and RMS: at the horizon single entries feel the precision of mu.
    """
    folder, sky = reference(s1, False)
    truth, ours = np.load(folder / "bruneton2017_s1_tables.npz"), sky.tables
    error = np.abs(np.asarray(ours.transmittance) - truth["transmittance"]).max(axis=-1)
    assert (error > 1e-5).sum() <= 2
    assert error[:, :-1].max() < 1e-5
    np.testing.assert_allclose(ours.irradiance, truth["irradiance"], rtol=1e-3, atol=1e-6)
    for name, table in (("scattering", ours.rayleigh), ("single_mie_scattering", ours.mie)):
        wanted = truth[name]
        bright = wanted > 1e-3 * wanted.max()
        relative = np.asarray(table)[bright] / wanted[bright] - 1
        assert np.sqrt(np.mean(relative**2)) < 2e-3
        assert abs(np.sum(np.asarray(table)) / wanted.sum() - 1) < 5e-4


@pytest.mark.parametrize("ozone", [False, True])
def test_radiance_and_irradiance_are_those_of_brunetons_program(reference, s1, ozone):
    """Two altitudes, suns from the zenith to 92°, all directions; 1e-3 is a hundred times what float32 costs on average."""
    folder, sky = reference(s1, ozone)
    infix = "_ozone" if ozone else ""
    truth = np.load(folder / f"bruneton2017_s1{infix}_radiance.npz")
    sun, view, azimuth = (
        np.radians(truth[f"{k}_deg"].astype(float)) for k in ("sun_zenith", "view_zenith", "view_azimuth")
    )
    nu = np.cos(view) * np.cos(sun) + np.sin(view) * np.sin(sun) * np.cos(azimuth)
    arrays = [jnp.asarray(x, jnp.float32) for x in (truth["altitude_km"], np.cos(view), np.cos(sun), nu)]
    got = seen(sky, *arrays)
    relative = np.asarray(got.inscatter) / truth["radiance"] - 1
    assert np.sqrt(np.mean(relative**2)) < 1e-4
    assert np.abs(relative).max() < 1e-3
    free = truth["transmittance"] > 0
    np.testing.assert_allclose(np.asarray(got.transmittance)[free], truth["transmittance"][free], atol=1e-5)
    truth = np.load(folder / f"bruneton2017_s1{infix}_irradiance.npz")
    altitude = jnp.asarray(truth["altitude_km"], jnp.float32)
    mu_s = jnp.asarray(np.cos(np.radians(truth["sun_zenith_deg"])), jnp.float32)
    np.testing.assert_allclose(sky.sun_irradiance(altitude=altitude, mu_s=mu_s), truth["sun_irradiance"], atol=1e-5)
    np.testing.assert_allclose(sky.sky_irradiance(altitude=altitude, mu_s=mu_s), truth["sky_irradiance"], rtol=2e-3)


@eqx.filter_jit
def places(planet):
    """Positions of the nodes of every axis, and what of T and of S may not be compared; compiled as a whole."""
    altitude, mu = planet.transmittance_nodes()
    free = mu > -jnp.sqrt(1 - (planet.bottom_radius / (planet.bottom_radius + altitude[:, None])) ** 2) + 1e-9
    of_t = planet.transmittance_position(jnp.broadcast_to(altitude[:, None], mu.shape), mu)
    altitude, mu_s = planet.irradiance_nodes()
    of_e = planet.irradiance_position(altitude[:, None], mu_s)
    of_s = (
        planet.altitude_position(planet.altitudes()),
        planet.mu_s_position(planet.mu_s_nodes()),
        planet.nu_position(planet.nu_nodes()),
    )

    def of_mu(altitude):
        mu = planet.mu_nodes(altitude)
        return mu, planet.mu_position(jnp.broadcast_to(altitude, mu.shape), mu, planet.ground_nodes())

    return of_t, free, of_e, of_s, jax.lax.map(of_mu, planet.altitudes()[1:-1])


@pytest.mark.parametrize("parameterisation", PARAMETERISATIONS)
@pytest.mark.parametrize(("radius", "top"), [(6360.0, 100.0), (60.0, 8.0)])
def test_every_entry_is_found_where_it_was_put(x64, parameterisation, radius, top):
    """Position(node i) = i on every axis; in 2008 the first entries of a half of mu may lie beyond the nearest boundary."""
    sizes = Sizes(7, 9, 5, 6, 8, 10, 11, 4)
    planet = Planet(jnp.asarray(radius), jnp.asarray(top), -0.2, sizes, parameterisation)
    (p_r, p_mu), free, (p_h, p_s), of_s, (mus, positions) = jax.tree.map(np.asarray, places(planet))
    # At the top and straight up every distance is the same.
    np.testing.assert_allclose(p_r, np.broadcast_to(np.arange(7)[:, None], p_r.shape), atol=1e-6)
    np.testing.assert_allclose(p_mu[free], np.broadcast_to(np.arange(9), p_mu.shape)[free], atol=1e-5)
    np.testing.assert_allclose(p_h[:, 0], np.arange(5), atol=1e-9)
    np.testing.assert_allclose(p_s, np.arange(6), atol=1e-9)
    for found, count in zip(of_s, (8, 11, 4), strict=True):
        np.testing.assert_allclose(found, np.arange(count), atol=1e-9)
    for mu, found in zip(mus, positions, strict=True):
        inside = np.abs(mu) < 1 - 1e-9
        np.testing.assert_allclose(found[inside], np.arange(10)[inside], atol=1e-5)


def test_a_lookup_at_an_entry_is_that_entry():
    """Multilinear interpolation reproduces a table at its nodes, and a table of a linear function everywhere."""
    planet = Planet(jnp.asarray(6360.0), jnp.asarray(100.0), -0.2, Sizes(4, 4, 4, 4, 5, 6, 7, 4), "2017")
    table = jax.random.uniform(jax.random.key(0), (5, 6, 4, 7, 2))
    altitude, mu, mu_s, nu = eqx.filter_jit(
        lambda p: (p.altitudes()[2], p.mu_nodes(p.altitudes()[2]), p.mu_s_nodes(), p.nu_nodes())
    )(planet)
    ground = planet.ground_nodes()[:, None, None]
    got = eqx.filter_jit(look_up)(planet, table, altitude, mu[:, None, None], mu_s, nu[:, None], ground)
    np.testing.assert_allclose(got, table[2], atol=2e-4)
    x, y = jnp.array([0.0, 0.3, 2.9]), jnp.array([1.0, 1.7, 4.0])
    plane = jnp.arange(4.0)[:, None] * 10 + jnp.arange(5.0)
    np.testing.assert_allclose(bilinear(plane[..., None], x, y)[:, 0], 10 * x + y, rtol=1e-6)


def unlike_single_scattering(model, air):
    """RMS relative difference to the exact integrals of `raymarch`, away from the horizon."""
    altitude, mu, mu_s, nu = rays(600)
    steep = np.asarray((mu > 0.1) & (mu_s > 0.2) & (altitude < 30))
    wanted = seen(RayMarch().sky(air), altitude, mu, mu_s, nu)
    got = seen(solved(replace(model, orders=1), air), altitude, mu, mu_s, nu)
    np.testing.assert_allclose(got.transmittance[steep], wanted.transmittance[steep], atol=0.01)
    return np.sqrt(np.mean((np.asarray(got.inscatter / wanted.inscatter)[steep] - 1) ** 2))


@pytest.mark.parametrize("parameterisation", PARAMETERISATIONS)
def test_one_order_converges_to_single_scattering(parameterisation):
    """Interpolation is linear, so twice as many entries leave a quarter of the error: 1 to 2 % at the papers' sizes."""
    coarse, fine = (
        unlike_single_scattering(replace(model, parameterisation=parameterisation), earth())
        for model in (SMALL, Bruneton())
    )
    assert fine < 0.02
    assert fine < coarse / 3


def test_both_parameterisations_are_of_the_same_sky():
    """With a second order of scattering and low in the atmosphere, where entries are dense."""
    altitude, mu, mu_s, nu = rays(400, seed=1)
    skies = small_sky(), solved(replace(SMALL, parameterisation="2008"), earth())
    new, old = (np.asarray(seen(sky, altitude / 20, mu, mu_s, nu).inscatter) for sky in skies)
    steep = np.asarray(mu > 0.1)
    assert np.sqrt(np.mean((old / new - 1)[steep] ** 2)) < 0.03


def test_a_path_begins_with_nothing_and_ends_with_all():
    """S(a→b): 0 at b = a, the whole of S at the boundary and beyond it; and it grows in between."""
    sky = small_sky()
    altitude, mu, mu_s, nu = rays(200, seed=2)
    whole = seen(sky, altitude, mu, mu_s, nu)
    start = seen(sky, altitude, mu, mu_s, nu, jnp.zeros_like(mu))
    np.testing.assert_allclose(start.inscatter, 0, atol=1e-6)
    np.testing.assert_allclose(start.transmittance, 1, atol=1e-6)
    far = seen(sky, altitude, mu, mu_s, nu, jnp.full_like(mu, 1e5))
    np.testing.assert_allclose(far.transmittance, whole.transmittance, atol=1e-5)
    near, farther = (seen(sky, altitude, mu, mu_s, nu, jnp.full_like(mu, d)).inscatter for d in (5.0, 50.0))
    assert np.all(np.asarray(near) <= np.asarray(farther) + 1e-3 * np.asarray(whole.inscatter))


def test_packed_tables_give_aerosol_back():
    """The first wavelength is stored and comes back exactly; the others within what multiple scattering adds to the red."""
    tables = small_sky()
    packed = replace(tables, packed=True)
    altitude, mu, mu_s, nu = rays(300, seed=3)
    full, recovered = (np.asarray(seen(sky, altitude, mu, mu_s, nu).inscatter) for sky in (tables, packed))
    np.testing.assert_allclose(recovered[:, 0], full[:, 0], rtol=1e-5)
    assert np.sqrt(np.mean((recovered / full - 1) ** 2)) < 0.1


def test_light_from_nothing_is_nothing():
    """No air, aerosol or ozone: no scattered light, full transmittance, and the sun alone on the ground."""
    nothing = jnp.zeros(3)
    vacuum = replace(
        earth(), rayleigh_scattering=nothing, mie_scattering=nothing, mie_absorption=nothing, ozone_absorption=nothing
    )
    sky = solved(SMALL, vacuum)
    got = seen(sky, *rays(50))
    np.testing.assert_array_equal(got.inscatter, 0)
    np.testing.assert_allclose(got.transmittance, 1, rtol=3e-7)
    mu_s = jnp.array([1.0, 0.5, 0.1])
    np.testing.assert_allclose(sky.sun_irradiance(altitude=jnp.zeros(3), mu_s=mu_s)[:, 0], mu_s, rtol=1e-6)
    np.testing.assert_array_equal(sky.sky_irradiance(mu_s=mu_s), 0)


def test_transmittance_along_the_vertical_is_exact():
    """exp(-Σ β H (1 - exp(-top/H))) for air and aerosol, at an entry of the table."""
    air = replace(earth(), ozone_absorption=jnp.zeros(3))

    @quickly
    def vertical(model, air):
        sky = model.sky(air)
        return to_top(sky.planet, sky.tables.transmittance, jnp.zeros(()), jnp.ones(()))

    got = vertical(replace(TINY, steps=Steps(transmittance=400, single=4)), air)
    depth = sum(
        tau * (1 - jnp.exp(-air.top_altitude / h))
        for tau, h in (
            (air.rayleigh_optical_depth, air.rayleigh_scale_height),
            (air.mie_optical_depth, air.mie_scale_height),
        )
    )
    np.testing.assert_allclose(got, jnp.exp(-depth), rtol=1e-3)


@quickly
def aerosols_light_at_the_zenith(model, air):
    """With the sun there; of all tables, only what this needs is computed."""
    sky = model.sky(air)
    zenith = (jnp.zeros(1), jnp.ones(1), jnp.ones(1))
    return look_up(sky.planet, sky.tables.mie, *zenith, jnp.ones(1), jnp.zeros(1, bool))


@pytest.mark.parametrize("steps", [10, 25, 50])
def test_equidistant_steps_make_the_aerosol_too_thick_and_gauss_does_not(steps):
    """Thin aerosol alone, seen at the zenith with the sun there: the light is the column, Σ of the rule for exp(-s / H).

    The trapezoid's sum of an exponential over steps h is a geometric series, x coth(x) times the integral, x = h / 2H: 22 %
    too much at the papers' 50 steps. Gauss's rule with as many nodes is exact but for the table's own interpolation, and for
    10 nodes, 5 on either side of the middle, as well.
    """
    thin, height, top = 1e-6, 1.2, 100.0
    nothing = jnp.zeros(3)
    air = replace(
        earth(), rayleigh_scattering=nothing, mie_absorption=nothing, ozone_absorption=nothing, ground_albedo=nothing,
        mie_scattering=jnp.full(3, thin), mie_scale_height=jnp.array(height),
        top_radius=earth().bottom_radius + top, solar_irradiance=jnp.ones(3),
    )  # fmt: skip
    x = top / steps / (2 * height)
    for rule, factor in (("trapezoid", x / np.tanh(x)), ("gauss", 1.0)):
        counted = Steps(transmittance=64, single=steps)
        up = aerosols_light_at_the_zenith(replace(TINY, steps=counted, quadrature=rule), air)
        np.testing.assert_allclose(up, factor * thin * height, rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"parameterisation": "2016"}, "parameterisation"),
        ({"quadrature": "simpson"}, "quadrature"),
        ({"sizes": Sizes(mu=7)}, "sizes.mu"),
        ({"steps": Steps(density=0)}, "steps.density"),
        ({"orders": 0}, "orders"),
    ],
)
def test_sizes_that_cannot_be_are_refused(options, named):
    with pytest.raises(ValueError, match=named):
        Bruneton(**options)


@pytest.mark.parametrize("ground", [False, True])
def test_derivatives_through_air_that_lets_next_to_nothing_pass(ground):
    """Two entries of 1e-30, whose square no number in single precision is: darkness, and no derivative that is infinite."""
    planet = SMALL.planet(earth())
    table = jnp.full((SMALL.sizes.transmittance_r, SMALL.sizes.transmittance_mu, 1), 1e-30, jnp.float32)

    def passes(table):
        at = (jnp.float32(x) for x in (1.0, -0.5 if ground else 0.5, 0.1))
        return between(planet, table, *at, jnp.asarray(ground))[0]

    assert 0 <= float(passes(table)) <= 1
    assert jnp.isfinite(jax.grad(passes)(table)).all()


def test_what_is_at_the_lens_is_seen_through_the_thickest_haze():
    """Along the ground T to the top is less than any number; over no distance it is 1, and over 200 m that of the exact sum."""
    haze = replace(earth(), mie_scattering=jnp.full(3, 1.0), mie_absorption=jnp.full(3, 0.1))
    sky, exact = solved(replace(SMALL, orders=1), haze), RayMarch().sky(haze)
    at = [jnp.full(3, 0.001), jnp.array([0.0, 0.01, -0.002]), *(jnp.full(3, x) for x in (0.5, 0.5))]
    near, far = (seen(sky, *at, jnp.full(3, d)) for d in (0.0, 0.2))
    np.testing.assert_allclose(near.transmittance, 1, atol=1e-4)
    np.testing.assert_allclose(near.inscatter, 0, atol=1e-4 * np.max(seen(sky, *at).inscatter))
    np.testing.assert_allclose(far.transmittance, seen(exact, *at, jnp.full(3, 0.2)).transmittance, rtol=1e-3)
