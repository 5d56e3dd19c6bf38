"""``diffatmo fit``: what goes in, what comes out, and the exit status. A model of a few operations keeps it quick."""

import json
import math
from datetime import datetime
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import tifffile
from quick_sky import TOY_FREE, ToySky, toy_image

from diffatmo import atmosphere, imageio, scene, sun
from diffatmo.camera import Equirectangular, Fisheye, Pinhole
from diffatmo.cli import images, shipped
from diffatmo.cli.common import InputError
from diffatmo.cli.jobs import make_priors
from diffatmo.cli.main import main
from diffatmo.cli.scenefile import FREE, read_scene
from fitting import checkpoint, priors, report, search
from fitting.parameters import select

ROOT = Path(__file__).parent.parent


@pytest.fixture
def start(tmp_path, s1):
    """The atmosphere of the images with some values 30 % off."""
    keys = atmosphere.to_dict(s1)
    keys["rayleigh_scattering_per_km"] = [1.3 * x for x in keys["rayleigh_scattering_per_km"]]
    keys["mie_g"] = 0.6
    atmosphere.save(atmosphere.from_dict(keys), tmp_path / "start.toml")
    return str(tmp_path / "start.toml")


def test_fit_of_single_images(tmp_path, s1, start, toy, capfd):
    images = [toy_image(tmp_path / f"sky_{z}.exr", s1, zenith=z, seed=z) for z in (40, 80)]
    out = tmp_path / "out"
    assert main(["fit", *images, "--init", start, *TOY_FREE, "-o", str(out)]) == 0
    shown, errors = capfd.readouterr()
    assert errors == ""
    assert "step" in shown  # progress
    assert "noise of 1 %" not in shown  # their headers say it
    assert "rayleigh_scattering" in shown  # the table
    assert f"Report: {out / 'report.html'}" in shown
    record = json.loads((out / "fit.json").read_text())
    assert record["converged"]
    assert record["reduced_chi2"] == pytest.approx(1, abs=0.15)
    g = record["parameters"]["mie_g"]
    assert (g["initial"], g["truth"]) == pytest.approx((0.6, 0.8))
    assert abs(g["value"] - 0.8) < 4 * g["standard_error"]
    assert len(record["images"]) == 2
    fitted = atmosphere.load(out / "atmosphere.toml")
    assert np.allclose(fitted.rayleigh_scattering, s1.rayleigh_scattering, rtol=0.02)
    assert np.array_equal(fitted.mie_scattering, s1.mie_scattering)
    assert "<html" in (out / "report.html").read_text()


