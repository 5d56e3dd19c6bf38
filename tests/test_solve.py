"""The search: it finds the optimum from far off, respects bounds, and when it cannot converge it says so."""

import dataclasses
import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import toy_sky
from toy_sky import FREE, Hasty, Toy

from diffatmo.models.base import Ray
from fitting import FitError, evaluation, fit, model_error, passes, profile, tables
from fitting.search import Step, distance, steps_left
from fitting.solve import solve


@pytest.mark.parametrize(("factor", "g"), [(1.3, 0.6), (0.7, 0.9)])
def test_converges_from_thirty_percent_off(factor, g):
    found = fit(toy_sky.observations(noise=0.01), init=toy_sky.start(factor, g), free=FREE, model=Toy())
    assert found.converged
    assert found.iterations < 20
    # 9216 residuals: reduced χ² is known to 1.5 %.
    assert found.reduced_chi2 == pytest.approx(1, abs=0.06)
    for estimate in found.with_truth(toy_sky.truth()).parameters:
        assert abs(estimate.pull) < 5, estimate


def test_without_noise_the_truth_comes_back():
    found = fit(toy_sky.observations(noise=0.0), init=toy_sky.start(), free=FREE, model=Toy(), tolerance=1e-3)
    assert found.converged
    for estimate in found.with_truth(toy_sky.truth()).parameters:
        # A float32 residual is good to 1e-4 sigma.
        assert abs(estimate.pull) < 1e-2, estimate


def test_starts_at_zero_and_finds_what_is_there():
    init = toy_sky.change(toy_sky.start(), mie_absorption=0.0, ozone_absorption=0.0, ground_albedo=0.0)
    found = fit(toy_sky.observations(), init=init, free=FREE, model=Toy())
    assert found.converged
    assert found.chi2 == pytest.approx(toy_sky.result().chi2, abs=0.1)


def test_a_true_zero_is_reached_and_marked():
    # With as little as that, noise alone puts the optimum of some wavelengths below zero.
    truth = toy_sky.change(toy_sky.truth(), mie_absorption=0.0, ozone_absorption=0.0)
    images = toy_sky.observations(atmosphere=truth)
    found = fit(images, init=toy_sky.start(), free=FREE, model=Toy()).with_truth(truth)
    assert found.converged
    held = [e for e in found.parameters if e.at_bound]
    assert held
    assert {e.field for e in held} <= {"mie_absorption", "ozone_absorption"}
    assert all(e.value == 0 for e in held)
    assert all(abs(e.pull) < 5 for e in found.parameters if e.pull is not None)


def test_weights_from_noisy_pixels_would_bias():
    """With sigma from the measured pixel the amplitude comes out low by 2 noise²: 2 %, many times its error."""
    images = toy_sky.observations(noise=0.1)
    found = solve(
        images, init=toy_sky.truth(), free=["solar_irradiance"], tie={"solar_irradiance": "start"}, model=Toy()
    )
    first = max(step.step for step in found.history if step.stage == 1)
    assert first < len(found.history) - 1
    amplitude = float(found.parameters.atmosphere(found.y).solar_irradiance[0])
    assert amplitude == pytest.approx(1, abs=4 * 0.1 / np.sqrt(found.residual_count))
    # What the first pass found, from the linearisation at the last point: measured weights.
    d, e = (np.concatenate([x[o.used].ravel() for x, o in zip(xs, images, strict=True)]) for xs in _pairs(images))
    assert np.sum(e / d) / np.sum(e**2 / d**2) == pytest.approx(1 - 2 * 0.1**2, abs=0.006)


def _pairs(images):
    return [o.image for o in images], [toy_sky.image(toy_sky.truth(), float(o.name.split()[1])) for o in images]


