"""Starts that are far off, and images that more than one atmosphere explains."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky
from pattern_model import Twin, observation
from toy_sky import FREE, Toy, truth

from fitting import FitError, FitResult, Prior, fit, report
from fitting.batch import stack
from fitting.parameters import select
from fitting.passes import OF_FITTED_LIGHT
from fitting.problem import Problem
from fitting.starts import grid, ranked, separation, thinned
from fitting.tables import notes


def wrong(aerosol, rayleigh_height, mie_height, g):
    """The truth, off by these factors, and g by a difference."""
    own = truth()
    return toy_sky.change(
        own,
        mie_scattering=aerosol * own.mie_scattering,
        mie_absorption=aerosol * own.mie_absorption,
        rayleigh_scale_height=rayleigh_height * own.rayleigh_scale_height,
        mie_scale_height=mie_height * own.mie_scale_height,
        mie_g=own.mie_g + g,
    )


def problem(init, images, tie=None):
    batch = stack(images, [680.0, 550.0, 440.0])
    weight = 100 / jnp.maximum(batch.measured, 1e-6) * batch.used[..., None]
    return Problem(Toy(), select(init, FREE, tie), batch, weight)


@pytest.mark.parametrize("tie", [None, {"mie": "angstrom"}])
def test_grid_moves_the_fields_by_their_factors_and_nothing_else(tie):
    parameters = select(truth(), FREE, tie)
    points = grid(parameters)
    assert len({point.tobytes() for point in points}) == len(points) == 81
    np.testing.assert_array_equal(points[0], parameters.start)
    found = set()
    for point in points:
        atmosphere, own = parameters.atmosphere(jnp.asarray(point)), truth()
        factors = [
            float(getattr(atmosphere, name).mean() / getattr(own, name).mean())
            for name in ("mie_scattering", "mie_absorption", "rayleigh_scale_height", "mie_scale_height")
        ]
        found.add(tuple(np.round([*factors, atmosphere.mie_g - own.mie_g], 3)))
        np.testing.assert_allclose(atmosphere.rayleigh_scattering, own.rayleigh_scattering, rtol=1e-5)
    # g = 0.8 + 0.3 is cut off at 0.95.
    three = (1, 0.5, 2)
    assert found == {(a, a, r, m, g) for a in (1, 0.2, 5) for r in three for m in three for g in (0, -0.3, 0.15)}


def test_only_what_is_free_is_tried():
    assert len(grid(select(truth(), ["rayleigh_scattering", "mie_g"]))) == 3
    assert len(grid(select(truth(), ["ozone_absorption"]))) == 1


def test_thinned_batch_has_pixels_of_every_image_that_are_used():
    batch, chosen = thinned(stack(toy_sky.observations(), [680.0, 550.0, 440.0]), 50)
    assert batch.measured.shape == (3, 50, 3)
    assert bool(jnp.all(batch.used))
    assert all(len(set(row)) == 50 for row in chosen)


def test_thinned_batches_of_few_pixels_have_the_same_shape():
    """A program is for one shape: what an image lacks, others of its pixels stand in for."""
    for count in (7, 60):
        mask = np.arange(16 * 64).reshape(16, 64) < count
        batch, chosen = thinned(stack(toy_sky.observations(mask=mask), [680.0, 550.0, 440.0]), 50)
        assert batch.measured.shape == (3, 50, 3)
        assert bool(jnp.all(batch.used))
        assert all(len(set(row)) == min(count, 50) for row in chosen)


@pytest.mark.parametrize("factor", [1, 3])
def test_the_truth_is_the_best_of_the_grid(factor):
    """Also if the exposure is unknown, which is then set for each atmosphere."""
    images = toy_sky.observations(factors=(factor,) * 3, exposure=("fixed" if factor == 1 else "camera",) * 3)
    asked = problem(wrong(5, 2, 2, -0.3), images)
    points = ranked(asked)
    best = asked.parameters.atmosphere(jnp.asarray(points[0]))
    np.testing.assert_allclose(best.mie_scattering, truth().mie_scattering, rtol=1e-4)
    assert best.mie_scale_height == pytest.approx(1.2, rel=1e-4)
    assert best.rayleigh_scale_height == pytest.approx(8.0, rel=1e-4)
    assert best.mie_g == pytest.approx(0.8, abs=1e-4)
    # No two are neighbours.
    assert 10 < len(points) < 60


def test_a_fit_that_goes_astray_begins_anew():
    said = {"free": FREE, "model": Toy()}
    images, start = toy_sky.observations(), wrong(0.2, 2, 0.5, -0.3)
    lost = fit(images, init=start, starts=1, max_steps=45, **said)
    assert not lost.converged
    assert lost.reduced_chi2 > 2
    found = fit(images, init=start, **said)
    assert found.converged
    assert found.message.endswith("times as large")
    assert "from one of 1 other starts" in found.message
    right = toy_sky.result()
    assert found.chi2 == pytest.approx(right.chi2, abs=1)
    for estimate in right.parameters:
        assert found.estimate(estimate.name).value == pytest.approx(estimate.value, abs=0.7 * estimate.standard_error)


@pytest.mark.parametrize(
    ("loss", "number", "aim"),
    [(None, 20, ""), (None, 41, "from another start"), ("tukey", 42, "")],
    ids=["at its own start", "at another", "in a later stage"],
)
def test_killed_before_its_last_pass_it_goes_on_where_it_was(loss, number, aim, tmp_path):
    """Two steps at most are made twice: one of the given start's search, one of another's."""

    class Killed(Exception):
        pass

    def kill(step):
        if step.step == number and file.exists():
            assert step.aim == aim
            raise Killed

    said = {"init": wrong(0.2, 2, 0.5, -0.3), "free": FREE, "model": Toy(), "loss": loss}
    found = fit(toy_sky.observations(), **said)
    file = tmp_path / "checkpoint.npz"
    with pytest.raises(Killed):
        fit(toy_sky.observations(), checkpoint=file, progress=kill, **said)
    resumed = fit(toy_sky.observations(), checkpoint=file, **said)
    assert "from one of 1 other starts" in resumed.message
    assert resumed.message.split(";")[1] == found.message.split(";")[1]
    assert len(resumed.history) <= len(found.history) + 2
    np.testing.assert_allclose(
        [estimate.value for estimate in resumed.parameters],
        [estimate.value for estimate in found.parameters],
        atol=0.1 * max(estimate.standard_error for estimate in found.parameters),
    )


def test_killed_twice_at_its_other_starts_it_knows_both(tmp_path):
    """The first of two is looked at again after the first kill, which is no reason to forget the second."""

    class Killed(Exception):
        pass

    aside = []

    def kill(step):
        if step.aim == "from another start":
            aside.append(step.stage)
            # In the second of the searches, then at the first step after that.
            if len(set(aside)) == 2:
                raise Killed

    file = tmp_path / "checkpoint.npz"
    points = []
    for _ in range(2):
        with pytest.raises(Killed):
            twins(0.0, 3, checkpoint=file, progress=kill)
        with np.load(file) as archive:
            points.append(json.loads(archive["record"].tobytes())["others"][-1])
        aside = [0]
    first, second = (np.ravel(underway) for underway in points)
    assert len(first) == len(second) == 2
    assert abs(first[0] - first[1]) > 0.1
    np.testing.assert_allclose(second, first, atol=0.1)
    found = twins(0.0, 3, checkpoint=file)
    assert sorted(minimum.values["mie_g"] for minimum in found.minima) == pytest.approx([-0.5, 0.5], abs=0.01)


def test_a_fit_that_does_not_go_astray_costs_nothing_more():
    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), starts=1)
    assert [step.chi2 for step in found.history] == [step.chi2 for step in toy_sky.result().history]


def twins(tilt, starts, stated=None, seed=0, **options):
    model = Twin(tilt)
    seen = observation(model, toy_sky.change(truth(), mie_g=0.5), stated=stated, seed=seed)
    init = toy_sky.change(truth(), mie_g=0.2)
    return fit([seen], init=init, free=["mie_g"], model=model, starts=starts, **options)


def test_two_minima_are_reported(tmp_path):
    found = twins(0.0, starts=3)
    assert found.converged
    assert sorted(minimum.values["mie_g"] for minimum in found.minima) == pytest.approx([-0.5, 0.5], abs=0.01)
    assert found.minima[1].chi2 == pytest.approx(found.minima[0].chi2, rel=1e-4)
    assert found.minima[0].values["mie_g"] == pytest.approx(found.estimate("mie_g").value)
    (note,) = [note for note in notes(found) if "minima" in note]
    assert note.startswith("There are 2 minima")
    assert f"mie_g = {found.minima[1].values['mie_g']:.4g}" in note
    assert report.record(found)["minima"][1]["values"]["mie_g"] == found.minima[1].values["mie_g"]
    found.save(tmp_path / "fit.npz")
    assert FitResult.load(tmp_path / "fit.npz").minima == found.minima


@pytest.mark.parametrize("aim", [OF_FITTED_LIGHT, "the other minimum"])
def test_a_fit_killed_in_its_last_pass_still_knows_its_other_minimum(aim, tmp_path):
    class Killed(Exception):
        pass

    def kill(step):
        if step.aim == aim:
            raise Killed

    with pytest.raises(Killed):
        twins(0.0, starts=3, checkpoint=tmp_path / "checkpoint.npz", progress=kill)
    seen = []
    found = twins(0.0, starts=3, checkpoint=tmp_path / "checkpoint.npz", progress=seen.append)
    assert found.converged
    assert len(seen) < 5
    assert sorted(minimum.values["mie_g"] for minimum in found.minima) == pytest.approx([-0.5, 0.5], abs=0.01)


@pytest.mark.parametrize("seed", [0, 10])
def test_minima_compare_by_the_same_noise(tmp_path, seed):
    """Noise understated by four, and a prior that is weighed against what the residuals show: all is even in g, and so is χ².

    Seed 10 ends in the other minimum; killed after that it has both as well.
    """
    settings = {"stated": 0.005, "seed": seed, "priors": [Prior("mie_g", 0.0, 0.02)]}
    found = twins(0.0, 3, **settings)
    one, other = found.minima
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-4)
    assert one.values["mie_g"] == pytest.approx(-other.values["mie_g"], abs=1e-4)

    class Killed(Exception):
        pass

    def kill(step):
        if step.aim.startswith("what is known"):
            raise Killed

    with pytest.raises(Killed):
        twins(0.0, 3, checkpoint=tmp_path / "checkpoint.npz", progress=kill, **settings)
    resumed = twins(0.0, 3, checkpoint=tmp_path / "checkpoint.npz", **settings)
    assert sorted(m.values["mie_g"] for m in resumed.minima) == pytest.approx(
        sorted(m.values["mie_g"] for m in found.minima), abs=1e-3
    )


def test_a_fit_that_goes_on_has_the_steps_that_its_other_starts_had(tmp_path):
    class Killed(Exception):
        pass

    def kill(step):
        if step.aim == OF_FITTED_LIGHT:
            raise Killed

    file = tmp_path / "checkpoint.npz"
    with pytest.raises(Killed):
        twins(0.0, 3, checkpoint=file, progress=kill, max_steps=8)
    found = twins(0.0, 3, checkpoint=file, max_steps=8)
    assert len(found.history) > 8
    assert found.converged


def test_one_minimum_found_twice_is_one():
    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), starts=3)
    assert found.converged
    assert found.minima == []
    assert max(step.stage for step in found.history) == 4


def test_separation_is_in_standard_errors():
    slope = np.array([[2.0, 1.0], [0.0, 3.0]])
    factor = np.pad(slope, ((0, 1), (0, 1)))
    covariance = np.linalg.inv(slope.T @ slope)
    step = np.array([0.3, -0.2])
    expected = np.sqrt(step @ np.linalg.solve(covariance, step))
    assert separation(step, 0 * step, (factor, 2 * factor), 1.0) == pytest.approx(expected)
    assert separation(step, 0 * step, (factor,), 4.0) == pytest.approx(expected / 2)


def test_number_of_starts_is_checked():
    with pytest.raises(FitError, match="starts: got 0, expected at least 1"):
        fit(toy_sky.observations(), init=truth(), free=FREE, model=Toy(), starts=0)
