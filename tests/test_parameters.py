"""Coordinates of the fit: bijections, start values on a bound, colouring, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky

from diffatmo.atmosphere import SPECTRAL
from fitting import FREE_FIELDS, FitError
from fitting.parameters import (
    Linear,
    Log,
    Logit,
    derived_fields,
    numbers,
    quantities,
    select,
)

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


def test_scaled_fields_keep_their_ratios():
    init = toy_sky.truth()
    parameters = select(init, ["ozone_absorption", "mie_g"], scaled=["ozone_absorption"])
    assert parameters.size == 2
    doubled = parameters.atmosphere(parameters.start.at[0].mul(2))
    np.testing.assert_allclose(doubled.ozone_absorption, 2 * init.ozone_absorption, rtol=1e-6)
    # An albedo stays below one at every wavelength.
    albedo = select(toy_sky.change(init, ground_albedo=[0.2, 0.4, 0.1]), ["ground_albedo"], ["ground_albedo"])
    # The bound is a float32 just below 1 over the largest albedo.
    assert float(albedo.limits[1][0]) == pytest.approx(2.5, rel=1e-5)


def test_colours_share_a_tangent_among_wavelengths():
    parameters = select(toy_sky.truth(), ["rayleigh_scattering", "mie_g", "mie_scattering"], scaled=["mie_scattering"])
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
    ("free", "scaled", "message"),
    [
        ([], [], "no parameter given"),
        (["rayleigh_scatering"], [], "did you mean 'rayleigh_scattering'"),
        (["wavelengths"], [], "cannot be free"),
        (["mie_phase"], [], "cannot be free"),
        (["mie_g", "mie_g"], [], "given twice"),
        ("mie_g", [], "expected a list"),
        (["mie_g"], ["ozone_absorption"], "not among the free"),
        (["mie_g"], ["mie_g"], "no wavelengths"),
        (["bottom_radius", "top_radius"], [], "bound each other"),
    ],
)
def test_refuses(free, scaled, message):
    with pytest.raises(FitError, match=message):
        select(toy_sky.truth(), free, scaled)


def test_refuses_to_scale_zeros():
    clear = toy_sky.change(toy_sky.truth(), ozone_absorption=0.0)
    with pytest.raises(FitError, match="starts at zero at every wavelength"):
        select(clear, ["ozone_absorption"], ["ozone_absorption"])
