"""A fit at hand: shown, kept and read back to the bit, and used to predict a sky with error bars."""

import csv
import dataclasses
import functools
import io
import json
import math
import re
import sys
import zipfile

import jax
import numpy as np
import pytest
import toy_sky
from matplotlib.figure import Figure
from toy_sky import FREE, Toy

import fitting
from diffatmo import camera, render
from diffatmo.models import Bruneton, Hillaire, Moments, RayMarch
from diffatmo.phase import PhaseTable
from diffatmo.render import Scene
from fitting import FitError, FitResult, report, storage
from fitting.priors import Prior

PLOTS = ("images", "residuals", "correlation", "convergence")


def scene(zenith: float = 45.0, atmosphere=None, exposure: float = 1.0) -> Scene:
    return Scene(atmosphere or toy_sky.start(), toy_sky.CAMERA, 0.1, toy_sky.towards_sun(zenith), exposure)


def with_everything() -> FitResult:
    """A result in which nothing is as simple as it can be: infinities, NaNs, a table, other cameras, exposures."""
    found = toy_sky.result().with_truth(toy_sky.truth())
    table = PhaseTable([0.0, 30.0, 180.0], [5.0, 1.0, 0.1])
    covariance = found.covariance.copy()
    covariance[3] = covariance[:, 3] = np.nan
    unknown = dataclasses.replace(found.parameters[3], standard_error=None)
    held = dataclasses.replace(found.parameters[4], at_bound=True, data_share=0.25)
    cameras = (toy_sky.CAMERA, camera.Fisheye(16, 64, yaw=0.1), camera.Pinhole(16, 64, fov_y=1.0, roll=0.3))
    return dataclasses.replace(
        found,
        atmosphere=dataclasses.replace(found.atmosphere, mie_phase=table),
        parameters=[*found.parameters[:3], unknown, held, *found.parameters[5:]],
        nuisances=[fitting.Estimate("exposure_a", "exposure_a", None, "", 1.1, 0.01, None)],
        covariance=covariance,
        history=[found.history[0]._replace(chi2=float("inf"), accepted=False), *found.history],
        observations=[dataclasses.replace(o, camera=c) for o, c in zip(found.observations, cameras, strict=True)],
        undetermined=[unknown.name],
        message="stopped: Ångström's λ⁻⁴",
        priors=[Prior("mie_g", 0.8, 0.1, source="a guess"), Prior("ground_albedo", 0.3, math.log(2), relative=True)],
        outliers=[3, 0, 7],
        model=Moments(),
    )