def test_free_exposures_are_recovered():
    images = toy_sky.observations(factors=(20.0, 0.05, 0.05), exposure=("free", "lens", "lens"))
    free = ["mie_g", "mie_scattering", "ground_albedo"]
    init = toy_sky.change(toy_sky.truth(), mie_g=0.6, mie_scattering=6e-3, ground_albedo=0.0)
    found = fit(images, init=init, free=free, model=Toy())
    assert found.converged
    assert [e.name for e in found.nuisances] == ["exposure_sun 30", "exposure_lens"]
    for estimate, factor in zip(found.nuisances, (20.0, 0.05), strict=True):
        assert abs(estimate.value - factor) < 5 * estimate.standard_error
        assert estimate.standard_error < 0.01 * factor


def test_exposures_and_a_shared_white_balance_are_recovered():
    """Of every image its own exposure, of all one lens: three factors and two, besides the atmosphere."""
    images = toy_sky.observations(factors=(20.0, 0.05, 1.0), exposure=("free",) * 3, white_balance="lens")
    for image in images:
        image.image[:] *= np.array([1.5, 1.0, 0.7], np.float32)
    free = ["mie_g", "mie_scattering"]
    found = fit(images, init=toy_sky.start(1.0, 0.6), free=free, tie={"mie_scattering": "grey"}, model=Toy())
    assert found.converged
    red, blue = (found.estimate(f"white_balance_lens_{nm}") for nm in (680, 440))
    for estimate, factor in ((red, 1.5), (blue, 0.7), (found.estimate("exposure_sun 60"), 0.05)):
        assert abs(estimate.value - factor) < 4 * estimate.standard_error
        assert estimate.standard_error < 0.01 * factor
    assert abs(found.estimate("mie_g").value - 0.8) < 4 * found.estimate("mie_g").standard_error


def test_out_of_steps_returns_the_best_point():
    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), max_steps=3)
    assert not found.converged
    assert "not converged in the steps allowed" in found.message
    accepted = [step.chi2 for step in found.history if step.accepted and step.stage == found.history[-1].stage]
    assert found.chi2 == pytest.approx(min(accepted))
    assert np.all(np.isfinite([e.value for e in found.parameters]))


def test_an_interrupt_returns_the_best_point():
    def stop(step):
        if step.step == 2:
            raise KeyboardInterrupt

    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), progress=stop)
    assert not found.converged
    assert found.message == "interrupted by the user"
    assert found.chi2 < found.history[0].chi2


def test_progress_sees_every_step():
    seen = []
    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Toy(), progress=seen.append)
    assert seen == found.history
    assert [step.step for step in seen] == list(range(len(seen)))
    assert seen[-1].distance < 0.1


def test_a_fit_goes_on_from_its_checkpoint(tmp_path):
    """Killed after any step, it needs no more steps in all than one more, and finds the same."""
    whole, file = toy_sky.result(), tmp_path / "checkpoint.npz"
    settings = {"init": toy_sky.start(), "free": FREE, "model": Toy(), "checkpoint": str(file)}

    class Killed(Exception):
        pass

    for last in (0, 3, whole.history[-1].step):

        def kill(step, last=last):
            if step.step == last:
                raise Killed

        file.unlink(missing_ok=True)
        with pytest.raises(Killed):
            fit(toy_sky.observations(), **settings, progress=kill)
        seen = []
        found = fit(toy_sky.observations(), **settings, progress=seen.append)
        assert found.converged
        assert seen[0].step == last + 1
        assert found.history[: last + 1] == found.history[: len(found.history) - len(seen)]
        # The point where it was is evaluated once more, and the damping found anew.
        assert len(found.history) <= len(whole.history) + 4
        for ours, best in zip(found.parameters, whole.parameters, strict=True):
            assert ours.value == pytest.approx(best.value, abs=0.1 * best.standard_error)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    file = tmp_path / "checkpoint.npz"
    settings = {"init": toy_sky.start(), "model": Toy(), "checkpoint": file}
    fit(toy_sky.observations(), free=["mie_g"], **settings)
    for images, free in ((toy_sky.observations(), ["mie_scattering"]), (toy_sky.observations(seed=1), ["mie_g"])):
        with pytest.raises(FitError, match="belongs to a fit of other images or options"):
            fit(images, free=free, **settings)
    with np.load(file) as archive:
        y, record = archive["y"], json.loads(archive["record"].tobytes())
    del record["others"]
    np.savez(file, y=y, record=np.frombuffer(json.dumps(record).encode(), np.uint8))
    with pytest.raises(FitError, match="written by another version"):
        fit(toy_sky.observations(), free=["mie_g"], **settings)
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(FitError, match="not a checkpoint of a fit"):
        fit(toy_sky.observations(), free=["mie_g"], **settings)


