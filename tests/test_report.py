"""What a fit leaves behind: complete, readable by machines and people, and never over something else."""

import dataclasses
import io
import json
import re

import numpy as np
import PIL.Image
import pytest
import toy_sky
from rich.console import Console

from diffatmo import atmosphere, color, imageio, scene, skymask
from fitting import Estimate, FitError, Prior, fit, report
from fitting.figures import as_png, mask_figure, shares
from fitting.tables import format_number, fragment, to_rows
from fitting.tables import text as plain


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    directory = tmp_path_factory.mktemp("fit")
    paths = report.write(toy_sky.result(), directory, truth=toy_sky.truth())
    return directory, paths


def load(directory):
    def refuse(text):
        raise AssertionError(f"{text} is not JSON")

    return json.loads((directory / "fit.json").read_text(encoding="utf-8"), parse_constant=refuse)


def test_all_files_are_there(written):
    directory, paths = written
    images = [
        f"{kind}_sun_{z}.{end}" for z in (30, 60, 80) for kind in ("fitted", "residual") for end in ("exr", "png")
    ]
    expected = {"fit.json", "fit.npz", "atmosphere.toml", "report.html", *images}
    assert {path.name for path in paths} == expected
    assert {path.name for path in directory.iterdir()} == expected


def test_record(written):
    data, found = load(written[0]), toy_sky.result()
    assert (data["schema"], data["schema_version"]) == ("diffatmo-fit", 2)
    assert data["converged"] is True
    assert data["reduced_chi2"] == pytest.approx(found.reduced_chi2)
    assert data["wavelengths_nm"] == [680, 550, 440]
    assert set(data["parameters"]) == set(toy_sky.FREE)
    g = data["parameters"]["mie_g"]
    assert g["unit"] == ""
    assert g["truth"] == pytest.approx(0.8)
    assert g["initial"] == pytest.approx(0.6)
    assert g["pull"] == pytest.approx((g["value"] - g["truth"]) / g["standard_error"], rel=1e-3)
    rayleigh = data["parameters"]["rayleigh_scattering"]
    assert len(rayleigh["value"]) == len(rayleigh["standard_error"]) == 3
    assert "rayleigh_optical_depth" in data["derived"]
    size = len(data["covariance"]["names"])
    assert np.shape(data["covariance"]["matrix"]) == np.shape(data["correlation"]["matrix"]) == (size, size)
    assert [image["name"] for image in data["images"]] == ["sun 30", "sun 60", "sun 80"]
    assert data["images"][1]["sun_zenith_deg"] == pytest.approx(60, abs=1e-3)
    assert data["images"][0]["noise_relative"] == pytest.approx([0.01] * 3, rel=0.05)
    assert data["images"][0]["residuals"]["rms_sigma"] == pytest.approx([1, 1, 1], abs=0.1)
    assert [step["step"] for step in data["history"]] == list(range(data["iterations"]))
    assert data["timings"].keys() == {"compile_s", "solve_s", "total_s"}


def test_atmosphere_reads_back_to_the_bit(written):
    back, found = atmosphere.load(written[0] / "atmosphere.toml"), toy_sky.result().atmosphere
    for name in toy_sky.FREE:
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))


def test_pictures(written):
    shot = scene.load(written[0] / "fitted_sun_60.exr")
    found = toy_sky.result()
    np.testing.assert_array_equal(shot.pixels, found.fitted[1])
    np.testing.assert_array_equal(shot.scene.atmosphere.mie_g, found.atmosphere.mie_g)
    residual = imageio.read_image(written[0] / "residual_sun_60.exr")
    np.testing.assert_array_equal(residual.pixels, found.residuals[1])
    assert residual.wavelengths == (680, 550, 440)
    for kind in ("fitted", "residual"):
        assert imageio.read_image(written[0] / f"{kind}_sun_60.png", transfer="srgb").pixels.shape == (16, 64, 3)