def same(a, b) -> bool:
    """Whether two objects are made of the same bits."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray | jax.Array):
        return a.dtype == b.dtype and a.shape == b.shape and np.asarray(a).tobytes() == np.asarray(b).tobytes()
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a))
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return a == b


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "fit.npz"
    with_everything().save(path)
    return path


# Kept ---------------------------------------------------------------------------------------------------------------


def test_reads_back_to_the_bit(saved):
    found, back = with_everything(), FitResult.load(saved)
    for field in dataclasses.fields(found):
        assert same(getattr(found, field.name), getattr(back, field.name)), field.name
    assert [path.name for path in saved.parent.iterdir()] == ["fit.npz"]


def test_what_was_read_back_looks_the_same(saved):
    found, back = with_everything(), FitResult.load(saved)
    assert repr(found) == repr(back)
    assert found._repr_html_() == back._repr_html_()
    assert report.page(found) == report.page(back)
    assert found.plot()._repr_png_() == back.plot()._repr_png_()


@pytest.mark.parametrize(
    "model",
    [Moments(altitudes=12).finer(), Bruneton.reduced(), Hillaire(sky_view_size=(64, 36)), RayMarch(light_steps=3)],
    ids=lambda model: type(model).__name__,
)
def test_models_are_kept(tmp_path, model):
    dataclasses.replace(toy_sky.result(), model=model, refine=False).save(tmp_path / "fit")
    back = FitResult.load(tmp_path / "fit")
    assert same(back.model, model)
    assert not back.refine


def test_a_model_of_ones_own_is_not_kept_and_asked_for(tmp_path):
    toy_sky.result().save(tmp_path / "fit.npz")
    back = FitResult.load(tmp_path / "fit.npz")
    with pytest.raises(FitError, match="give model="):
        back.predict(scene())
    np.testing.assert_array_equal(
        back.predict(scene(), model=Toy()).radiance, toy_sky.result().predict(scene()).radiance
    )


def test_the_file_runs_no_code_and_explains_itself(saved):
    with np.load(saved, allow_pickle=False) as file:
        np.testing.assert_array_equal(file["observations.1.image"], with_everything().observations[1].image)
        record = json.loads(file["record"].tobytes())
    assert (record["schema"], record["schema_version"]) == ("diffatmo-result", 3)
    assert record["result"]["iterations"] == with_everything().iterations


def test_nothing_is_overwritten_unless_asked(saved):
    before = saved.read_bytes()
    with pytest.raises(FitError, match=r"fit\.npz: exists already"):
        toy_sky.result().save(saved)
    assert saved.read_bytes() == before
    toy_sky.result().save(saved, overwrite=True)
    assert FitResult.load(saved).message == toy_sky.result().message
    with pytest.raises(FitError, match="there is no folder"):
        toy_sky.result().save(saved.parent / "nowhere" / "fit.npz")


def refusal(path, content: bytes) -> str:
    """What :meth:`FitResult.load` says of a file with this content; one line that names it."""
    path.write_bytes(content)
    with pytest.raises(FitError) as caught:
        FitResult.load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: not a ")
    assert "\n" not in message
    return message


def test_a_file_cut_short_is_refused(saved):
    whole = saved.read_bytes()
    for length in (0, 1, 3, 4, 100, len(whole) // 2, len(whole) - 1):
        refusal(saved, whole[:length])


def test_a_damaged_file_is_refused(saved):
    whole = saved.read_bytes()
    for place in range(200, len(whole), len(whole) // 40):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        saved.write_bytes(damaged)
        try:
            back = FitResult.load(saved)
        except FitError as error:
            back, message = None, str(error)
        # Some bits of a zip's headers mean nothing; then all is there.
        assert same(back, with_everything()) if back else message.startswith(f"{saved}: not a ")


def test_other_files_are_refused(saved):
    def npz(**arrays) -> bytes:
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        return stream.getvalue()

    def pickled() -> bytes:
        stream = io.BytesIO()
        np.save(stream, np.array([print], dtype=object), allow_pickle=True)
        return stream.getvalue()

    def text(record) -> np.ndarray:
        return np.frombuffer(json.dumps(record).encode(), np.uint8)

    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as file:
        file.writestr("hello.txt", "hello")
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    for content in (b"not a fit", pickled(), array.getvalue(), zipped.getvalue(), npz(image=np.zeros(3))):
        assert "saved fit" in refusal(saved, content)
    assert "schema" in refusal(saved, npz(record=text({"schema": "diffatmo-fit"})))
    newer = {"schema": storage.SCHEMA, "schema_version": 4, "version": "9.9", "result": {}}
    assert "got 4 (diffatmo 9.9), expected 3" in refusal(saved, npz(record=text(newer)))
    for result in ({}, {"chi2": {"type": "os.system"}}, {"model": {"type": "model", "name": "x", "fields": {}}}, 3):
        refusal(saved, npz(record=text(newer | {"schema_version": 2, "result": result})))
    refusal(saved, npz(record=np.array([3.5])))


def test_a_file_that_is_not_there(tmp_path):
    for path, reason in ((tmp_path / "none.npz", "No such file"), (tmp_path, "Is a directory")):
        with pytest.raises(FitError, match=f"cannot be read: {reason}"):
            FitResult.load(path)


def test_only_what_a_result_is_made_of_is_saved(tmp_path):
    with pytest.raises(TypeError, match="timings: a object cannot be saved"):
        dataclasses.replace(toy_sky.result(), timings=object()).save(tmp_path / "fit.npz")
    assert not list(tmp_path.iterdir())


# Shown --------------------------------------------------------------------------------------------------------------


def test_it_shows_itself_as_a_table():
    shown = repr(with_everything())
    lines = shown.splitlines()
    assert len(lines) < 50
    assert max(map(len, lines)) <= 100
    assert re.search(r"rayleigh_scale_height +7\.99\d\d +not determined .*10\.4 +8\n", shown)
    assert re.search(r"mie_scattering +680 +0\.00408\d +at its bound +25 % +0\.00519 +0\.003996", shown)
    assert "…" not in shown
    assert re.fullmatch(
        r"residuals of sun 30: median \|measured / fitted − 1\| 680 nm (0\.\d+) %, 550 nm (0\.\d+) %, 440 nm (0\.\d+) %",
        lines[1],
    )
    assert lines[4] == "Converged after 8 iterations, reduced χ² = 1.002"
    assert "mie_single_scattering_albedo" in shown
    assert "The images do not determine rayleigh_scale_height." in shown
    assert "\x1b" not in shown
    assert "array" not in shown
    stopped = dataclasses.replace(with_everything(), converged=False)
    assert "\nstopped: Ångström's λ⁻⁴." in repr(stopped)
    assert "<p>stopped: Ångström&#x27;s λ⁻⁴.</p>" in stopped._repr_html_()
    page = with_everything()._repr_html_()
    assert "<table>" in page
    assert len(page) < 20_000


@pytest.mark.parametrize("what", PLOTS)
def test_figures_are_not_in_the_hands_of_pyplot(what):
    figure = toy_sky.result().plot(what)
    assert isinstance(figure, Figure)
    assert figure._repr_png_().startswith(b"\x89PNG")
    if "matplotlib.pyplot" in sys.modules:
        assert figure not in map(
            sys.modules["matplotlib.pyplot"].figure, sys.modules["matplotlib.pyplot"].get_fignums()
        )


def test_unknown_plot():
    with pytest.raises(
        FitError, match="plot: got 'image', expected one of images, residuals, correlation, convergence"
    ):
        toy_sky.result().plot("image")


def test_rows(tmp_path):
    found = with_everything()
    rows = found.to_rows()
    assert [row["name"] for row in rows] == [*found.covariance_names, "exposure_a"]
    assert {row["kind"] for row in rows} == {"fitted", "derived", "nuisance"}
    unknown = rows[3]
    assert (unknown["name"], unknown["standard_error"], unknown["pull"]) == ("rayleigh_scale_height", None, None)
    found.to_csv(tmp_path / "fit.csv")
    with (tmp_path / "fit.csv").open(encoding="utf-8", newline="") as file:
        back = list(csv.DictReader(file))
    assert [row["standard_error"] for row in back] == [
        "" if row["standard_error"] is None else repr(row["standard_error"]) for row in rows
    ]
    assert [float(row["value"]) for row in back] == [row["value"] for row in rows]
    with pytest.raises(FitError, match=r"fit\.csv: exists already"):
        found.to_csv(tmp_path / "fit.csv")


# Used ---------------------------------------------------------------------------------------------------------------


def brute_force(found: FitResult, zenith: float, factor: float = 1.0, factor_name: str | None = None) -> np.ndarray:
    """√ diag(J C Jᵀ) of the toy's picture, J by central differences in every number, in double precision."""
    fitted = [estimate for estimate in found.parameters if not estimate.derived]
    names = [estimate.name for estimate in fitted] + ([factor_name] if factor_name else [])
    index = [found.covariance_names.index(name) for name in names]
    with jax.enable_x64(True):
        columns = []
        for estimate in fitted:
            value = np.asarray(getattr(found.atmosphere, estimate.field), dtype=float)
            here = np.isclose(np.asarray(found.atmosphere.wavelengths), estimate.wavelength) if value.ndim else True
            step = 1e-4 * abs(estimate.value)
            up, down = (
                toy_sky.image(
                    dataclasses.replace(found.atmosphere, **{estimate.field: np.where(here, value + change, value)}),
                    zenith,
                )
                for change in (step, -step)
            )
            columns.append(factor * (up - down) / (2 * step))
        if factor_name:
            columns.append(toy_sky.image(found.atmosphere, zenith))
    slopes = np.stack(columns, axis=-1)
    return np.sqrt(np.einsum("...i,ij,...j->...", slopes, found.covariance[np.ix_(index, index)], slopes))


