"""Priors: residuals of their own, the share of the images, and the numbers of the named ones."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky
from toy_sky import Toy

from diffatmo import bands, earth, spectrum
from fitting import FitError, Prior, fit, priors
from fitting.nuisances import EACH
from fitting.parameters import select
from fitting.tables import doubts, notes

AIR = select(earth(), ["rayleigh_scattering", "rayleigh_scale_height"])
FEW = ["rayleigh_scattering", "mie_scattering", "mie_g", "mie_scale_height"]


def found(*given, **options):
    settings = {"init": toy_sky.start(1.1, 0.75), "free": FEW, "model": Toy()} | options
    init = toy_sky.change(settings["init"], mie_absorption=0.444e-3, ozone_absorption=[0.7e-3, 1.9e-3, 0.1e-3])
    return fit(toy_sky.observations(), **(settings | {"init": init}), priors=given)


def test_a_vague_prior_changes_nothing():
    plain, vague = found(), found(Prior("mie_g", 0.1, 1e3))
    for ours, theirs in zip(vague.parameters, plain.parameters, strict=True):
        assert ours.value == pytest.approx(theirs.value, abs=0.1 * theirs.standard_error)
        assert ours.standard_error == pytest.approx(theirs.standard_error, rel=0.01)
        assert ours.data_share == pytest.approx(1, abs=1e-4)


def test_two_normal_distributions_are_combined():
    """A linear fit and a prior of the same width meet in the middle, with half the variance, and share the precision."""
    plain = found().estimate("mie_g")
    away = plain.value + plain.standard_error
    both = found(Prior("mie_g", away, plain.standard_error)).estimate("mie_g")
    # The step is one standard error: what is not linear, and the tolerance of the fit, are a tenth of it.
    assert both.value == pytest.approx(plain.value + plain.standard_error / 2, abs=0.15 * plain.standard_error)
    assert both.standard_error == pytest.approx(plain.standard_error / np.sqrt(2), rel=0.02)
    assert both.data_share == pytest.approx(0.5, abs=0.02)


def test_one_prior_needs_no_list_and_several_may_be_drawn_from_anything(tmp_path):
    known = Prior("mie_g", 0.7, 0.01)
    said = {"init": toy_sky.truth(), "free": FEW, "model": Toy()}
    alone = fit(toy_sky.observations(), priors=known, **said)
    drawn = fit(toy_sky.observations(), priors=(p for p in [known]), checkpoint=tmp_path / "checkpoint.npz", **said)
    assert alone.priors == drawn.priors == [known]
    np.testing.assert_array_equal(alone.covariance, drawn.covariance)


def test_a_sharp_prior_holds_a_number_and_owns_it():
    held = found(Prior("mie_scale_height", 1.0, 1e-6, relative=True))
    assert held.converged
    height = held.estimate("mie_scale_height")
    assert height.value == pytest.approx(1.0, rel=1e-4)
    assert height.standard_error == pytest.approx(1e-6, rel=0.05)
    assert height.data_share < 1e-3
    # The optical depth is the images' own all the same.
    assert held.estimate("rayleigh_optical_depth_550").data_share > 0.9


def test_large_residuals_do_not_loosen_a_prior():
    """The images' part of the error is three times as large, that of the prior stays."""
    prior = Prior("mie_scale_height", 1.2, 1e-3)
    images = toy_sky.observations(noise=0.03, stated=0.01)
    result = fit(images, init=toy_sky.truth(), free=FEW, model=Toy(), priors=[prior])
    assert result.error_scale == pytest.approx(3, rel=0.05)
    assert result.estimate("mie_scale_height").standard_error == pytest.approx(1e-3, rel=0.02)