def test_images_of_one_size_are_developed_by_one_program(compilations):
    """Whatever pixels are used: of many images, only the first waits for the compiler."""
    seen, bands = toy_sky.result().observations[0], [680.0, 550.0, 440.0]
    other = dataclasses.replace(seen, used=seen.used & (np.arange(64) > 20))
    report.developed(seen, seen.image, bands)
    before = len(compilations)
    picture, _ = report.developed(other, seen.image, bands)
    assert len(compilations) == before
    # The exposure is that of the used pixels alone.
    level = np.percentile(seen.image[other.used] @ color.LUMINANCE, 90)
    assert np.allclose(picture[4, 30], color.srgb_encode(1 - np.exp(-seen.image[4, 30] / level)), rtol=1e-4)


def test_page_needs_nothing_else(written):
    page = (written[0] / "report.html").read_text(encoding="utf-8")
    assert page.count("<img src='data:image/png;base64,") == 3 + 3
    text = re.sub(r"base64,[^']*", "", page)
    assert text.count("src=") == text.count("src='data:image/png;'")
    assert not re.search("http|href|url|import", text)
    for text in ("Converged after", "mie_single_scattering_albedo", "pull", "sun at zenith angle 60.0°"):
        assert text in page


def test_what_was_merged_is_said():
    """Of three exposures; of a single picture nothing is."""
    plain = toy_sky.result()
    several = [dataclasses.replace(plain.observations[0], merged=3), *plain.observations[1:]]
    images = report.record(dataclasses.replace(plain, observations=several))["images"]
    assert [image["merged_from"] for image in images][:2] == [3, 1]
    captions = [report._caption(*of, [680, 550, 440]) for of in zip(several, plain.fitted, images, strict=True)]
    assert captions[0].startswith(f"{several[0].name}: merged from 3 files; sun at zenith angle")
    assert captions[1].startswith(f"{several[1].name}: sun at zenith angle")


def test_residuals_of_many_channels_are_told_together():
    found = toy_sky.result()
    spread = {"median_absolute_relative": np.linspace(0.01, 0.03, 21), "rms_sigma": np.full(21, 0.5)}
    about = {"residuals": spread, "noise_relative": np.full(21, 0.04)}
    page = report._residuals_text(found.observations[0], found.fitted[0], about, [])
    assert page.startswith("Residuals: median |measured / fitted − 1| of a channel 2 %, at most 3 %; RMS ")
    assert page.endswith("over stated noise (4 %), RMS: 0.5.")


def headlined(**changes):
    """A result that has what photographers ask for."""
    found = toy_sky.result()
    values = {"mie_optical_depth_550": (0.0764, 0.0049), "visibility": (52.0, 28.0), "turbidity": (1.78, None)}
    known = [
        Estimate(name, name, None, "km" * (name == "visibility"), *number, None, derived=True, data_share=0.377)
        for name, number in values.items()
    ]
    return dataclasses.replace(
        found, parameters=[e for e in found.parameters if e.name not in values] + known, **changes
    )


def test_what_is_asked_for_stands_first():
    prior = Prior("mie_g", 0.8, 0.1, source="a guess")
    lines = plain(headlined(priors=[prior])).splitlines()
    assert lines[0].split("  ")[0] == "aerosol optical depth at 550 nm"
    assert re.search(r"  0\.0764 ± 0\.0049 +38 % by images$", lines[0])
    assert re.search(r"^visibility at the ground +52 ± 28 km ", lines[1])
    assert re.search(r"^turbidity +1\.78, not determined ", lines[2])
    # By images alone there is nothing to tell apart.
    assert "by images" not in "".join(plain(headlined()).splitlines()[:3])
    page = fragment(headlined())
    assert page.index("0.0764 ± 0.0049") < page.index("residuals of sun 30: median") < page.index("<th>parameter")


def test_residuals_are_told_in_percent():
    """Of an image that is 2 % off everywhere in one channel."""
    seen = toy_sky.result().observations[0]
    one = dataclasses.replace(
        toy_sky.result(), observations=[seen], fitted=[seen.image * np.array([1 / 1.02, 1, 1], np.float32)]
    )
    first, line = plain(one).splitlines()[:2]
    # Also without a tie, where 550 nm is one of the wavelengths.
    assert re.fullmatch(r"aerosol optical depth at 550 nm +0\.005\d ± 0\.\d+", first)
    assert line == "residuals: median |measured / fitted − 1| 680 nm 2 %, 550 nm 0 %, 440 nm 0 %"