def test_a_full_disk_does_not_stop_a_fit(tmp_path):
    settings = {"init": toy_sky.start(), "free": ["mie_g"], "model": Toy()}
    with pytest.warns(UserWarning, match="goes on without a checkpoint"):
        found = fit(toy_sky.observations(), **settings, checkpoint=tmp_path / "gone" / "checkpoint.npz")
    assert found.iterations > 1


class Cliff(Toy):
    """A model that has no answer for forward peaks sharper than 0.95."""

    def sky(self, atmosphere):
        return _CliffSky(atmosphere)


class _CliffSky(toy_sky.ToySky):
    def radiance(self, *, altitude, view, sun):
        ray = super().radiance(altitude=altitude, view=view, sun=sun)
        return Ray(jnp.where(self.atmosphere.mie_g > 0.95, jnp.nan, ray.radiance), ray.transmittance)


def test_a_model_that_fails_on_the_way_is_walked_around():
    # From this start the first full step leads over the edge.
    found = fit(toy_sky.observations(), init=toy_sky.start(0.5, 0.5), free=FREE, model=Cliff())
    assert any(not np.isfinite(step.chi2) for step in found.history)
    assert found.converged
    assert found.estimate("mie_g").value == pytest.approx(0.8, abs=0.002)


def test_a_model_that_fails_at_the_start_is_an_error():
    with pytest.raises(FitError, match=r"^sun 30: the model's radiance at the start: not finite in \d+ of"):
        fit(toy_sky.observations(), init=toy_sky.start(1.0, 0.97), free=FREE, model=Cliff())