def test_prediction_is_the_rendered_sky():
    found, wanted = toy_sky.result(), scene(exposure=2.5)
    prediction = found.predict(wanted)
    own = dataclasses.replace(wanted, atmosphere=found.atmosphere)
    # Two programs, each rounding in its own order.
    np.testing.assert_allclose(prediction.radiance, render.render(own, Toy()), rtol=1e-5)
    assert same(prediction.scene, own)
    # Of an image that was fitted, it is what the fit says.
    again = found.predict(scene(60.0))
    shown = found.observations[1].shown
    np.testing.assert_allclose(again.radiance[shown], found.fitted[1][shown], rtol=1e-5)


def test_error_bars_are_those_of_brute_force():
    prediction = toy_sky.result().predict(scene())
    assert prediction.modes.shape[-1] == 18
    # Numbers are known to 1 %, the radiance thirty times better: slopes must agree to 1e-4 for an error of 0.3 %.
    np.testing.assert_allclose(prediction.standard_error, brute_force(toy_sky.result(), 45.0), rtol=5e-3)
    twice = toy_sky.result().predict(scene(exposure=2.0))
    np.testing.assert_allclose(twice.standard_error, 2 * prediction.standard_error, rtol=1e-4)


def test_numbers_that_share_a_factor_are_one_mode():
    free, tie = ["mie_scattering", "mie_g"], {"mie_scattering": "start"}
    found = fitting.fit(toy_sky.observations(), init=toy_sky.start(), free=free, tie=tie, model=Toy())
    prediction = found.predict(scene())
    assert prediction.modes.shape[-1] == 2
    np.testing.assert_allclose(prediction.standard_error, brute_force(found, 45.0), rtol=1e-3)