def test_fit_goes_on_where_it_was_broken_off(tmp_path, s1, start, toy, capfd, monkeypatch):
    """Broken off while the results are written, the worst of moments: what was found is in the checkpoint."""
    image, out = toy_image(tmp_path / "sky.exr", s1, zenith=40, seed=1), tmp_path / "out"
    command = ["fit", image, "--init", start, *TOY_FREE, "-o", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(report, "write", lambda *_, **__: (_ for _ in ()).throw(OSError("No space left on device")))
        assert main([*command, "--resume"]) != 0
    assert "no fit was broken off here" in capfd.readouterr().out
    kept = (out / checkpoint.FILE).read_bytes()
    capfd.readouterr()
    assert main(command) == 2
    assert "--resume" in capfd.readouterr().err
    assert main([*command, "--resume", "--overwrite"]) == 2
    assert main([*command, "--resume", "--free", "mie_g"]) == 2
    assert "belongs to a fit of other images or options" in capfd.readouterr().err
    assert (out / checkpoint.FILE).read_bytes() == kept
    assert main([*command, "--resume"]) == 0
    assert "Going on from" in capfd.readouterr().out
    record = json.loads((out / "fit.json").read_text())
    # It was at the optimum already: the steps before, one to be there again, and one of the finer model's pass, if any.
    assert record["converged"]
    assert not (out / checkpoint.FILE).exists()
    # A process killed after that has left a complete result.
    assert main([*command, "--resume"]) == 2
    assert "the fit here is complete" in capfd.readouterr().err
    (out / checkpoint.FILE).write_bytes(kept)
    assert main([*command, "--overwrite"]) == 0
    assert "Going on" not in capfd.readouterr().out


def test_fit_of_a_scene_file(tmp_path, s1, start, toy):
    """Paths are relative to the file, images without a header are described, and groups share an exposure."""
    folder = tmp_path / "images"
    folder.mkdir()
    Path(start).rename(folder / "start.toml")
    for z in (40, 80):
        toy_image(folder / f"with_{z}.exr", s1, zenith=z, seed=z)
        pixels, _, _ = scene.load(folder / f"with_{z}.exr")
        imageio.write_exr(folder / f"bare_{z}.exr", 2 * pixels)
    (folder / "scene.toml").write_text(
        'init = "start.toml"\nfree = ["rayleigh_scattering", "mie_g"]\ntie = { rayleigh_scattering = "start" }\n'
        'starts = 2\nprofile = ["mie_g"]\n'
        + "".join(
            f'[[image]]\nfile = "bare_{z}.exr"\nprojection = "equirectangular"\naltitude_km = 0.1\n'
            f"sun_zenith_deg = {z}.0\nsun_azimuth_deg = {math.degrees(0.3)}\n"
            'exposure = "camera"\nnoise = 0.01\nview_zenith_max_deg = 90.0\nsun_exclusion_deg = 3\n'
            for z in (40, 80)
        )
    )
    assert main(["fit", str(folder / "scene.toml"), "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert list(record["nuisances"]) == ["exposure_camera"]
    ratio = np.divide(record["parameters"]["rayleigh_scattering"]["value"], s1.rayleigh_scattering)
    assert np.allclose(ratio, ratio[0], rtol=1e-5)
    assert record["nuisances"]["exposure_camera"]["value"] * ratio[0] == pytest.approx(2, rel=0.05)
    assert record["parameters"]["mie_g"]["truth"] is None
    assert record["profiles"][0]["interval_68"][0] < record["parameters"]["mie_g"]["value"]
    assert (tmp_path / "out" / "profile_mie_g.png").exists()


def test_nuisances_of_a_scene_file(tmp_path, s1, start, toy):
    """A camera turned by 1.5° clockwise, which only a free pose finds; angles are in degrees in the file and in the record."""
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40)
    shot = scene.load(image)[1]
    yaw = math.degrees(float(shot.camera.yaw)) - 1.5
    (tmp_path / "scene.toml").write_text(
        f'init = "{start}"\nfree = ["rayleigh_scattering", "mie_g"]\n[[image]]\nfile = "sky.exr"\nyaw_deg = {yaw}\n'
        'pose = "free"\npose_error_deg = 3\npedestal = "free-per-channel"\nhorizon_exclusion_deg = 10\n'
    )
    assert main(["fit", "--config", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "fit.json").read_text())
    found = record["nuisances"]
    assert list(found) == [
        *("pose_sky_east_deg", "pose_sky_north_deg", "pose_sky_up_deg"),
        *("pedestal_sky_680", "pedestal_sky_550", "pedestal_sky_440"),
    ]
    turn = found["pose_sky_up_deg"]
    assert turn["value"] == pytest.approx(-1.5, abs=4 * turn["standard_error"])
    assert turn["standard_error"] < 1
    assert record["images"][0]["pose"] == "free"
    assert [prior["error"] for prior in record["priors"]] == pytest.approx([3])


def test_options_come_before_the_header(tmp_path, s1, start, toy):
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40)
    options = ["--altitude-km", "3", "--sun-zenith-deg", "50", "--noise", "0.5", "--exposure", "free"]
    assert main(["fit", image, "--init", start, *TOY_FREE, *options, "-o", str(tmp_path / "out")]) == 0
    (record,) = json.loads((tmp_path / "out" / "fit.json").read_text())["images"]
    assert record["altitude_km"] == 3
    assert record["sun_zenith_deg"] == pytest.approx(50, abs=1e-3)
    assert record["sun_azimuth_deg"] == pytest.approx(math.degrees(0.3), abs=1e-3)  # of the header


def test_lenses_of_pictures_and_scene_files(tmp_path, start, toy):
    lens = Fisheye(8, 8, fov=math.radians(170), mapping="equisolid", distortion=[0.02, -0.01], circle=0.9)
    said = ["--mapping", "equisolid", "--distortion", "0.02,-0.01", "--circle", "0.9", "--fov-deg", "170"]
    image = tmp_path / "sky.exr"
    assert main(["render", start, "-o", str(image), "--projection", "fisheye", *said, "--width", "8"]) == 0
    shot = scene.load(image)
    assert eqx.tree_equal(shot.scene.camera, lens)

    (tmp_path / "scene.toml").write_text(
        '[[image]]\nfile = "sky.exr"\nprojection = "pinhole"\nfov_deg = 50\ndistortion = [-0.1, 0, 0, 0.001]\n'
    )
    (seen,) = read_scene(tmp_path / "scene.toml").images
    found = images.find_camera(seen.options, shot.pixels, shot)
    assert eqx.tree_equal(found, Pinhole(8, 8, fov_y=np.radians(50.0), distortion=[-0.1, 0, 0, 0.001]))


def test_the_sun_is_found_from_time_and_place(tmp_path, s1, start, toy):
    place = {"latitude_deg": 48.0, "longitude_deg": 11.5, "altitude_km": 0.5}
    expected = np.asarray(sun.position(datetime.fromisoformat("2024-06-21T10:00:00Z"), **place))
    (tmp_path / "scene.toml").write_text(
        '[[image]]\nfile = "sky.exr"\ntime = 2024-06-21T12:00:00+02:00\nlatitude_deg = 48\nlongitude_deg = 11.5\n'
        "altitude_km = 0.5\n"
    )
    toy_image(tmp_path / "sky.exr", s1, zenith=40)
    (seen,) = read_scene(tmp_path / "scene.toml").images
    opened = images.open_image(seen, may_be_photo=False)
    found = images.observe(opened, "sky", atmosphere.load(start)).observation
    np.testing.assert_allclose(found.sun, expected, atol=1e-6)

    said = ["--time", "2024-06-21T12:00:00+02:00", "--latitude-deg", "48", "--longitude-deg", "11.5"]
    again = [start, "-o", str(tmp_path / "new.exr"), "--width", "16", "--altitude-km", "0.5"]
    assert main(["render", *again, *said]) == 0
    np.testing.assert_allclose(scene.load(tmp_path / "new.exr").scene.sun, expected, atol=1e-6)


def test_channels_are_matched_by_wavelength(tmp_path, s1, start, toy):
    """An image whose channels come in another order than the atmosphere's wavelengths gives the same fit."""
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40)
    keys = atmosphere.to_dict(atmosphere.load(start))
    for name, value in keys.items():
        if isinstance(value, list):
            keys[name] = [value[i] for i in (2, 0, 1)]
    atmosphere.save(atmosphere.from_dict(keys), tmp_path / "turned.toml")
    assert main(["fit", image, "--init", str(tmp_path / "turned.toml"), *TOY_FREE, "-o", str(tmp_path / "out")]) == 0
    fitted = atmosphere.load(tmp_path / "out" / "atmosphere.toml")
    assert np.allclose(fitted.rayleigh_scattering, s1.rayleigh_scattering[jnp.array([2, 0, 1])], rtol=0.03)