def test_a_photo_and_its_mask():
    """A pixel of the picture is one of the figure; what is left out is painted, and told with its share."""
    pixels = np.full((300, 1000, 3), 0.2, np.float32)
    pixels[..., 2] = 0.5
    cloud, odd = np.zeros((2, 300, 1000), bool)
    cloud[:75], odd[75, 0] = True, True
    left_out = {"cloud": cloud, "an odd reason": odd}
    assert shares(left_out) == {"fitted": "75 %", "cloud": "25 %", "an odd reason": "under 0.1 %"}
    with PIL.Image.open(io.BytesIO(as_png(mask_figure(pixels, left_out)))) as picture:
        sheet = np.asarray(picture.convert("RGB"))
    assert sheet.shape[1] == 1000
    below = sheet.shape[0] - 2 * 300 - 2 * 24
    photo, mask = sheet[24:324], sheet[-below - 300 : -below]
    assert np.ptp(photo.reshape(-1, 3), axis=0).max() == 0
    assert photo[0, 0, 2] > photo[0, 0, 0]
    np.testing.assert_array_equal(mask[76:], photo[76:])
    red = 255 * (0.5 * photo[0, 0].mean() / 255 + 0.5 * skymask.TINTS[skymask.CLOUD])
    np.testing.assert_allclose(mask[:75], np.broadcast_to(red, (75, 1000, 3)), atol=1)


@pytest.mark.parametrize(("shape", "size"), [((1280, 640), (1024, 512)), ((30, 20), (600, 400)), ((5, 1), (600, 120))])
def test_photos_of_any_size_are_shown(shape, size):
    figure = mask_figure(np.full((*shape, 3), 0.3, np.float32), {})
    assert figure.get_size_inches()[0] * 110 == pytest.approx(2 * size[1] + 10)
    assert [np.shape(axes.images[0].get_array())[:2] for axes in figure.axes] == [size, size]