@pytest.mark.parametrize("group", ["camera", "camera-per-channel"])
def test_fitted_exposures_enter_the_prediction_when_asked(group):
    free = ["rayleigh_scattering", "mie_scattering", "mie_g"]
    images = toy_sky.observations(exposure=(group,) * 3, factors=(2, 2, 2))
    found = fitting.fit(images, init=toy_sky.change(toy_sky.truth(), mie_g=0.7), free=free, model=Toy())
    plain, exposed = found.predict(scene()), found.predict(scene(), exposure="exposure_camera")
    factors = np.array([estimate.value for estimate in found.nuisances])
    np.testing.assert_allclose(factors, 2, rtol=0.05)
    np.testing.assert_allclose(exposed.radiance, plain.radiance * factors, rtol=1e-5)
    if group == "camera":
        wanted = brute_force(found, 45.0, factors[0], "exposure_camera")
        np.testing.assert_allclose(exposed.standard_error, wanted, rtol=5e-3)
    # The images determine the product better than its factors.
    assert np.median(exposed.standard_error / exposed.radiance) < np.median(plain.standard_error / plain.radiance)
    with pytest.raises(FitError, match="exposure: 'camera' is not a factor of this fit, which has exposure_camera"):
        found.predict(scene(), exposure="camera")


def test_error_bars_are_calibrated():
    """Skies predicted from noisy sets of images are off by as much as their error bars say."""
    truth = toy_sky.image(toy_sky.truth(), 45.0)
    squares, unaware, aware = [], [], []
    for seed in range(8):
        found = fitting.fit(
            toy_sky.observations(seed, noise=0.002), init=toy_sky.start(1.1, 0.75), free=FREE, model=Toy()
        )
        prediction = found.predict(scene())
        squares.append(np.mean(((prediction.radiance - truth) / prediction.standard_error) ** 2))
        exact = toy_sky.observations(100 + seed, noise=2e-5, zeniths=(45.0,), noise_floor=0.0)[0]
        aware.append(prediction.reduced_chi2(exact))
        unaware.append(dataclasses.replace(prediction, modes=0 * prediction.modes).reduced_chi2(exact))
        assert np.nanmean(prediction.pulls(exact) ** 2) < 5
    # 8 × 18 independent numbers: their mean square has a standard deviation of √(2/144) = 0.12 or, as a pixel depends on fewer
    # than all, a little more.
    assert np.mean(squares) == pytest.approx(1, abs=0.5)
    # 3000 residuals in each of 8: √(2/24000) = 0.009. An image that exact is nowhere near a prediction taken for exact.
    assert np.mean(aware) == pytest.approx(1, abs=0.03)
    assert np.mean(unaware) > 5


