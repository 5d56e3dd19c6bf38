"""Coordinates of the fit: bijections, start values on a bound, colouring, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky

from diffatmo import spectrum
from diffatmo.atmosphere import SPECTRAL
from fitting import FREE_FIELDS, FitError
from fitting.bijections import Linear, Log, Logit
from fitting.parameters import select
from fitting.quantities import derived_fields, numbers, quantities

NM = [680.0, 550.0, 440.0]
# Both radii cannot be free at once.
ALL_BUT_TOP = [name for name in FREE_FIELDS if name != "top_radius"]


@pytest.mark.parametrize(
    "bijection",
    [
        Log(jnp.array([0.0]), jnp.array([8.0])),
        Log(jnp.array([6360.0]), jnp.array([100.0])),
        Logit(jnp.array([-1.0]), jnp.array([1.0])),
        Linear(jnp.array([1e-3]), jnp.array([jnp.inf])),
        Linear(jnp.array([0.3]), jnp.array([1.0])),
    ],
)
def test_bijections_invert_and_rise(bijection):
    lower, upper = bijection.limits
    y = jnp.linspace(jnp.maximum(lower, -7), jnp.minimum(upper, 7), 29)
    value = bijection.value(y)
    # A value near 6360 carries float32's 4e-4 km, of a coordinate's unit of 100 km or, at its lower end, of 0.1 km.
    tolerance = 6e-3 if np.any(value > 1000) else 1e-3
    np.testing.assert_allclose(bijection.coordinate(value), y, atol=tolerance)
    slope = jax.jvp(bijection.value, (y,), (jnp.ones_like(y),))[1]
    assert np.all(slope > 0)


def test_linear_reaches_its_bounds_exactly():
    albedo = Linear(jnp.array(0.3), jnp.array(1.0))
    lower, upper = albedo.limits
    assert albedo.value(lower) == 0
    assert float(albedo.value(upper)) == pytest.approx(1, abs=1e-7)


@pytest.mark.parametrize("free", [ALL_BUT_TOP, ["top_radius"]])
def test_start_is_the_initial_atmosphere(free):
    init = toy_sky.truth()
    parameters = select(init, free)
    back = parameters.atmosphere(parameters.start)
    for name in FREE_FIELDS:
        np.testing.assert_allclose(getattr(back, name), getattr(init, name), rtol=2e-6, err_msg=name)
    assert not parameters.at_bound(parameters.start).any()


def test_zero_and_boundary_starts():
    zeros = dict.fromkeys(("rayleigh_scattering", "mie_scattering", "mie_absorption", "ozone_absorption"), 0.0)
    init = toy_sky.change(toy_sky.truth(), **zeros, ground_albedo=1.0)
    parameters = select(init, [*zeros, "ground_albedo"])
    assert np.all(np.isfinite(parameters.start))
    back = parameters.atmosphere(parameters.start)
    for name in [*zeros, "ground_albedo"]:
        np.testing.assert_allclose(getattr(back, name), getattr(init, name), atol=1e-7)
    assert parameters.at_bound(parameters.start).all()
    # From zero, a natural step is of the typical size, and the derivative there is that size too: it can be left.
    jacobian = jax.jacfwd(lambda y: numbers(parameters.atmosphere(y), list(zeros)))(parameters.start)
    assert np.all(np.abs(jacobian).sum(axis=1) > 1e-4)


def test_fields_tied_to_the_start_keep_their_ratios():
    init = toy_sky.truth()
    parameters = select(init, ["ozone_absorption", "mie_g"], {"ozone_absorption": "start"})
    assert parameters.size == 2
    doubled = parameters.atmosphere(parameters.start.at[0].mul(2))
    np.testing.assert_allclose(doubled.ozone_absorption, 2 * init.ozone_absorption, rtol=1e-6)
    # An albedo stays below one at every wavelength.
    albedo = select(toy_sky.change(init, ground_albedo=[0.2, 0.4, 0.1]), ["ground_albedo"], {"ground_albedo": "start"})
    # The bound is a float32 just below 1 over the largest albedo.
    assert float(albedo.limits[1][0]) == pytest.approx(2.5, rel=1e-5)


def test_scale_heights_move_light_and_do_not_make_it():
    """Where β and H are both free, the coordinate of H leaves the optical depth, and that of β alone makes it."""
    init = toy_sky.truth()
    pairs = ["rayleigh_scattering", "rayleigh_scale_height", "mie_scattering", "mie_absorption", "mie_scale_height"]
    parameters = select(init, pairs)
    start = parameters.start
    heights = [3, 10]
    moved = parameters.atmosphere(start.at[jnp.array(heights)].add(0.4))
    for field in ("rayleigh_scale_height", "mie_scale_height"):
        np.testing.assert_allclose(getattr(moved, field), np.exp(0.4) * getattr(init, field), rtol=1e-6)
    for depth in ("rayleigh_optical_depth", "mie_optical_depth"):
        np.testing.assert_allclose(getattr(moved, depth), getattr(init, depth), rtol=2e-6)
    # Alone, a scale height changes the optical depth.
    alone = select(init, ["rayleigh_scale_height"])
    np.testing.assert_array_equal(alone.atmosphere(alone.start + 0.4).rayleigh_scattering, init.rayleigh_scattering)


def test_rayleigh_tied_to_the_fourth_power():
    init = toy_sky.truth()
    parameters = select(init, ["rayleigh_scattering"], {"rayleigh_scattering": "lambda^-4"})
    found = parameters.atmosphere(parameters.start + 0.1).rayleigh_scattering
    np.testing.assert_allclose(found * np.array(NM) ** 4, (found * np.array(NM) ** 4)[0], rtol=1e-6)
    # The factor keeps the sum, which for spectra near to λ⁻⁴ is near to each.
    assert parameters.size == 1
    np.testing.assert_allclose(found.sum(), np.exp(0.1) * init.rayleigh_scattering.sum(), rtol=1e-5)


def test_grey_fields_have_one_number():
    init = toy_sky.change(toy_sky.truth(), ground_albedo=[0.2, 0.4, 0.6])
    parameters = select(init, ["ground_albedo"], {"ground_albedo": "grey"})
    np.testing.assert_allclose(parameters.atmosphere(parameters.start).ground_albedo, 0.4, rtol=1e-6)
    upper = parameters.atmosphere(parameters.limits[1]).ground_albedo
    assert np.all((upper > 0.999) & (upper <= 1))


def test_ozone_in_dobson_units():
    """300 DU of the cross sections, and the column that is reported, are the same thing."""
    bands = jnp.asarray(NM)
    init = toy_sky.change(toy_sky.truth(), ozone_absorption=spectrum.ozone_absorption(bands, column_du=300.0).tolist())
    parameters = select(init, ["ozone_absorption"], {"ozone_absorption": "dobson"})
    assert parameters.derived == ["ozone_column"]
    start = parameters.atmosphere(parameters.start)
    np.testing.assert_allclose(start.ozone_absorption, init.ozone_absorption, rtol=1e-5)
    np.testing.assert_allclose(numbers(start, ["ozone_column"]), 300, rtol=1e-5)
    half = parameters.atmosphere(parameters.start / 2)
    np.testing.assert_allclose(numbers(half, ["ozone_column"]), 150, rtol=1e-5)


def test_angstrom_aerosol():
    """Extinction is a power law, a part of it is absorbed; what is reported is what was put in."""
    bands, alpha, albedo = np.array(NM), 1.3, 0.92
    extinction = 5e-3 * (bands / 550) ** -alpha
    init = toy_sky.change(
        toy_sky.truth(),
        mie_scattering=(albedo * extinction).tolist(),
        mie_absorption=((1 - albedo) * extinction).tolist(),
    )
    free = ["mie_scattering", "mie_absorption", "mie_scale_height"]
    parameters = select(init, free, {"mie": "angstrom"})
    assert parameters.size == 4
    start = parameters.atmosphere(parameters.start)
    np.testing.assert_allclose(start.mie_scattering, init.mie_scattering, rtol=1e-5)
    np.testing.assert_allclose(start.mie_absorption, init.mie_absorption, rtol=1e-5)
    names = ["mie_angstrom_exponent", "mie_optical_depth_550", "mie_single_scattering_albedo"]
    np.testing.assert_allclose(numbers(start, names), [alpha, 5e-3 * 1.2, *[albedo] * 3], rtol=1e-5)
    assert set(parameters.derived) >= {"mie_angstrom_exponent", "mie_optical_depth"}
    other = parameters.atmosphere(parameters.start + jnp.array([np.log(2), 0.5, 0.4, 0.0]))
    np.testing.assert_allclose(numbers(other, names), [alpha + 0.5, 1e-2 * 1.2, *[albedo - 0.04] * 3], rtol=1e-5)
    # With the absorbed part as it is, two coordinates are left of the three.
    fixed = select(init, ["mie_scattering"], {"mie": "angstrom"})
    assert fixed.size == 2
    np.testing.assert_allclose(
        fixed.atmosphere(fixed.start + 0.3).mie_absorption / fixed.atmosphere(fixed.start + 0.3).mie_extinction,
        1 - albedo,
        rtol=1e-4,
    )


def test_an_aerosol_at_its_bound_says_so():
    parameters = select(toy_sky.truth(), ["mie_scattering", "mie_absorption"], {"mie": "angstrom"})
    assert not parameters.at_bound(np.asarray(parameters.start)).any()
    held = parameters.at_bound(np.asarray(parameters.start.at[2].set(0)))
    assert held.tolist() == [False] * 3 + [True] * 3


def test_colours_share_a_tangent_among_wavelengths():
    parameters = select(
        toy_sky.truth(), ["rayleigh_scattering", "mie_g", "mie_scattering"], {"mie_scattering": "start"}
    )
    colour, channel = parameters.colours()
    assert colour.tolist() == [0, 0, 0, 1, 2]
    assert channel.tolist() == [0, 1, 2, -1, -1]


def test_quantities_are_named_like_the_fields():
    found = quantities(["mie_scattering", "mie_scale_height", "mie_g", "mie_optical_depth"], NM)
    assert [q.name for q in found] == [
        *("mie_scattering_680", "mie_scattering_550", "mie_scattering_440", "mie_scale_height", "mie_g"),
        *("mie_optical_depth_680", "mie_optical_depth_550", "mie_optical_depth_440"),
    ]
    assert [q.unit for q in found] == ["1/km"] * 3 + ["km", "", "", "", ""]
    assert len(numbers(toy_sky.truth(), ["mie_scattering", "mie_scale_height", "mie_g", "mie_optical_depth"])) == 8
    assert all(len(quantities([name], NM)) == (3 if name in SPECTRAL else 1) for name in FREE_FIELDS)


def test_derived_quantities():
    atmosphere = toy_sky.truth()
    assert derived_fields(["mie_g", "ground_albedo"]) == []
    assert derived_fields(["mie_scattering"]) == ["mie_optical_depth", "mie_single_scattering_albedo"]
    depth, albedo = (numbers(atmosphere, [name]) for name in ("mie_optical_depth", "mie_single_scattering_albedo"))
    np.testing.assert_allclose(depth, (3.996e-3 + 0.444e-3) * 1.2, rtol=1e-6)
    np.testing.assert_allclose(albedo, 0.9, rtol=1e-6)
    # Without aerosol there is nothing to take a ratio of.
    clear = toy_sky.change(atmosphere, mie_scattering=0.0, mie_absorption=0.0)
    assert np.all(np.isfinite(numbers(clear, ["mie_single_scattering_albedo"])))


@pytest.mark.parametrize(
    ("free", "tie", "message"),
    [
        ([], {}, "no parameter given"),
        (["rayleigh_scatering"], {}, "did you mean 'rayleigh_scattering'"),
        (["wavelengths"], {}, "cannot be free"),
        (["mie_phase"], {}, "cannot be free"),
        (["mie_g", "mie_g"], {}, "given twice"),
        ("mie_g", {}, "expected a list"),
        (["mie_g"], {"ozone_absorption": "start"}, "not among the free"),
        (["mie_g"], {"mie_g": "start"}, "mie_g cannot be 'start'"),
        (["mie_scattering"], {"mie_scattering": "gray"}, "unknown; ties are start, grey"),
        (["mie_scattering"], {"mie_scattering": "dobson"}, "which is for ozone_absorption"),
        (["mie_absorption"], {"mie": "angstrom"}, "needs mie_scattering"),
        (["mie_scattering"], {"mie": "angstrom", "mie_scattering": "grey"}, "already"),
        (["bottom_radius", "top_radius"], {}, "bound each other"),
    ],
)
def test_refuses(free, tie, message):
    with pytest.raises(FitError, match=message):
        select(toy_sky.truth(), free, tie)


@pytest.mark.parametrize(
    ("zero", "tie", "message"),
    [
        ("ozone_absorption", {"ozone_absorption": "start"}, "starts at zero at every wavelength"),
        ("mie_scattering", {"mie": "angstrom"}, "needs an aerosol to start from"),
    ],
)
def test_refuses_a_shape_of_nothing(zero, tie, message):
    clear = toy_sky.change(toy_sky.truth(), **{zero: 0.0, "mie_absorption": 0.0})
    with pytest.raises(FitError, match=message):
        select(clear, [zero], tie)