def test_figures_of_the_caller_are_written_and_come_first(tmp_path):
    plate = report.Plate("mask.png", mask_figure(np.full((4, 8, 3), 0.2), {}), "a <sky>")
    found = toy_sky.result()
    one = dataclasses.replace(found, observations=found.observations[:1], fitted=found.fitted[:1])
    paths = report.write(one, tmp_path, plates=[plate])
    assert tmp_path / "mask.png" in paths
    assert (tmp_path / "mask.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.index("residuals: median") < page.index("a &lt;sky&gt;") < page.index("<h2>Parameters")
    assert page.count("<img") == 1 + 1 + 3
    with pytest.raises(FitError, match="holds results already"):
        report.check_writable(tmp_path)


def test_of_a_scan_its_figure_is_written(tmp_path, monkeypatch):
    """Its pixels are no picture."""
    monkeypatch.setattr(report, "page", lambda *_: "page")
    found = toy_sky.result()
    seen = found.observations[0]
    grids = ("image", "directions", "shown", "used", "noise", "noise_shot", "noise_floor")
    row = {name: getattr(seen, name)[8:9] for name in grids}
    scanned = dataclasses.replace(seen, name="scan", pose="free", **row)
    report.write(dataclasses.replace(found, observations=[scanned], fitted=[found.fitted[0][8:9]]), tmp_path)
    pictures = {path.name for path in tmp_path.iterdir()} - set(report.FIXED_NAMES)
    assert pictures == {"fitted_scan.exr", "fitted_scan.png", "residual_scan.exr"}
    height, width, _ = imageio.read_image(tmp_path / "fitted_scan.png", transfer="srgb").pixels.shape
    assert width > 2 * height > 800


def test_names_are_made_safe():
    found = toy_sky.result()
    names = ["../a b", "a/b", "<b>", "a b"]
    images = [dataclasses.replace(found.observations[0], name=name) for name in names]
    assert report.file_names(images) == ["a_b", "a_b_2", "b", "a_b_3"]
    strange = dataclasses.replace(found, observations=[images[2]], fitted=found.fitted[:1])
    page = report.page(strange)
    assert "<b>" not in page
    assert "&lt;b&gt;" in page


def test_nothing_is_overwritten_unless_asked(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    assert report.check_writable(tmp_path) == tmp_path
    (tmp_path / "fitted_x.png").write_text("old")
    with pytest.raises(FitError, match="holds results already"):
        report.check_writable(tmp_path)
    with pytest.raises(FitError, match="holds results already"):
        report.write(toy_sky.result(), tmp_path)
    assert report.check_writable(tmp_path, overwrite=True) == tmp_path
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_a_place_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FitError, match="file: cannot be written to"):
        report.check_writable(tmp_path / "file")
    with pytest.raises(FitError, match="cannot be written to"):
        report.check_writable(tmp_path / "file" / "below")
    report.check_writable(tmp_path / "new" / "folder")
    assert (tmp_path / "new" / "folder").is_dir()


def test_one_failure_does_not_take_the_rest_along(tmp_path, monkeypatch):
    def full(path, *_, **__):
        raise imageio.ImageError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(imageio, "write_png", full)
    monkeypatch.setattr(report, "page", lambda *_: "page")
    with pytest.raises(OSError, match=r"fitted_sun_30\.png: cannot be written: No space left.*residual_sun_80\.png"):
        report.write(toy_sky.result(), tmp_path)
    present = {path.name for path in tmp_path.iterdir()}
    assert {"fit.json", "atmosphere.toml", "report.html", "fitted_sun_30.exr"} <= present
    assert not any(name.endswith(".png") or ".part" in name for name in present)


def test_unfinished_and_undetermined_results_are_reported(tmp_path):
    found = toy_sky.result()
    unknown = dataclasses.replace(found.parameters[0], standard_error=None, at_bound=False)
    held = dataclasses.replace(found.parameters[1], at_bound=True)
    covariance = found.covariance.copy()
    covariance[0] = covariance[:, 0] = np.nan
    broken = dataclasses.replace(
        found,
        converged=False,
        message="stopped: not converged in the steps allowed",
        parameters=[unknown, held, *found.parameters[2:]],
        covariance=covariance,
        undetermined=[unknown.name],
        error_scale=2.0,
        history=[
            found.history[0]._replace(chi2=float("inf"), reduced_chi2=float("inf"), accepted=False),
            *found.history,
        ],
    )
    data = json.loads(json.dumps(report.record(broken), allow_nan=False))
    assert data["converged"] is False
    assert data["parameters"]["rayleigh_scattering"]["standard_error"][0] is None
    assert data["covariance"]["matrix"][0] == [None] * len(covariance)
    assert data["history"][0]["chi2"] is None
    page = report.page(broken)
    for text in ("Not converged", "do not determine rayleigh_scattering_680", "At the bound", "2.0 times"):
        assert text in page


def test_table_fits_into_eighty_columns():
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(report.table(toy_sky.result(), toy_sky.truth()))
    text = console.export_text()
    assert "…" not in text
    assert re.search(r"mie_g +0\.\d+ +0\.000\d+ +0\.6 +0\.8 +[+-]\d\.\d", text)
    assert "pull" not in "".join(str(column.header) for column in report.table(toy_sky.result()).columns)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.0058065, 7.4e-6, "0.0058065"),
        (7.993456, 0.0074, "7.9935"),
        (33.123456, 12.0, "33"),
        (0.3, None, "0.3"),
        (0.0, 0.1, "0"),
        (float("nan"), None, "–"),
        (1234.5678, 1e-9, "1234.5678"),
    ],
)
def test_numbers_show_the_digits_that_mean_something(value, error, text):
    assert format_number(value, error) == text


def test_a_field_that_a_tie_makes_one_number_has_one_row():
    tie = {"mie_scattering": "grey"}
    tied = fit(
        toy_sky.observations(), init=toy_sky.truth(), free=["mie_scattering", "mie_g"], tie=tie, model=toy_sky.Toy()
    )
    rows = [line.split() for line in plain(tied).splitlines()]
    of_scattering = [words for words in rows if words[:1] == ["mie_scattering"]]
    assert len(of_scattering) == 1
    assert of_scattering[0][1] == "all"
    assert not any(words[:1] == [nm] for words in rows for nm in ("680", "550", "440"))
    shown = [label.get_text() for label in tied.plot("correlation").axes[0].get_yticklabels()]
    assert shown == ["mie_scattering", "mie_g"]
    # What is read by machines has all.
    assert [row["wavelength_nm"] for row in to_rows(tied) if row["field"] == "mie_scattering"] == [680, 550, 440]