def test_chi2_is_that_of_the_whole_covariance():
    """Against the inverse of the full matrix, on a picture small enough to have one."""
    found = toy_sky.result()
    prediction = found.predict(scene())
    (observation,) = toy_sky.observations(7, zeniths=(45.0,))
    few = np.zeros_like(observation.used)
    few[3:9, 5:25] = observation.used[3:9, 5:25]
    part = dataclasses.replace(observation, used=few)
    modes = prediction.modes[few].reshape(-1, prediction.modes.shape[-1]).astype(float)
    noise = np.asarray(fitting.observation.sigma(part, prediction.radiance))[few].ravel()
    residual = (part.image - prediction.radiance)[few].ravel().astype(float)
    chi2 = residual @ np.linalg.solve(np.diag(noise.astype(float) ** 2) + modes @ modes.T, residual)
    assert prediction.reduced_chi2(part) == pytest.approx(chi2 / residual.size, rel=1e-6)


def test_what_is_not_determined_has_no_error_bar():
    found = toy_sky.result()
    number = found.covariance_names.index("ground_albedo_680")
    covariance = found.covariance.copy()
    covariance[number] = covariance[:, number] = np.nan
    unknown = dataclasses.replace(found, covariance=covariance, undetermined=["ground_albedo_680"])
    prediction, whole = unknown.predict(scene()), found.predict(scene())
    np.testing.assert_array_equal(prediction.radiance, whole.radiance)
    # The ground lights this sky, at its own wavelength only.
    assert np.isnan(prediction.standard_error[..., 0]).all()
    np.testing.assert_allclose(prediction.standard_error[..., 1:], whole.standard_error[..., 1:], rtol=1e-4)
    assert "33 % of the numbers without an error bar" in repr(prediction)
    (observation,) = toy_sky.observations(zeniths=(45.0,))
    assert np.isnan(prediction.reduced_chi2(observation))
    # With the sun in the horizon no light falls on the ground, and all is known again.
    level = dataclasses.replace(scene(), sun=np.array([0.0, 1.0, 0.0]))
    assert np.isfinite(unknown.predict(level).standard_error).all()


def test_a_prediction_is_described_in_one_line():
    text = repr(toy_sky.result().predict(scene()))
    assert text == "Prediction: 64 x 16 pixels at 680, 550, 440 nm, median standard error 0.034 %"


def test_images_of_something_else_are_refused():
    prediction = toy_sky.result().predict(scene())
    observed = functools.partial(toy_sky.observations, zeniths=(45.0,))
    assert np.isfinite(prediction.pulls(observed()[0])[observed()[0].used]).all()
    with pytest.raises(FitError, match="sun 60: its sun is not that"):
        prediction.pulls(toy_sky.observations(zeniths=(60.0,))[0])
    with pytest.raises(FitError, match="sun 45: its exposure_value is not that"):
        prediction.reduced_chi2(observed(exposure_value=2.0)[0])
    with pytest.raises(FitError, match=r"averages of 2 x 2\), the prediction \(16, 64, 3\)"):
        prediction.reduced_chi2(observed(max_pixels=300)[0])
    other = toy_sky.change(toy_sky.truth(), wavelengths=[600.0, 500.0, 400.0])
    with pytest.raises(FitError, match="scene: has wavelengths"):
        toy_sky.result().predict(scene(atmosphere=other))
    with pytest.raises(FitError, match="scene: got Observation, expected a Scene"):
        toy_sky.result().predict(observed()[0])


def test_a_misspelt_number_is_answered_with_its_like():
    with pytest.raises(KeyError, match="'mie_G' is no number of this fit, did you mean 'mie_g'"):
        toy_sky.result().estimate("mie_G")


def test_a_finer_model_has_the_last_word():
    class Brighter(Toy):
        def sky(self, atmosphere):
            return Toy().sky(toy_sky.change(atmosphere, solar_irradiance=1.01))

    class Coarse(Toy):
        def finer(self):
            return Brighter()

    found = dataclasses.replace(toy_sky.result(), model=Coarse())
    plain = toy_sky.result().predict(scene()).radiance
    np.testing.assert_allclose(found.predict(scene()).radiance, 1.01 * plain, rtol=1e-5)
    np.testing.assert_allclose(dataclasses.replace(found, refine=False).predict(scene()).radiance, plain, rtol=1e-5)
    np.testing.assert_allclose(found.predict(scene(), model=Coarse()).radiance, plain, rtol=1e-5)