def test_fit_that_does_not_converge_is_written_all_the_same(tmp_path, s1, start, toy, capfd):
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40)
    out = tmp_path / "out"
    assert main(["fit", image, "--init", start, *TOY_FREE, "--max-steps", "1", "-o", str(out)]) == 1
    assert "not converged in the steps allowed" in capfd.readouterr().out
    assert not json.loads((out / "fit.json").read_text())["converged"]
    assert (out / "atmosphere.toml").exists()
    assert (out / "report.html").exists()


def test_sun_is_found_in_the_picture(tmp_path, s1, start, toy, capfd):
    camera = Equirectangular(32, 64)
    towards = sun.direction(zenith=0.9, azimuth=2.0)
    view = camera.directions()
    pixels = np.array(ToySky(s1).radiance(altitude=jnp.asarray(0.1), view=view, sun=towards).radiance)
    x, y = np.round(camera.pixels(towards)).astype(int)
    pixels[y, x] *= 1000
    imageio.write_exr(tmp_path / "sky.exr", pixels)
    described = ["--projection", "equirectangular", "--altitude-km", "0.1", "--sun", "detect"]
    described += ["--sun-exclusion-deg", "8", "--view-zenith-max-deg", "90"]
    arguments = ["fit", str(tmp_path / "sky.exr"), "--init", start, *TOY_FREE, *described, "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    assert "sky: noise of 1 % of the light, as nothing says what it is: --noise" in capfd.readouterr().out
    (record,) = json.loads((tmp_path / "out" / "fit.json").read_text())["images"]
    assert record["noise_relative"] == pytest.approx([0.01] * 3, rel=0.02)
    assert record["sun_zenith_deg"] == pytest.approx(math.degrees(0.9), abs=3)
    assert record["sun_azimuth_deg"] == pytest.approx(math.degrees(2.0), abs=3)


def test_clipped_pixels_of_a_16_bit_picture_are_left_out(tmp_path, s1, start, toy):
    camera, towards = Equirectangular(16, 32, upper=True), sun.direction(zenith=0.7, azimuth=1.0)
    radiance = ToySky(s1).radiance(altitude=jnp.asarray(0.1), view=camera.directions(), sun=towards).radiance
    white = np.quantile(np.max(radiance, axis=-1), 0.9)
    counts = np.round(65535 * np.minimum(radiance / white, 1)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "sky.tif", counts, photometric="rgb")
    clipped = int(np.sum(np.max(radiance, axis=-1) >= 0.98 * white))
    described = ["--projection", "equirectangular", "--upper", "--altitude-km", "0.1", "--exposure", "free"]
    described += ["--sun-zenith-deg", f"{math.degrees(0.7)}", "--sun-azimuth-deg", f"{math.degrees(1.0)}"]
    described += ["--sun-exclusion-deg", "0", "--transfer", "linear"]
    arguments = ["fit", str(tmp_path / "sky.tif"), "--init", start, *TOY_FREE, *described, "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    record = json.loads((tmp_path / "out" / "fit.json").read_text())
    assert record["images"][0]["pixels_masked"] == {"saturated": clipped}
    assert record["parameters"]["mie_g"]["value"] == pytest.approx(0.8, abs=0.001)


def test_mask_leaves_out_black_pixels(tmp_path, s1, start, toy):
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40, height=8, width=32)
    mask = np.ones((8, 32, 3))
    mask[:, :16] = 0
    imageio.write_png(tmp_path / "mask.png", mask)
    options = ["--mask", str(tmp_path / "mask.png"), "--sun-exclusion-deg", "0"]
    assert main(["fit", image, "--init", start, *TOY_FREE, *options, "-o", str(tmp_path / "out")]) == 0
    (record,) = json.loads((tmp_path / "out" / "fit.json").read_text())["images"]
    assert sum(record["pixels_masked"].values()) == 8 * 16


def test_nothing_is_overwritten_unless_asked(tmp_path, s1, start, toy, capsys):
    image = toy_image(tmp_path / "sky.exr", s1, zenith=40)
    out = tmp_path / "out"
    out.mkdir()
    (out / "fit.json").write_text("mine")
    arguments = ["fit", image, "--init", start, *TOY_FREE, "-o", str(out)]
    assert main(arguments) == 2
    assert "fit.json" in capsys.readouterr().err
    assert (out / "fit.json").read_text() == "mine"
    assert main([*arguments, "--overwrite"]) == 0
    assert (out / "fit.json").read_text() != "mine"


def test_fit_without_arguments_takes_the_shipped_images(tmp_path, s1, start, toy, monkeypatch):
    for name in ("clear", "hazy"):
        folder = tmp_path / "shipped" / name
        folder.mkdir(parents=True)
        toy_image(folder / "sky_40.exr", s1, zenith=40)
        (folder / "scene.toml").write_text(
            f"init = '{start}'\nfree = ['rayleigh_scattering', 'mie_g']\n[[image]]\nfile = 'sky_40.exr'\n"
        )
    monkeypatch.setattr(shipped, "scenes", lambda: sorted((tmp_path / "shipped").glob("*/scene.toml")))
    assert main(["fit", "-o", str(tmp_path / "out")]) == 0
    for name in ("clear", "hazy"):
        assert json.loads((tmp_path / "out" / name / "fit.json").read_text())["converged"]


def test_shipped_images_are_found():
    for path in shipped.scenes():
        assert path.name == "scene.toml"
        assert list(path.parent.glob("*.exr"))


def test_an_interrupted_fit_is_written_and_goes_on(tmp_path, s1, start, toy, capfd, monkeypatch):
    image, out = str(toy_image(tmp_path / "sky.exr", s1, zenith=40)), tmp_path / "out"

    def interrupt(history, tolerance):
        if len(history) > 1:
            raise KeyboardInterrupt

    command = ["fit", image, "--init", start, *TOY_FREE, "-o", str(out)]
    with monkeypatch.context() as patch:
        patch.setattr(search, "steps_left", interrupt)
        assert main(command) == 130
    assert "interrupted by the user; the same command with --resume goes on" in capfd.readouterr().out
    assert json.loads((out / "fit.json").read_text())["converged"] is False
    assert main([*command, "--resume"]) == 0
    assert json.loads((out / "fit.json").read_text())["converged"] is True


def test_default_parameters_are_those_of_an_atmosphere():
    assert set(FREE) <= set(atmosphere.FILE_KEYS)


def test_files_in_the_readme_can_be_read(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    air, described = (block.split("```")[0] for block in text.split("```toml\n")[1:])
    assert atmosphere.dumps(atmosphere.loads(air)) == atmosphere.dumps(atmosphere.earth())
    (tmp_path / "scene.toml").write_text(described)
    spec = read_scene(tmp_path / "scene.toml")
    assert spec.init == str(tmp_path / "start.toml")
    assert spec.images[0].file == tmp_path / "sky_40.exr"
    assert set(spec.tie) <= set(spec.free)
    parameters = select(atmosphere.earth(), spec.free, spec.tie)
    known = [prior for table in spec.priors for prior in make_priors(table, parameters)]
    assert len(known) == 4
    assert priors.collect(known, parameters) is not None


def test_priors_of_a_kind_are_those_of_what_is_free():
    of = lambda free: {prior.name for prior in make_priors({"kind": "molecular"}, select(atmosphere.earth(), free))}
    depths = {f"rayleigh_optical_depth_{nm}" for nm in (680, 550, 440)}
    assert of(["rayleigh_scattering"]) == depths
    # A height alone makes the three depths one number.
    assert of(["rayleigh_scale_height"]) == {"rayleigh_optical_depth_550", "rayleigh_scale_height"}
    with pytest.raises(InputError, match="'molecular' says nothing of what is free \\(mie_g\\)"):
        of(["mie_g"])
