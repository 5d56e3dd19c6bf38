"""The colours of a camera: by a matrix or by its sensitivities, which come to the same where they are those of sRGB."""

import equinox as eqx
import jax
import numpy as np
import photographs
import pytest

from diffatmo import bands, color, imageio
from diffatmo.cli import images, photo
from diffatmo.cli.common import InputError
from diffatmo.cli.main import main
from diffatmo.cli.scenefile import ImageSpec, read_scene
from diffatmo.imageio import Image

AT, MATCHING = color.observer()
SRGB = MATCHING @ color.XYZ_TO_SRGB.T


def table(path, values=SRGB, at=AT, names="wavelength_nm,red,green,blue", note="# as measured\n"):
    rows = [",".join(repr(float(x)) for x in row) for row in np.column_stack([at, values])]
    path.write_text("\n".join([note + names, *rows]) + "\n")
    return path


SAID = {"projection": "equirectangular", "sun_zenith_deg": 40.0, "sun_azimuth_deg": 0.0}


def panorama(path):
    """Blue above, white around the horizon."""
    rows = np.linspace(1, 0.2, 10)[:, None, None] * np.linspace(0.8, 1, 40)[:, None]
    sky = np.array([0.3, 0.6, 0.9]) * rows + np.array([0.5, 0.5, 0.5]) * (1 - rows)
    imageio.write_exr(path, sky.astype(np.float32))
    return path


def seen_by(path, **said):
    imageio.write_png(path.with_name("mask.png"), np.ones((10, 40, 3)), overwrite=True)
    said |= {"mask": str(path.with_name("mask.png"))}
    opened = images.open_image(ImageSpec(path, SAID | said), may_be_photo=True)
    return images.observe_photo(opened, "sky")


def test_sensitivities_of_srgb_change_nothing(tmp_path):
    """Nor does the matrix of sRGB."""
    file = panorama(tmp_path / "sky.exr")
    usual = seen_by(file)
    by_table = seen_by(file, sensitivities=str(table(tmp_path / "srgb.csv")))
    by_matrix = seen_by(file, camera_matrix=np.linalg.inv(color.XYZ_TO_SRGB).ravel().tolist())
    numbers = lambda seen: jax.tree.leaves(eqx.filter(seen.observation, eqx.is_inexact_array_like))
    for other in (by_table, by_matrix):
        np.testing.assert_array_equal(usual.observation.used, other.observation.used)
        for one, two in zip(numbers(usual), numbers(other), strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-12)
    assert (
        by_table.assumed[0] == f"colours: by {tmp_path / 'srgb.csv'}; the wavelengths of the model show them to 0.27 %"
    )
    assert by_matrix.assumed == usual.assumed


def test_other_sensitivities_are_seen_through(tmp_path):
    """Of a narrow channel the model's light at its wavelength; and a sky as white as the sun is white."""
    at = np.arange(400.0, 701.0, 5.0)
    curves = np.stack([np.exp(-(((at - centre) / 6) ** 2)) for centre in (600.0, 540.0, 450.0)], axis=-1)
    found = seen_by(panorama(tmp_path / "sky.exr"), sensitivities=str(table(tmp_path / "cam.csv", 7 * curves, at)))
    seen = found.observation.bands
    assert seen.names == ("red", "green", "blue")
    np.testing.assert_allclose(seen.centres, [600, 540, 450], atol=0.5)
    np.testing.assert_allclose(seen.response.sum(axis=1), 1, atol=1e-12)
    smooth = (550 / np.array(seen.nodes)) ** 2
    np.testing.assert_allclose(seen.response @ smooth, (550 / seen.centres) ** 2, rtol=2e-3)


def test_a_raw_with_sensitivities_is_as_its_sensor_saw_it():
    """And with a matrix of the user's own it goes through that, not through its own."""
    pixels = np.full((20, 80, 3), 0.2, np.float32) * np.array([1.0, 2.0, 1.5], np.float32)
    raw = Image(pixels, {}, None, to_xyz=np.linalg.inv(photographs.XYZ_TO_CAMERA), saturation=1.0)
    np.testing.assert_array_equal(photo.complete(raw, SAID | {"sensitivities": "cam.csv"}, False).pixels, pixels)
    other = np.linalg.inv(photographs.XYZ_TO_CAMERA.T).ravel().tolist()
    made = photo.complete(raw, SAID | {"camera_matrix": other}, False).pixels
    expected = color.XYZ_TO_SRGB @ np.reshape(other, (3, 3)) @ pixels[0, 0]
    np.testing.assert_allclose(made[0, 0] / made[0, 0, 1], expected / expected[1], rtol=1e-5)
    assert not np.allclose(made, photo.complete(raw, SAID, False).pixels, rtol=0.01)


def test_the_error_of_six_wavelengths_is_that_of_srgb():
    """0.26, 0.26 and 0.21 % over skies, as :data:`diffatmo.bands.NODES` says; none where nodes are many."""
    curves = bands.Curves(SRGB, AT)
    assert bands.node_error(curves) == pytest.approx(0.0025, abs=0.0005)
    assert bands.node_error(curves, tuple(np.arange(360.0, 841.0, 10.0))) < 5e-4