@pytest.mark.parametrize("loss", [None, "huber"])
def test_understated_noise_does_not_overrule_what_is_known(loss):
    """Noise stated ten times too small leads to the fit of the noise as it is, with its errors."""
    of = toy_sky.truth()
    known = [Prior("mie_scale_height", 1.17, 0.05), Prior("mie_g", 0.801, 0.001)]
    honest, bold = (
        fit(
            toy_sky.observations(noise=0.03, stated=stated, sun_offset="free"),
            init=of, free=FEW, model=Toy(), priors=known, loss=loss,
        )
        for stated in (0.03, 0.003)
    )  # fmt: skip
    assert bold.error_scale == pytest.approx(10 * honest.error_scale, rel=0.1)
    assert honest.estimate("mie_scale_height").data_share == pytest.approx(0.5, abs=0.45)
    for ours, theirs in zip(bold.estimates, honest.estimates, strict=True):
        # Both searches end within a tenth of a standard error of the optimum.
        assert ours.value == pytest.approx(theirs.value, abs=0.2 * theirs.standard_error), ours.name
        assert ours.standard_error == pytest.approx(theirs.standard_error, rel=0.1), ours.name


def test_a_spectral_prior_is_one_for_each_wavelength():
    parameters = select(toy_sky.truth(), FEW)
    known = priors.collect([Prior("rayleigh_optical_depth", 0.1, 0.01)], parameters)
    depth = toy_sky.truth().rayleigh_optical_depth
    off = known.residuals(parameters.atmosphere(parameters.start))
    np.testing.assert_allclose(off, (depth - 0.1) / 0.01, rtol=1e-4)
    one = priors.collect([Prior("rayleigh_optical_depth_440", 0.1, 0.01)], parameters)
    np.testing.assert_allclose(one.residuals(toy_sky.truth()), (depth[2:] - 0.1) / 0.01, rtol=1e-4)


def test_molecular_prior_is_the_mass_of_the_air():
    """Optical depth at 550 nm of the standard atmosphere: 0.0973 (Bodhaine et al. 1999, table 5: 0.09717 at 45° N)."""
    stated = {prior.name: prior for prior in priors.molecular(AIR)}
    assert stated["rayleigh_optical_depth_550"].value == pytest.approx(0.0972, rel=0.005)
    assert stated["rayleigh_scale_height"].value == pytest.approx(8.43, abs=0.01)
    high = {prior.name: prior for prior in priors.molecular(AIR, pressure_hpa=500.0)}
    assert high["rayleigh_optical_depth_440"].value / stated["rayleigh_optical_depth_440"].value == pytest.approx(
        500 / 1013.25, rel=1e-6
    )


def test_tied_air_is_known_once():
    """Three errors of 0.5 % of one number would make it known to 0.3 %; and λ⁻⁴ is not quite the spectrum of air."""
    free = ["rayleigh_scattering", "rayleigh_scale_height"]
    bodhaine = toy_sky.change(earth(), rayleigh_scattering=spectrum.rayleigh_scattering(earth().wavelengths))
    known = lambda tie: priors.molecular(select(bodhaine, free, {"rayleigh_scattering": tie}))
    exact, power = known("start"), known("lambda^-4")
    assert [prior.name for prior in exact] == ["rayleigh_optical_depth_550", "rayleigh_scale_height"]
    assert exact[0].error == pytest.approx(0.005, rel=1e-3)
    # King's factor and the refractive index: 1.4 and -2.4 % at 680 and 440 nm where 550 nm agrees.
    assert power[0].error == pytest.approx(np.hypot(0.005, np.std([0.014, 0, -0.024])), rel=0.05)


def test_a_prior_on_a_tied_field_counts_once():
    tied = select(earth(), ["mie_scattering"], {"mie_scattering": "grey"})
    assert priors.collect([Prior("mie_scattering", 4e-3, 1e-5)], tied).value.shape == (1,)
    assert priors.collect([Prior("mie_scattering", 4e-3, 1e-5)], select(earth(), ["mie_scattering"])).value.shape == (
        3,
    )


@pytest.mark.parametrize(
    ("field", "free", "tie"),
    [
        ("mie_optical_depth", ["mie_scattering"], {"mie_scattering": "start"}),
        ("mie_single_scattering_albedo", ["mie_scattering"], {"mie_scattering": "start"}),
        ("mie_single_scattering_albedo", ["mie_scattering", "mie_absorption"], {"mie": "angstrom"}),
        ("mie_optical_depth", ["mie_scale_height"], {}),
        ("rayleigh_optical_depth", ["rayleigh_scale_height"], {}),
    ],
)
def test_what_varies_as_one_number_counts_once(field, free, tie):
    assert priors.collect([Prior(field, 0.5, 0.1)], select(earth(), free, tie)).value.shape == (1,)


