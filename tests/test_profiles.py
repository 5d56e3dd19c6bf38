"""Profile likelihood: a parabola where the problem is linear, and the right interval where it is not."""

import json
from dataclasses import replace

import numpy as np
import pytest
import toy_sky
from pattern_model import Pattern, observation

from fitting import FitError, FitResult, Prior, fit, profile, report
from fitting.tables import notes

LINEAR = {"ground_albedo": "grey", "ozone_absorption": "start"}


def linear(truth=None, **options):
    truth = toy_sky.truth() if truth is None else truth
    said = {key: options.pop(key) for key in ("priors",) if key in options}
    seen = observation(Pattern(), truth, **options)
    return fit([seen], init=toy_sky.truth(), free=list(LINEAR), tie=LINEAR, model=Pattern(), starts=1, **said)


def off_parabola(found):
    """Largest difference of Δχ² from the parabola of the standard error."""
    return np.max(np.abs(found.delta_chi2 - ((found.points - found.value) / found.standard_error) ** 2))


@pytest.mark.parametrize("options", [{}, {"stated": 0.01}, {"priors": [Prior("ground_albedo_550", 0.31, 0.002)]}])
def test_linear_problem_has_the_parabola_of_its_covariance(options):
    """Also with residuals twice the noise, and with a prior about as sharp as the images: neither is counted twice."""
    result = profile(linear(**options), "ground_albedo_550", "ozone_absorption_550")
    assert abs(result.fitted_correlation[1][0, -1]) > 0.3
    for found in result.profiles:
        assert off_parabola(found) < 0.02
        assert found.settled.all()
        assert not found.differs
        low, high = found.interval()
        assert (high - low) / 2 == pytest.approx(found.standard_error, rel=0.01)
        low, high = found.interval(0.95)
        assert (high - low) / 2 == pytest.approx(1.96 * found.standard_error, rel=0.01)


def test_the_parabola_is_missed_if_the_rest_is_not_fitted_again():
    """Held at the optimum, the correlated number makes the parabola narrower by 1 - ρ²: the test above would see it."""
    result = linear()
    correlation = result.correlation[0, result.covariance_names.index("ozone_absorption_550")]
    assert 9 / (1 - correlation**2) - 9 > 50 * 0.02


def test_errors_of_the_model_widen_the_profile_as_they_do_the_error_bar():
    result = linear()
    wider = [replace(e, standard_error=3 * e.standard_error) for e in result.parameters]
    found = profile(replace(result, parameters=wider), "ground_albedo_550").profiles[0]
    assert off_parabola(found) < 0.02


def heights(noise, seed=3):
    truth = toy_sky.change(toy_sky.truth(), mie_scale_height=1.0)
    seen = observation(Pattern(), truth, noise=noise, seed=seed)
    return fit(
        [seen],
        init=truth,
        free=["mie_scale_height", "ground_albedo"],
        tie={"ground_albedo": "grey"},
        model=Pattern(),
        tolerance=0.01,
    )


def test_interval_is_asymmetric_where_the_number_enters_by_its_inverse():
    """The images are linear in u = 1/H, whose error is normal; so the interval of H, and its coverage, is that of u."""
    result = profile(heights(noise=3.0), "mie_scale_height")
    (found,) = result.profiles
    u = 1 / found.value
    sigma = u * found.standard_error / found.value
    assert 0.1 < sigma / u < 0.2
    for level, width in ((0.6827, 1.0), (0.95, 1.96)):
        np.testing.assert_allclose(found.interval(level), [1 / (u + width * sigma), 1 / (u - width * sigma)], rtol=0.01)
    assert found.differs
    low, high = found.interval(0.95)
    assert (high - found.value) > 1.5 * (found.value - low)
    assert "not the" in notes(result)[-2 if "Better known" in notes(result)[-1] else -1]


def test_open_interval_is_said_to_be_open():
    result = profile(heights(noise=5.3, seed=4), "mie_scale_height")
    (found,) = result.profiles
    low, high = found.interval(0.95)
    assert low is not None
    assert high is None
    assert any("open where" in note for note in notes(result))


def test_interval_ends_at_the_bound_of_the_range():
    dark = toy_sky.change(toy_sky.truth(), ground_albedo=1e-3)
    (found,) = profile(linear(dark, noise=0.2, seed=3), "ground_albedo_550").profiles
    assert found.value < 2 * found.standard_error
    assert found.bounded == (True, False)
    assert found.points[0] == 0
    low, high = found.interval(0.95)
    assert low == 0
    assert high > found.value + found.standard_error


def test_a_spectral_field_stands_for_its_numbers():
    result = profile(linear(), "ground_albedo", points=5)
    assert [found.name for found in result.profiles] == [f"ground_albedo_{nm}" for nm in (680, 550, 440)]
    # One factor moves all three.
    np.testing.assert_allclose(result.profiles[0].delta_chi2, result.profiles[2].delta_chi2, atol=0.01)


def test_derived_numbers():
    """An optical depth is a product of two fitted numbers, either of which is known far less well."""
    result = fit(
        toy_sky.observations(), init=toy_sky.truth(), free=["mie_scattering", "mie_scale_height"], model=toy_sky.Toy()
    )
    (found,) = profile(result, "mie_optical_depth_550", points=5).profiles
    assert off_parabola(found) < 0.3


def test_what_cannot_be_profiled_is_refused(tmp_path):
    result = linear()
    with pytest.raises(FitError, match="'mie_g' is no number of this fit; numbers are of ground_albedo"):
        profile(result, "mie_g")
    with pytest.raises(FitError, match="names: got none"):
        profile(result)
    with pytest.raises(FitError, match="points: got 3, expected at least 5"):
        profile(result, "ground_albedo_550", points=3)
    result.save(tmp_path / "fit.npz")
    with pytest.raises(FitError, match="does not know its start, free parameters and model"):
        profile(FitResult.load(tmp_path / "fit.npz"), "ground_albedo_550")
    with pytest.raises(FitError, match="has no profiles"):
        result.plot("profiles")


def test_profile_is_written_saved_and_shown(tmp_path):
    result = profile(linear(), "ground_albedo_550", points=5)
    report.write(result, tmp_path)
    (found,) = json.loads((tmp_path / "fit.json").read_text())["profiles"]
    assert found["name"] == "ground_albedo_550"
    assert len(found["points"]) == len(found["delta_chi2"]) == 5
    np.testing.assert_allclose(found["interval_68"], result.profiles[0].interval())
    assert (tmp_path / "profile_ground_albedo_550.png").read_bytes().startswith(b"\x89PNG")
    assert "Profile likelihood" in (tmp_path / "report.html").read_text()
    again = FitResult.load(tmp_path / "fit.npz").profiles[0]
    assert again.interval(0.95) == result.profiles[0].interval(0.95)
    assert result.plot("profiles").axes