def test_tables_may_have_other_columns_and_be_in_any_order(tmp_path):
    file = table(
        tmp_path / "a.csv", np.column_stack([SRGB[:, ::-1], SRGB[:, 0]]), names="wavelength_nm,blue, green,red,ir"
    )
    np.testing.assert_array_equal(bands.read(file).values, SRGB)
    np.testing.assert_array_equal(bands.read(file).wavelengths, AT)


GRID = np.arange(400.0, 701.0, 10.0)
ONES = np.ones((GRID.size, 3))
TABLES = {
    "gone": (None, "cannot be read: No such file or directory"),
    "binary": (b"\xff\xfe\x00", "not a CSV file: "),
    "empty": (b"", "columns , expected wavelength_nm, red, green, blue, each once"),
    "no blue": ((ONES, GRID, "wavelength_nm,red,green,bleu"), "columns wavelength_nm, red, green, bleu, expected wave"),
    "twice red": ((ONES, GRID, "wavelength_nm,red,red,blue"), "columns wavelength_nm, red, red, blue, expected"),
    "a word": (b"wavelength_nm,red,green,blue\n400,1,1,much\n", "expected a number for each of wavelength_nm, red, green, b"),
    "ragged": (b"wavelength_nm,red,green,blue\n400,1,1\n", "expected a number for each of wavelength_nm, red"),
    "no rows": (b"wavelength_nm,red,green,blue\n", "has no rows, expected 400 to 700 nm at least"),
    "not a number": ((np.where(ONES == 1, np.nan, 0), GRID), "expected finite numbers"),
    "falling": ((ONES, GRID[::-1]), "wavelength_nm: expected numbers that rise from row to row"),
    "in micrometres": ((ONES, GRID / 1000), "covers 0.4 to 0.7 nm, expected 400 to 700 nm at least"),
    "too short": ((ONES[5:], GRID[5:]), "covers 450 to 700 nm, expected 400 to 700 nm at least"),
    "coarse": ((ONES[::5], GRID[::5]), "rows are up to 50 nm apart, expected 20 nm at most"),
    "blind": ((ONES * [1, 1, 0], GRID), "blue sees nothing, expected numbers above 0"),
    "negative": ((-ONES, GRID), "red sees nothing, expected numbers above 0"),
    "missing marked": (
        (np.where((GRID == 500)[:, None], [1, -999, 1], ONES), GRID),
        "green is -999 at 500 nm, expected numbers from 0, or from -0.5 times its largest after a matrix",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_tables_that_are_none(tmp_path, name):
    content, message = TABLES[name]
    file = tmp_path / "cam.csv"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content:
        table(file, *content)
    with pytest.raises(ValueError, match="cam") as caught:
        bands.read(file)
    assert str(caught.value).startswith(f"{file}: {message}")
    assert "\n" not in str(caught.value)


def test_a_table_beyond_the_spectrum_of_the_sun_is_refused_in_one_line(tmp_path):
    wide = np.arange(300.0, 701.0, 10.0)
    file = table(tmp_path / "cam.csv", np.ones((wide.size, 3)), wide)
    with pytest.raises(InputError, match=r"cam.csv: sensitivity: reaches beyond 360 to 840 nm"):
        seen_by(panorama(tmp_path / "sky.exr"), sensitivities=str(file))


IDENTITY = "1,0,0,0,1,0,0,0,1"
COMMANDS = {
    "both": (["--camera-matrix", IDENTITY, "--sensitivities", "c.csv"], "sensitivities contradicts camera_matrix: give one"),
    "three numbers": (["--camera-matrix", "1,2,3"], "--camera-matrix: got '1,2,3', expected nine numbers, row by row"),
    "flat": (["--camera-matrix", "1,2,3,1,2,3,0,0,1"], "sky.exr: camera_matrix: its rows depend on each other"),
    "negative": (["--camera-matrix", "-1,0,0,0,1,0,0,0,1"], "sky.exr: camera_matrix: daylight would be"),
    "not a photo": (
        ["--camera-matrix", IDENTITY, "--init", "earth", "--altitude-km", "0"],
        "sky.exr: camera_matrix: the channels are wavelengths of the atmosphere, expected a photo without --init",
    ),
    "no table": (["--sensitivities", "c.csv"], "sky.exr: c.csv: cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_about_colours_that_are_wrong(tmp_path, monkeypatch, capfd, name):
    arguments, message = COMMANDS[name]
    monkeypatch.chdir(tmp_path)
    panorama(tmp_path / "sky.exr")
    said = [word for key, value in SAID.items() for word in (f"--{key.replace('_', '-')}", str(value))]
    assert main(["fit", "sky.exr", *said, *arguments]) == 2
    errors = capfd.readouterr().err
    assert errors.count("\n") == 1
    assert message in errors


def test_a_scene_file_names_its_table_and_matrix(tmp_path):
    """A table lies beside the scene; nine numbers may be laid out as what they are."""
    (tmp_path / "scene.toml").write_text(
        '[[image]]\nfile = "a.exr"\nsensitivities = "cam.csv"\n'
        '[[image]]\nfile = "a.exr"\ncamera_matrix = [\n  1, 0, 0,\n  0, 1, 0,\n  0, 0, 1,\n]\n'
    )
    first, second = read_scene(tmp_path / "scene.toml").images
    assert first.options["sensitivities"] == str(tmp_path / "cam.csv")
    np.testing.assert_array_equal(second.options["camera_matrix"], np.eye(3).ravel())