def test_two_numbers_are_not_one():
    """An amount and an exponent make three optical depths, of which each says something of its own."""
    tied = select(earth(), ["mie_scattering"], {"mie": "angstrom"})
    assert priors.collect([Prior("mie_optical_depth", 0.1, 0.01)], tied).value.shape == (3,)
    air = select(earth(), ["rayleigh_scale_height"])
    assert [prior.name for prior in priors.molecular(air)] == ["rayleigh_optical_depth_550", "rayleigh_scale_height"]


def test_ozone_climatology():
    """About 260 DU at the equator, a maximum in spring at high latitudes of either hemisphere (Van Heuklon 1979, fig. 3)."""
    # The example that comes with the MLML toolbox of Broenkow & Flora (1997): 321.2 DU at 36° N 122° W on day 185.
    example = priors.ozone(latitude_deg=36.0, longitude_deg=-122.0, day_of_year=185)[0]
    assert example.value == pytest.approx(321.2, abs=0.05)
    of = lambda latitude, day: priors.ozone(latitude_deg=latitude, longitude_deg=0.0, day_of_year=day)[0].value
    assert of(0.0, 100) == pytest.approx(235)
    assert of(65.0, 90) > 400 > of(65.0, 280)
    assert of(-60.0, 280) > of(-60.0, 90)


def test_aerosol_types_speak_of_what_varies():
    tied = select(earth(), ["mie_scattering", "mie_absorption", "mie_g"], {"mie": "angstrom"})
    assert {p.name for p in priors.aerosol("urban", tied)} == {
        "mie_single_scattering_albedo_550",
        "mie_g",
        "mie_angstrom_exponent",
    }
    apart = select(earth(), ["mie_scattering", "mie_absorption", "mie_g"])
    assert {p.name for p in priors.aerosol("urban", apart)} == {"mie_single_scattering_albedo", "mie_g"}
    assert [p.name for p in priors.aerosol("desert", select(earth(), ["mie_g"]))] == ["mie_g"]


def test_what_is_one_number_is_known_once():
    """A ground of one factor and one albedo of the aerosol are told once, to the error they are known to, not for each band."""
    free = ["mie_scattering", "mie_absorption", "ground_albedo"]
    errors = lambda tie: {p.name: p.error for p in priors.typical(select(earth(), free, tie))}
    tied = errors({"mie": "angstrom", "ground_albedo": "start"})
    assert tied["ground_albedo_550"] == errors({})["ground_albedo"] == 0.7
    # Standard deviation of the ten types of Hess et al. 1998, table 4.
    assert tied["mie_single_scattering_albedo_550"] == pytest.approx(0.0595, abs=1e-4)
    assert "ground_albedo" not in tied


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (("mie_g", 0.7, 0.0), "error > 0"),
        (("mie_g", float("nan"), 0.1), "finite value"),
        (("mie_g", 1e39, 1.0), "value up to 1e\\+15"),
        (("mie_g", 0.7, 1e-45), "error from 1e-15"),
        (("mie_g", -0.1, 0.1, True), "relative error needs a value > 0"),
        (("mie_g", "0.7", 0.1), "mie_g: value: got '0.7', expected a number"),
        (("mie_g", 0.7, None), "mie_g: error: got None, expected a number"),
        ((5, 0.7, 0.1), "got the name 5"),
    ],
)
def test_what_is_no_prior_is_refused(prior, message):
    with pytest.raises(FitError, match=message):
        Prior(*prior)


@pytest.mark.parametrize("name", ["ozone_column", "mie_gg"])
def test_a_prior_on_what_does_not_vary_is_refused(name):
    with pytest.raises(FitError, match=f"'{name}' does not vary in this fit"):
        priors.collect([Prior(name, 0.7, 0.1)], select(toy_sky.truth(), FEW))


def test_refuses_unphysical_weather():
    with pytest.raises(FitError, match="pressure_hpa"):
        priors.molecular(AIR, pressure_hpa=-1.0)
    with pytest.raises(FitError, match="temperature_k: got 'cold'"):
        priors.molecular(AIR, temperature_k="cold")
    with pytest.raises(FitError, match="latitude 100"):
        priors.ozone(latitude_deg=100, longitude_deg=0, day_of_year=1)
    with pytest.raises(FitError, match="continental average"):
        priors.aerosol("smog", select(earth(), ["mie_g"]))


