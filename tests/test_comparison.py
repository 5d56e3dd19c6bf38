"""Models held against each other: the statistics, and the command."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from toy_sky import Toy

import diffatmo
from diffatmo import comparison, scene, sun
from diffatmo.cli.main import main
from diffatmo.comparison import Outcome
from diffatmo.models import MODELS, Hillaire, Model


@pytest.fixture
def place():
    camera = diffatmo.Equirectangular(16, 32)
    return diffatmo.Scene(diffatmo.earth(), camera, 0.1, sun.direction(zenith=1.0, azimuth=0.0))


def outcome(picture, stderr=None):
    return Outcome(picture, stderr, 0.0, 0.0, 0.0)


def test_a_known_difference_is_found(place):
    """One percent more in the sky and two percent less on the ground, at every wavelength."""
    truth = np.ones((16, 32, 3))
    seen = np.where(np.arange(16)[:, None, None] < 8, 1.01, 0.98) * truth
    found = comparison.errors(place, outcome(seen), outcome(truth))
    assert found.rms == pytest.approx(0.01, abs=1e-6)
    assert found.mean == pytest.approx(0.01, abs=1e-6)
    assert found.largest == pytest.approx(0.01, abs=1e-6)
    assert found.ground == pytest.approx(0.02, abs=1e-6)
    assert found.noise == 0


def test_pixels_count_by_their_solid_angle(place):
    """An error in the row at the zenith weighs 1 - cos(11.25°) of the sky; at 2:1 the rows are 11.25° high."""
    truth = np.ones((16, 32, 3))
    seen = truth.copy()
    seen[0] = 2
    found = comparison.errors(place, outcome(seen), outcome(truth))
    sky = comparison.regions(place)["sky"]
    kept = np.asarray(place.camera.solid_angles())[sky].sum() / (2 * np.pi)
    assert found.mean == pytest.approx((1 - np.cos(np.radians(11.25))) / kept, rel=1e-5)


def test_noise_of_both_pictures_adds(place):
    truth = np.full((16, 32, 3), 2.0)
    noisy = outcome(truth, np.full_like(truth, 0.02))
    found = comparison.errors(place, noisy, outcome(truth, np.full_like(truth, 0.04)))
    assert found.noise == pytest.approx(np.hypot(0.01, 0.02))
    assert comparison.errors(place, noisy, noisy).noise == pytest.approx(0.01)


def test_the_dark_is_left_out(place):
    """Below 1e-5 of the brightest a relative error says nothing; where all is dark there is no error."""
    truth = np.zeros((16, 32, 3))
    truth[:8] = 1
    found = comparison.errors(place, outcome(truth + 1e-7), outcome(truth))
    assert np.isnan(found.ground)
    assert found.rms < 1e-6
    # A night as numbers have it: the brightest is 1e-14, and that is no truth either.
    night = comparison.errors(place, outcome(2e-14 * truth), outcome(1e-14 * truth))
    assert np.isnan(night.rms)


def test_the_sun_and_the_horizon(place):
    """The sky ends at the geometric horizon, 0.32° down from 100 m, and has a hole of 3° around the sun."""
    masks = comparison.regions(place)
    view = np.asarray(place.camera.directions())
    assert not (masks["sky"] & masks["ground"]).any()
    assert (view[masks["ground"]][:, 2] < 0).all()
    assert (view[masks["sky"]] @ np.asarray(place.sun)).max() < np.cos(np.radians(3))
    assert masks["horizon"].sum() < masks["sky"].sum()


def test_outside_the_circle_there_is_nothing():
    """The corners of a fisheye's picture are dark, and no error is told of them."""
    round_one = diffatmo.Scene(diffatmo.earth(), diffatmo.Fisheye(16, 16), 0.1, sun.direction(zenith=1.0, azimuth=0.0))
    seen = comparison.run(round_one, Toy())
    inside = np.asarray(round_one.camera.valid())
    assert (seen.picture[~inside] == 0).all()
    assert (np.isfinite(comparison.relative(round_one, seen, seen)).all(axis=-1) == inside).all()


def test_the_command(tmp_path, capsys, monkeypatch):
    """Single scattering misses a third of the light; everything that was computed is in the folder.

    A model that compiles sooner stands for the default one: it has all orders of scattering as well.
    """
    monkeypatch.setitem(MODELS, "moments", Hillaire)
    folder = tmp_path / "out"
    assert main(["compare", "earth", "-o", str(folder), "--models", "raymarch", "--width", "24"]) == 0
    assert "raymarch" in capsys.readouterr().out
    record = json.loads((folder / "compare.json").read_text())
    assert record["truth"] == "moments"
    assert record["models"]["moments"]["rms"] == 0
    assert -0.5 < record["models"]["raymarch"]["mean"] < -0.1
    picture, truth = (scene.load(folder / f"picture_{name}.exr") for name in ("raymarch", "moments"))
    error = scene.load(folder / "error_raymarch.exr")
    assert error.notes == {"model": "raymarch", "relative_to": "moments"}
    # Single precision in the files.
    np.testing.assert_allclose(error.pixels, picture.pixels / truth.pixels - 1, atol=1e-6)
    assert (folder / "compare.html").read_text().count("<img") == 1
    assert main(["compare", "earth", "-o", str(folder)]) == 2
    assert "--overwrite" in capsys.readouterr().err


class Nothing(Model):
    """Fails as soon as it is asked."""

    def sky(self, atmosphere):
        raise KeyboardInterrupt


def test_what_was_computed_is_kept(tmp_path, monkeypatch):
    """Interrupted in the second model, the picture of the first one is there."""
    made = {"moments": Toy(), "pathtrace": Nothing()}
    monkeypatch.setattr("diffatmo.cli.compare.make_model", lambda name, **_: made[name])
    folder = tmp_path / "out"
    main(["compare", "earth", "-o", str(folder), "--models", "moments,pathtrace", "--width", "8"])
    assert [f.name for f in folder.iterdir()] == ["picture_moments.exr"]


def test_a_night_has_no_errors(tmp_path, monkeypatch, capsys):
    """No light by any model: dashes in the table, null in the file, and a sheet all the same."""

    class Dark(Model):
        def sky(self, atmosphere):
            return eqx.tree_at(lambda sky: sky.atmosphere.solar_irradiance, Toy().sky(atmosphere), jnp.zeros(3))

    monkeypatch.setattr("diffatmo.cli.compare.make_model", lambda name, **_: Dark())
    folder = tmp_path / "out"
    assert main(["compare", "earth", "-o", str(folder), "--models", "moments,hillaire", "--width", "8"]) == 0
    assert "–" in capsys.readouterr().out
    assert json.loads((folder / "compare.json").read_text())["models"]["hillaire"]["rms"] is None
    assert (folder / "compare.png").stat().st_size > 0


@pytest.mark.parametrize("command", [["compare"], ["export", "--luts", "hillaire"]])
def test_no_folder_for_an_atmosphere_that_is_not_there(command, tmp_path, capsys):
    assert main([*command, "nosuch.toml", "-o", str(tmp_path / "out")]) == 2
    assert "nosuch.toml" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--models", "blender"], "--models"),
        (["--truth", "raymarch"], "--truth"),
        (["--width", "0"], "--width"),
        (["--projection", "pinhole", "--upper"], "upper"),
    ],
)
def test_bad_input(arguments, named, tmp_path, capsys):
    assert main(["compare", "earth", "-o", str(tmp_path / "out"), *arguments]) == 2
    assert named in capsys.readouterr().err