def test_refuses():
    images = toy_sky.observations()
    for options, message in [
        ({"max_steps": 0}, "max_steps"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": float("inf")}, "tolerance: got inf, expected a finite number"),
        ({"starts": 1.5}, "starts: got 1.5, expected at least 1, and a whole number"),
        ({"observations": images[0].image}, r"observations: got ndarray, expected fitting.observe\(...\)"),
        ({"priors": {"mie_g": 0.7}}, r"priors: got str, expected fitting.Prior\(name, value, error\)"),
        ({"priors": None}, "priors: got NoneType, expected"),
        ({"free": None}, "free: got NoneType, expected a list of names"),
        ({"free": ["nothing"]}, "'nothing' cannot be free"),
        ({"init": "earth"}, "init: got 'earth', expected an Atmosphere"),
        ({"max_steps": 2.5}, "max_steps: got 2.5, expected at least 1, and a whole number"),
        ({"tolerance": "fine"}, "tolerance: got 'fine', expected a finite number"),
        ({"refine": "no"}, "refine: got 'no', expected True or False"),
        ({"progress": 5}, "progress: got 5, expected a function"),
        ({"checkpoint": 5}, "checkpoint: got 5, expected the path"),
        ({"devices": "cpu"}, r"devices: got 'cpu', expected some of jax.devices\(\)"),
        ({"devices": []}, r"devices: got \[\]"),
        ({"tie": "grey"}, "tie: got 'grey', expected a kind for each name"),
        ({"model": "hillaire"}, "model: got 'hillaire', expected a model"),
    ]:
        with pytest.raises(FitError, match=message):
            fit(**({"observations": images, "init": toy_sky.start(), "free": ["mie_g"], "model": Toy()} | options))
    one = eqx.tree_at(lambda o: o.used, images[0], images[0].used & (np.arange(16 * 64).reshape(16, 64) == 500))
    with pytest.raises(FitError, match="3 pixels and channels cannot determine"):
        fit([one], init=toy_sky.start(), free=FREE, model=Toy())


def test_distance_is_the_fall_of_chi2_of_a_linear_problem():
    random = np.random.default_rng(0)
    slope, residual = 100 * random.standard_normal((50, 3)), random.standard_normal(50)
    factor = np.linalg.qr(np.column_stack([slope, residual]), mode="r")
    rest = residual - slope @ np.linalg.lstsq(slope, residual)[0]
    fall = residual @ residual - rest @ rest
    # Directions with an error of 1/700 count in full but for its square.
    assert distance(factor) == pytest.approx(np.sqrt(fall), rel=1e-4)
    assert distance(factor, misfit=4.0) == pytest.approx(np.sqrt(fall) / 2, rel=1e-4)


class Crude(Toy):
    """The toy sky with a smooth error of some tenths of a percent, and the toy sky itself as the finer model."""

    def finer(self):
        return Toy()

    def sky(self, atmosphere):
        return CrudeSky(atmosphere)


class CrudeSky(toy_sky.ToySky):
    def radiance(self, *, altitude, view, sun):
        exact = super().radiance(altitude=altitude, view=view, sun=sun)
        wrong = 1 + 0.004 * view[..., 2:] + 0.003 * view[..., :1] * sun[2] + 0.002 * view[..., 1:2] ** 2
        return Ray(exact.radiance * wrong, exact.transmittance)


def test_the_finer_model_removes_the_error_of_the_coarse_one():
    """The bias is many standard errors of the noise; what is left of it is none, and the error bars remember it."""
    images = toy_sky.observations(noise=0.002)
    settings = {"init": toy_sky.start(), "free": FREE, "model": Crude()}
    rough = fit(images, refine=False, **settings).with_truth(toy_sky.truth())
    fine = fit(images, **settings).with_truth(toy_sky.truth())
    exact = fit(images, init=toy_sky.start(), free=FREE, model=Toy())
    assert fine.converged
    assert max(abs(e.pull) for e in rough.parameters) > 10
    assert max(abs(e.pull) for e in fine.parameters) < 3
    for ours, best in zip(fine.parameters, exact.parameters, strict=True):
        assert ours.value == pytest.approx(best.value, abs=0.3 * best.standard_error + 1e-4 * abs(best.value))
        assert ours.standard_error >= best.standard_error * 0.99


def test_model_error_covers_a_fifth_of_the_correction():
    """A finer model with a fifth of the crude one's error left in it is within the error bars, and not without them."""
    images = toy_sky.observations(noise=0.001)

    class LessCrude(Toy):
        def sky(self, atmosphere):
            return LessCrudeSky(atmosphere)

    class LessCrudeSky(toy_sky.ToySky):
        def radiance(self, *, altitude, view, sun):
            exact = super().radiance(altitude=altitude, view=view, sun=sun)
            wrong = CrudeSky(self.atmosphere).radiance(altitude=altitude, view=view, sun=sun).radiance / exact.radiance
            return Ray(exact.radiance * (1 + (wrong - 1) / 5), exact.transmittance)

    class Finer(Crude):
        def finer(self):
            return LessCrude()

    found = fit(images, init=toy_sky.start(), free=FREE, model=Finer()).with_truth(toy_sky.truth())
    blind = fit(images, init=toy_sky.start(), free=FREE, model=LessCrude()).with_truth(toy_sky.truth())
    assert max(abs(e.pull) for e in blind.parameters) > 5
    assert max(abs(e.pull) for e in found.parameters) < 3
    # A correction of which a fifth is in the error bars has moved a number by five of them or so.
    assert 2 < found.moved < 10
    assert blind.moved == 0
    assert any("finer self has moved" in doubt for doubt in dataclasses.replace(found, moved=7.2).doubts)
    assert not any("finer self" in doubt for doubt in tables.doubts(dataclasses.replace(found, moved=5.0)))


SIX = {
    "free": [
        "mie_scattering",
        "mie_absorption",
        "mie_g",
        "rayleigh_scattering",
        "rayleigh_scale_height",
        "mie_scale_height",
    ],
    "tie": {"mie_scattering": "grey", "mie_absorption": "grey", "rayleigh_scattering": "lambda^-4"},
}


def test_error_bars_are_those_of_the_finer_model(monkeypatch):
    """One picture hardly tells aerosol from its scale height, and of the little that does the crude model has three times as
    much. To a tenth: the changes of the correction are measured over an error bar."""
    monkeypatch.setattr(model_error, "REMAINING", 1e-6)
    images = toy_sky.observations(zeniths=(60.0,))
    bars = lambda result: {e.name: e.standard_error for e in result.parameters if not e.derived}

    def fitted(model):
        result = fit(images, init=toy_sky.truth(), **SIX, model=model)
        assert result.converged, result.message
        return result

    exact, crude = fitted(Toy()), fitted(Hasty())
    assert bars(crude) == pytest.approx(bars(exact), rel=0.1)
    for ours, best in zip(crude.parameters, exact.parameters, strict=True):
        assert ours.value == pytest.approx(best.value, abs=0.3 * best.standard_error), ours.name
    # Three of them away the correction is no longer what its changes say, and Δχ² of about 9 is 1 off.
    ours, best = (profile(result, "mie_scale_height", points=5).profiles[0].delta_chi2 for result in (crude, exact))
    assert ours == pytest.approx(best, rel=0.2)
    # Without these changes.
    monkeypatch.setattr(evaluation, "CHANGE", 0.0)
    blind = fit(images, init=toy_sky.truth(), **SIX, model=Hasty())
    assert bars(blind)["mie_scale_height"] < bars(exact)["mie_scale_height"] / 2


def test_error_bars_of_a_series_are_those_of_the_finer_model():
    """The aerosol that each picture has more of is no other than that of all: more for all and more in each is one thing, and
    stays so where the correction changes with it. To a fifth: so much does the error of the model itself add."""
    images = []
    for number, (hour, log) in enumerate([(8.0, 0.3), (9.5, 0.1), (11.0, 0.0), (13.0, -0.4)]):
        own = toy_sky.truth()
        more = {name: np.exp(log) * getattr(own, name) for name in ("mie_scattering", "mie_absorption")}
        air = toy_sky.change(own, **more)
        images += toy_sky.observations(
            seed=number, zeniths=(30.0 + 10 * number,), atmosphere=air, aerosol="free", time_h=hour
        )
    exact, crude = (fit(images, init=toy_sky.truth(), **SIX, model=model) for model in (Toy(), Hasty(growth=2.0)))
    for ours, best in zip(crude.estimates, exact.estimates, strict=True):
        assert ours.standard_error == pytest.approx(best.standard_error, rel=0.2), ours.name
        assert ours.value == pytest.approx(best.value, abs=0.3 * best.standard_error), ours.name


def test_the_finer_model_is_asked_again_where_its_correction_moves_the_optimum(monkeypatch):
    """A model whose error grows with the aerosol leads 180 error bars astray, the correction from there 3; made again and
    again, it leads to the optimum of the finer model."""
    images, free, tie = toy_sky.observations(), ["mie_scattering"], {"mie_scattering": "grey"}
    start = toy_sky.truth()
    best = fit(images, init=start, free=free, tie=tie, model=Toy(), refine=False).parameters[0]

    def found():
        result = fit(images, init=start, free=free, tie=tie, model=Hasty())
        return result, abs(result.parameters[0].value - best.value) / best.standard_error

    result, off = found()
    assert result.converged, result.message
    assert off < 0.5
    monkeypatch.setattr(passes, "CORRECTIONS", 1)
    result, off = found()
    assert off > 2
    assert not result.converged
    assert "still moves the optimum" in result.message


def test_a_model_too_coarse_for_the_sky_does_not_count_as_converged():
    """Its finer self differs by more than a correction may: the best point is kept, and the message says why."""

    class Coarse(Toy):
        def finer(self):
            return Finer()

    class Finer(Toy):
        def sky(self, atmosphere):
            return FinerSky(atmosphere)

    class FinerSky(toy_sky.ToySky):
        def radiance(self, *, altitude, view, sun):
            exact = super().radiance(altitude=altitude, view=view, sun=sun)
            return Ray(exact.radiance * (1 + 0.2 * view[..., 2:]), exact.transmittance)

    found = fit(toy_sky.observations(), init=toy_sky.start(), free=FREE, model=Coarse())
    assert not found.converged
    assert "finer self differs" in found.message


@pytest.mark.parametrize("factor", [1e3, 1e6])
def test_images_in_another_unit_do_not_converge(factor):
    """The start, where every derivative is nothing beside the residual, is no optimum."""
    images = [
        eqx.tree_at(lambda o: o.image, image, image.image * np.float32(factor)) for image in toy_sky.observations()
    ]
    images = [eqx.tree_at(lambda o: o.noise_floor, image, image.noise_floor * np.float32(factor)) for image in images]
    found = fit(images, init=toy_sky.start(), free=["rayleigh_scattering", "mie_g"], model=Toy())
    assert not found.converged
    assert all(np.isfinite(estimate.value) for estimate in found.parameters)


@pytest.mark.parametrize("factor", [1e-3, 1e-6])
def test_noise_of_another_sky_hides_no_misfit(factor):
    """Images much darker than any sky: that of 1 % of the sky first found would be more than all of their light."""
    image = toy_sky.observations()[1]
    darker = eqx.tree_at(
        lambda o: (o.image, o.noise_floor),
        image,
        (image.image * np.float32(factor), image.noise_floor * np.float32(factor)),
    )
    init = toy_sky.change(toy_sky.truth(), mie_scattering=5e-3, mie_g=0.7)
    found = fit([darker], init=init, free=["mie_scattering", "mie_g"], tie={"mie_scattering": "start"}, model=Toy())
    assert not found.converged
    assert found.reduced_chi2 > 100


@pytest.mark.parametrize(("factor", "noise"), [(1e-19, 0.01), (1e30, 0.01), (1.0, 1e-30)])
def test_numbers_that_single_precision_cannot_square_are_refused(factor, noise):
    image = toy_sky.observations()[0]
    changed = eqx.tree_at(
        lambda o: (o.image, o.noise, o.noise_shot, o.noise_floor),
        image,
        (image.image * np.float32(factor), 0 * image.noise + np.float32(noise), 0 * image.noise, 0 * image.noise),
    )
    with pytest.raises(FitError, match="sun 30: signal and noise: "):
        fit([changed], init=toy_sky.start(), free=["mie_g"], model=Toy())


def test_the_steps_that_are_left():
    """Exact if distances shrink by a constant factor: from 12.5 to 0.1 by halves is seven steps, to 1 four; then two passes."""

    def history(distances, stage):
        return [Step(n, stage, 1.0, 1.0, True, 0.1, d, 1.0, 1.0) for n, d in enumerate(distances)]

    assert steps_left(history([50, 25, 12.5], stage=3), 0.1) == 7
    assert steps_left(history([50, 25, 12.5], stage=1), 0.1) == 4 + 4
    assert steps_left(history([50, 25, 0.05], stage=3), 0.1) == 0
    assert steps_left(history([50, 60, 70], stage=1), 0.1) is None
    assert steps_left(history([50, 45, 40], stage=1), 0.1) is None
    assert steps_left(history([50, 25], stage=1), 0.1) is None