def test_a_number_at_zero_has_a_finite_prior():
    dark = toy_sky.change(toy_sky.truth(), mie_absorption=0.0)
    parameters = select(dark, ["mie_absorption"])
    known = priors.collect([Prior("mie_absorption", 1e-3, 0.5, relative=True)], parameters)
    assert np.all(np.isfinite(known.residuals(parameters.atmosphere(jnp.zeros(3)))))


def test_priors_make_the_undetermined_determined():
    """Exposure and the sun's irradiance cannot be told apart, unless one of them is known."""
    images = toy_sky.observations(exposure=("camera",) * 3)
    options = {"init": toy_sky.truth(), "free": ["solar_irradiance", "mie_g"], "model": Toy()}
    tie = {"solar_irradiance": "start"}
    assert fit(images, **options, tie=tie).undetermined
    sun = Prior("solar_irradiance_550", 1.0, 0.01)
    known = fit(images, **options, tie=tie, priors=[sun])
    assert not known.undetermined
    assert known.estimate("exposure_camera").standard_error == pytest.approx(0.01, rel=0.05)
    assert known.estimate("solar_irradiance_680").data_share < 1e-3
    assert known.estimate("mie_g").data_share == pytest.approx(1, abs=1e-3)


def test_what_contradicts_what_was_known_is_said():
    """The χ² of the priors: one in a hundred exceeds 11.3 with three degrees of freedom."""
    result = toy_sky.result()
    of = lambda name: result.estimate(name).value
    near = [
        Prior("mie_g", of("mie_g") + 0.1, 0.1),
        Prior("mie_scale_height", 1.01 * of("mie_scale_height"), 0.01, True),
    ]
    assert doubts(dataclasses.replace(result, priors=near)) == []
    assert doubts(dataclasses.replace(result, priors=[])) == []
    grey = dataclasses.replace(result, priors=[*near, Prior("ground_albedo", of("ground_albedo_550") - 0.03, 0.01)])
    (said,) = doubts(grey)
    assert "above all ground_albedo_" in said
    assert "standard errors)" in said
    assert notes(grey)[0] == said
    far = dataclasses.replace(result, priors=[*near, Prior("mie_scale_height", 2 * of("mie_scale_height"), 0.1, True)])
    (said,) = doubts(far)
    # ln 2 / 0.1, squared, and 1 for each of the others.
    assert f"χ² = {(np.log(2) / 0.1) ** 2 + 2:.0f} of 3 numbers, above all mie_scale_height = " in said
    assert "6.9 standard errors" in said


def test_offsets_of_an_image_count_too():
    """Of the camera as well: the heading has an error of its own."""
    number = lambda name, value: dataclasses.replace(toy_sky.result().parameters[0], name=name, field=name, value=value)
    nuisances = [number("pose_a_east_deg", 2.0), number("pose_a_up_deg", 20.0), number("chroma_a_saturation", 0.1)]
    known = [Prior("pose_deg", 0.0, 2.0, False, EACH), Prior("pose_up_deg", 0.0, 10.0, False, EACH)]
    found = dataclasses.replace(toy_sky.result(), nuisances=nuisances, priors=known)
    assert doubts(found) == []
    (said,) = doubts(dataclasses.replace(found, priors=[*known, Prior("chroma", 0.0, 0.02, False, EACH)]))
    assert "χ² = 30 of 3 numbers, above all chroma_a_saturation = " in said


def test_residuals_beyond_those_of_clear_skies_are_said():
    """Only of a photo, whose noise is that of few independent numbers: 1 / 0.8 - 1 = 25 %, and 1.48 times that if normal."""
    result = toy_sky.result()
    off = lambda factor, seen: dataclasses.replace(
        result, observations=seen, fitted=[factor * np.asarray(image) for image in result.fitted]
    )
    photos = [dataclasses.replace(image, bands=bands.srgb()) for image in result.observations]
    assert doubts(off(1.0, photos)) == doubts(off(0.8, result.observations)) == []
    said = doubts(off(0.8, photos))
    assert [line.split("; clear")[0] for line in said] == [
        f"sun {zenith} differs from what was fitted by 37 %" for zenith in (30, 60, 80)
    ]
