"""Brackets from files: what they show is the truth within the noise that goes into the fit, and mistaken ones are refused."""

import dataclasses
import math
from datetime import UTC, datetime, timedelta
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import photographs
import pytest
import tifffile
from PIL import Image as Pillow
from quick_sky import TOY_FREE, Toy

from diffatmo import brackets, color, imageio, models, scene, sun
from diffatmo.atmosphere import earth, save
from diffatmo.camera import Equirectangular
from diffatmo.cli import bracket, fit, images, many, origin, photo
from diffatmo.cli.common import InputError
from diffatmo.cli.main import main
from diffatmo.cli.scenefile import FitSpec, ImageSpec, read_scene
from diffatmo.exif import Exif
from diffatmo.imageio import Image
from diffatmo.render import Scene

ROOT = Path(__file__).parent.parent
EXPOSURES = [0.01, 0.08, 0.64]
"""Of a sky that is some hundreds bright where it is brightest: the shortest is clipped nowhere but there."""


def light():
    """A rendered sky, up to some 80 in these units; brighter than any exposure can show around the sun."""
    pixels = scene.load(ROOT / "data_synthetic" / "hazy" / "sky_35.exr").pixels
    return np.asarray(pixels / np.median(pixels) * 5, dtype=np.float64)


def seen(shown, exposure, *, white=1.0, seed=0):
    """What a sensor that is clipped at ``white`` makes of it."""
    signal = exposure * shown
    variance = brackets.SHOT * white * signal + (brackets.FLOOR * white) ** 2
    noisy = signal + np.random.default_rng(seed).normal(size=signal.shape) * np.sqrt(variance)
    return np.clip(noisy, 0, white).astype(np.float32)


SKY = (
    'projection = "equirectangular"\nupper = true\naltitude_km = 0.1\nsun_zenith_deg = 35.0\nsun_azimuth_deg = 30.0\n'
    "sun_exclusion_deg = 0.1\n"
)


def written(folder, *, white=1.0, said="", names=("a", "b", "c")):
    """A bracket of EXR files, in no order of exposure, and the scene file that describes it."""
    order = [1, 2, 0]
    for name, number in zip(names, order, strict=True):
        pixels = seen(light(), white * EXPOSURES[number], white=white, seed=number)
        imageio.write_exr(folder / f"{name}.exr", pixels, wavelengths=[680.0, 550.0, 440.0], overwrite=True)
    listed = ", ".join(f'"{name}.exr"' for name in names)
    exposures = [white * EXPOSURES[number] for number in order]
    text = f"[[image]]\nfile = [{listed}]\nexposure_s = {exposures}\nsaturation = {white}\n{SKY}{said}"
    (folder / "scene.toml").write_text(text)
    (spec,) = read_scene(folder / "scene.toml").images
    return spec


@pytest.mark.parametrize("white", [1.0, 4096.0])
def test_a_bracket_is_the_truth_within_its_noise(tmp_path, white):
    """Whatever the unit of the files; and the noise that the fit is told is that of the merged picture."""
    spec = written(tmp_path, white=white)
    opened = images.open_image(spec, may_be_photo=False)
    pictures = [imageio.read_image(file).pixels for file in spec.files]
    alone = brackets.merge(pictures, spec.options["exposure_s"], saturation=white, shot=brackets.SHOT * white,
                           floor=brackets.FLOOR * white)  # fmt: skip
    found = images.observe(opened, "sky", earth()).observation
    assert found.merged == 3
    used = found.used
    assert used.mean() > 0.9
    np.testing.assert_array_equal(found.image[used], alone.pixels[used])
    np.testing.assert_array_equal(found.noise[used], alone.noise[used])
    pulls = ((found.image / light() - 1) / found.noise)[used]
    # Some 10⁴ pixels of three channels: mean and spread are known to 1 %.
    assert pulls.mean() == pytest.approx(0, abs=0.04)
    assert pulls.std() == pytest.approx(1, abs=0.03)
    # What is clipped in the shortest exposure is left out as such, and nothing else is.
    clipped = (light() * min(EXPOSURES) > 1).any(axis=-1)
    assert found.masked.get("saturated", 0) == pytest.approx(clipped.sum(), abs=0.05 * clipped.sum() + 5)


def test_a_stated_noise_comes_on_top(tmp_path):
    spec = written(tmp_path, said="noise = 0.02\n")
    plain = images.observe(images.open_image(written(tmp_path), may_be_photo=False), "sky", earth()).observation
    more = images.observe(images.open_image(spec, may_be_photo=False), "sky", earth()).observation
    used = more.used
    np.testing.assert_allclose(more.noise[used], np.hypot(plain.noise[used], 0.02), rtol=1e-6)


def test_read_noise_that_is_stated_is_that_of_the_files(tmp_path):
    spec = written(tmp_path, said="noise_shot = 2e-4\nnoise_floor = 1e-3\n")
    found = images.open_image(spec, may_be_photo=False)
    pictures = [imageio.read_image(file).pixels for file in spec.files]
    alone = brackets.merge(pictures, spec.options["exposure_s"], shot=2e-4, floor=1e-3)
    np.testing.assert_array_equal(found.image.noise, np.nan_to_num(alone.noise))
    assert not {"noise_shot", "noise_floor", "exposure_s"} & set(found.spec.options)


# Photos -------------------------------------------------------------------------------------------------------------


def camera_notes(exposure, iso=100, **others):
    """Exif of an exposure at f/2.0."""
    camera = {**photographs.CAMERA, 0x829A: ("2I", [(round(1e6 * exposure), 10**6)]), 0x829D: ("2I", [(2, 1)]),
              0x8827: ("H", [iso]), **others}  # fmt: skip
    return photographs.exif_block(photographs.FIRST, camera, photographs.GPS)


def photos(folder, notes=camera_notes):
    """PNG of eight bits, by sRGB, of a sky; exposures by time and by ISO."""
    shown = light()
    for name, exposure, iso in (("a", 0.04, 100), ("b", 0.04, 800), ("c", 0.32, 800)):
        exposed = exposure * iso / 100 / 4
        codes = np.asarray(color.srgb_encode(jnp.asarray(seen(shown, exposed, seed=ord(name)))))
        picture = Pillow.fromarray(np.round(255 * codes).astype(np.uint8))
        picture.save(folder / f"{name}.png", exif=notes(exposure, iso))
    return [folder / f"{name}.png" for name in "abc"]


def test_photos_say_their_exposures_themselves(tmp_path):
    """Linearised, then merged: exposure time, ISO and f-number of Exif."""
    files = photos(tmp_path)
    opened = images.open_image(ImageSpec(files[0], {}, tuple(files[1:])), may_be_photo=True)
    assert opened.photo
    assert "merged from 3 files, exposed 0.01 to 0.64 s; where two show the same, they agree to " in opened.told[0]
    image, shown = opened.image, light()
    used = (image.noise > 0) & (image.pixels < image.saturation)
    assert used.mean() > 0.9
    pulls = ((image.pixels / shown - 1) / image.noise)[used]
    # Steps of eight bits are a third of the noise, which the median does not see.
    assert np.median(np.abs(pulls)) == pytest.approx(0.6745, rel=0.1)
    assert image.saturation == pytest.approx(1 / 0.01)
    # That they agree says that the curve which was undone is the one that was applied, and no other is to be fitted.
    assert opened.told[1] == "transfer function: that of sRGB, by which the exposures agree"
    assert not opened.encoded


@pytest.mark.parametrize("exponent", [1.0, 1.1, 0.8])
def test_exposures_tell_a_transfer_function_that_is_wrong(exponent):
    """Of a picture that went through a power of its light the ratio of two exposures is that power of the stated one."""
    shown = np.geomspace(1, 20, 3000).reshape(20, 50, 3)
    pictures = [(np.minimum(t * shown, 1) ** exponent).astype(np.float32) for t in (0.02, 0.1)]
    taken = [Image(picture, {}, None, saturation=1.0) for picture in pictures]
    merged = bracket.merge([Path("a"), Path("b")], taken, {"exposure_s": [0.02, 0.1]})
    assert merged.exponent_error == pytest.approx(abs(exponent - 1), rel=1e-3, abs=1e-5)
    assert merged.told.endswith(f"they agree to {100 * abs(exponent - 1) * math.log(5):.1f} %")


def test_a_merged_photo_goes_into_a_fit_with_its_noise(tmp_path):
    """A relative error that is stated on top of it; with it nothing is taken to be shared."""
    files = photos(tmp_path)
    imageio.write_png(tmp_path / "mask.png", np.ones((*light().shape[:2], 3), np.float32))
    said = {"projection": "equirectangular", "sun_zenith_deg": 35.0, "sun_azimuth_deg": 30.0, "noise": 0.03,
            "mask": str(tmp_path / "mask.png"), "sun_exclusion_deg": 5.0}  # fmt: skip
    opened = images.open_image(ImageSpec(files[0], said, tuple(files[1:])), may_be_photo=True)
    found = images.observe_photo(opened, "a")
    assert found.assumed[0].startswith("merged from 3 files")
    assert found.observation.merged == 3
    # Averages over blocks have less noise, in proportion to the number of pixels in them that are used: whole ones.
    block = found.observation.block
    noise = np.hypot(opened.image.noise, 0.03)
    height, width = (size // block for size in noise.shape[:2])
    squares = (noise * opened.image.pixels)[: height * block, : width * block].reshape(height, block, width, block, 3)
    expected = np.sqrt(np.square(squares).sum(axis=(1, 3))) / block**2
    got = (found.observation.noise * found.observation.image)[:height, :width]
    whole = slice(2, height // 2), slice(0, width)
    np.testing.assert_allclose(np.median(got[whole] / expected[whole]), 1, rtol=1e-3)


def test_a_raw_bracket_goes_through_its_matrix(tmp_path):
    """Merged as the sensor saw it, at exposures that are stated; colours and noise then go through the matrix."""
    rng = np.random.default_rng(0)
    for name, factor in (("a", 1), ("b", 8)):
        counts = 130 + factor * rng.integers(200, 300, size=(30, 32))
        photographs.dng(tmp_path / f"{name}.dng", counts.astype(np.uint16), black=(130,) * 4, white=4130)
    spec = ImageSpec(tmp_path / "a.dng", {"exposure_s": [0.01, 0.08]}, (tmp_path / "b.dng",))
    opened = images.open_image(spec, may_be_photo=True)
    assert opened.image.to_xyz is not None
    # 250 of 4000 counts, in a hundredth of a second; at half the size.
    assert opened.image.pixels.shape == (15, 16, 3)
    assert opened.image.pixels.mean() == pytest.approx(6.25, rel=0.03)
    assert not opened.encoded


def test_noise_goes_through_a_matrix_and_averages():
    """Against the spread of many noisy pictures."""
    rng = np.random.default_rng(0)
    mean, noise = np.array([0.4, 0.5, 0.3], np.float32), np.array([0.03, 0.02, 0.05], np.float32)
    side = 2 * photo.LONGEST_SIDE
    shape = (40, side, 3)
    pixels = (mean * (1 + noise * rng.normal(size=shape))).astype(np.float32)
    noisy = Image(pixels, {}, None, noise=np.broadcast_to(noise * mean, shape) / pixels)
    matrix = np.linalg.inv(photographs.XYZ_TO_CAMERA)
    through = photo._srgb(noisy, matrix)
    small = photo._shrunk(through)
    assert small.pixels.shape == (20, side // 2, 3)
    for made in (through, small):
        # 20 000 pixels: a spread is known to half a percent.
        spread = made.pixels.std(axis=(0, 1))
        np.testing.assert_allclose(np.median(made.noise * made.pixels, axis=(0, 1)), spread, rtol=0.03)


def test_what_is_clipped_stays_so_through_a_matrix():
    """A matrix may take a clipped channel to any value, and one that is not clipped above white."""
    pixels = np.full((1, 3, 3), 0.3, np.float32)
    pixels[0, 0] = 0.3, 1.0, 0.2
    pixels[0, 1] = 0.9, 0.1, 0.1
    made = photo._srgb(Image(pixels, {}, None, saturation=1.0), np.linalg.inv(photographs.XYZ_TO_CAMERA))
    clipped = (made.pixels >= photo.SATURATION * made.saturation).any(axis=-1)
    np.testing.assert_array_equal(clipped, [[True, False, False]])


# The scene in the header --------------------------------------------------------------------------------------------


def test_rendered_files_know_their_exposures(tmp_path, s1):
    """Exposure, camera and sun are in the header; what is merged is per unit of exposure."""
    shown = np.random.default_rng(0).uniform(1, 4, (4, 16, 3)).astype(np.float32)
    made = Scene(s1, Equirectangular(4, 16, upper=True), 0.1, sun.direction(zenith=0.7, azimuth=0.0))

    def write(name, exposure, of=made):
        scene.save(
            tmp_path / f"{name}.exr", np.minimum(exposure * shown, 1), dataclasses.replace(of, exposure=exposure)
        )

    write("a", jnp.asarray(0.1))
    write("b", jnp.asarray(0.4))
    spec = ImageSpec(tmp_path / "a.exr", {"saturation": 1.0}, (tmp_path / "b.exr",))
    opened = images.open_image(spec, may_be_photo=False)
    assert not opened.photo
    found = images.observe(opened, "sky", s1)
    np.testing.assert_allclose(found.observation.image, shown, rtol=1e-5)
    assert found.observation.exposure_value == 1
    assert found.truth is not None
    write("other", jnp.asarray(0.4), dataclasses.replace(made, altitude=jnp.asarray(0.2)))
    with pytest.raises(InputError, match=r"other.exr: another scene in its header than .*a.exr; expected exposures of"):
        images.open_image(dataclasses.replace(spec, others=(tmp_path / "other.exr",)), may_be_photo=False)


# What is refused ----------------------------------------------------------------------------------------------------

TIME = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
NOTES = Exif(exposure_s=0.01, iso=100, f_number=1.0, model="X", lens="L", focal_length_mm=24.0, focal_length_35mm_mm=36.0,
             compass_deg=359.5, latitude_deg=48.0, longitude_deg=11.0, time=TIME)  # fmt: skip
FLAT = np.full((2, 4, 3), 0.06, np.float32)


def taken(level=1.0, *, pixels=FLAT, exif=None, **others):
    notes = NOTES._replace(exposure_s=0.01 * level) if exif is None else exif
    return Image(level * pixels, {}, None, **{"exif": notes, "saturation": 1.0} | others)


def differing(**notes):
    return taken(4.0, exif=NOTES._replace(exposure_s=0.04, **notes))


MISTAKEN = {
    "size": (taken(4.0, pixels=FLAT[:, :2]), {}, "b: a picture of 2 x 2 pixels of 3 channels, but a has 4 x 2 pixels"),
    "channels": (taken(4.0, pixels=FLAT[..., :1]), {}, "b: a picture of 4 x 2 pixels of 1 channels, but a has"),
    "wavelengths": (taken(4.0)._replace(wavelengths=(1.0, 2.0, 3.0)), {}, "b: wavelengths"),
    "orientation": (taken(4.0, turned=3), {}, "b: an orientation in Exif of 3, but a has 1; expected exposures of one view"),
    "camera": (differing(model="Y"), {}, "b: camera Y, but a has X"),
    "lens": (differing(lens="M"), {}, "b: lens M, but a has L"),
    "focal length": (differing(focal_length_mm=35.0), {}, "b: a focal length of 35.0 mm, but a has 24.0 mm; expected expo"),
    "in 35 mm terms": (differing(focal_length_35mm_mm=50.0), {}, "b: a focal length in 35 mm terms of 50.0 mm, but a has 36"),
    "compass": (differing(compass_deg=3.0), {}, "b: a compass bearing of 3°, but a has 359.5°"),
    "place": (differing(latitude_deg=48.1), {}, "b: a latitude of 48.1°, but a has 48.0°"),
    "time": (differing(time=TIME + timedelta(hours=1)), {}, "b: the time 2024-06-21 11:30:00+00:00, but a has 2024-06-21 10"),
    "no exposure": (differing(iso=None), {}, "exposure_s: b does not say its exposure time, ISO and f-number; give"),
    "equal exposures": (taken(1.0), {}, "a: every picture has the exposure 0.01, expected different ones"),
    "no positive ones": (taken(4.0), {"exposure_s": [0.01, 0.0]}, "a: exposures 0.01, 0, expected positive numbers"),
    "swapped": (taken(4.0), {"exposure_s": [0.04, 0.01]}, "a: 0.25 times as bright as b, where both are exposed well"),
    "developed": (taken(2.0, taken_as_linear=True), {"exposure_s": [0.01, 0.04]}, "b: 2 times as bright as a, where both are "
                  "exposed well, but by their exposures it would be 4 times; expected the exposures in the order of the files, "
                  "or --transfer srgb if they were developed for a screen"),
    "no saturation": (taken(4.0), {"saturation": None}, "saturation: a does not say at which value it is clipped"),
    "no noise": (taken(4.0), {"noise_shot": 0.0}, "a: saturation = 1, shot = 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKEN)
def test_what_is_no_bracket_is_refused(name):
    other, options, message = MISTAKEN[name]
    with pytest.raises(InputError) as caught:
        bracket.merge([Path("a"), Path("b")], [taken(), other], options)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_small_differences_are_none():
    """Of a compass that trembles about north, half a minute later."""
    other = differing(compass_deg=0.3, time=TIME + timedelta(seconds=30))
    merged = bracket.merge([Path("a"), Path("b")], [taken(), other], {}).image
    np.testing.assert_allclose(merged.pixels, 6, rtol=1e-6)


def test_files_tell_how_they_were_turned(tmp_path):
    """Also where they are turned already: as RAW, HEIF and PNG come."""
    codes = np.zeros((4, 6, 3), np.uint8) + 100
    block = photographs.exif_block({**photographs.FIRST, 0x112: ("H", [3])})
    photographs.jpeg(tmp_path / "a.jpg", codes, block)
    photographs.heif(tmp_path / "a.heic", codes, block)
    photographs.dng(tmp_path / "a.dng", np.full((30, 32), 1000, np.uint16), orientation=3)
    tifffile.imwrite(
        tmp_path / "a.tif", codes.astype(np.float32), photometric="rgb", extratags=[(0x112, "H", 1, 3, True)]
    )
    for name, transfer in (("a.jpg", "srgb"), ("a.heic", "srgb"), ("a.dng", None), ("a.tif", None)):
        assert imageio.read_image(tmp_path / name, transfer=transfer).turned == 3, name


COMMANDS = {
    "one file": (["a.exr", "--bracket"], "--bracket: got 1 IMAGE, expected at least two exposures of one view"),
    "none": (["--bracket"], "--bracket: got 0 IMAGE"),
    "a folder": (["a.exr", "folder", "--bracket"], "--bracket: folder is a folder, expected the files of one view by name"),
    "each": (["a.exr", "b.exr", "--bracket", "--each"], "--bracket and --each contradict each other"),
    "exposure of one": (["a.exr", "--exposure-s", "1,2"], "exposure_s: of one file, expected a bracket: several files with"),
    "too many": (["a.exr", "b.exr", "--bracket", "--exposure-s", "1,2,3"], "exposure_s: got 3 numbers for 2 files"),
    "words": (["a.exr", "b.exr", "--bracket", "--exposure-s", "short"], "--exposure-s: got 'short', expected numbers above 0"),
    "not there": (["a.exr", "gone.exr", "--bracket", "--exposure-s", "1,2"], "gone.exr: cannot be read"),
    "scene of one": (["--config", "one.toml"], "image 1: file: expected the name of an image file, or a list of those of sev"),
    "scene of none": (["--config", "none.toml"], "image 1: file: expected"),
    "a scan": (["scan.npz", "a.exr", "--bracket"], "scan.npz: a scan in a bracket, expected pictures"),
}  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_commands_that_make_no_bracket(tmp_path, monkeypatch, capfd, name):
    arguments, message = COMMANDS[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    for file in ("a.exr", "b.exr"):
        imageio.write_exr(tmp_path / file, FLAT)
    (tmp_path / "one.toml").write_text('[[image]]\nfile = ["a.exr"]\n')
    (tmp_path / "none.toml").write_text('[[image]]\nfile = ["a.exr", ""]\n')
    assert main(["fit", *arguments]) == 2
    shown, errors = capfd.readouterr()
    assert shown == ""
    assert errors.startswith("diffatmo: error: ")
    assert errors.count("\n") == 1
    assert message in errors


# The whole way ------------------------------------------------------------------------------------------------------


def test_files_on_the_command_line_are_one_image(tmp_path, s1, monkeypatch):
    """With --bracket; without it they are several."""
    monkeypatch.setitem(models.MODELS, "moments", Toy)
    monkeypatch.chdir(tmp_path)
    jobs = []
    monkeypatch.setattr(fit, "run", lambda job, *_, **__: jobs.append(job) or 0)
    files = [str(file) for file in written(tmp_path).files]
    save(s1, tmp_path / "start.toml")
    arguments = ["fit", *files, "--projection", "equirectangular", "--upper", "--altitude-km", "0.1", "--sun-zenith-deg",
                 "35", "--sun-azimuth-deg", "30", "--init", str(tmp_path / "start.toml"), *TOY_FREE]  # fmt: skip
    assert main([*arguments, "--bracket", "--exposure-s", "0.08,0.64,0.01", "--saturation", "1"]) == 0
    assert main(arguments) == 0
    merged, apart = jobs
    assert [(seen.name, seen.merged) for seen in merged.observations] == [("a", 3)]
    assert merged.assumed[0].startswith(
        "a: merged from 3 files, exposed 0.01 to 0.64 s; where two show the same, they agree"
    )
    assert [(seen.name, seen.merged) for seen in apart.observations] == [("a", 1), ("b", 1), ("c", 1)]


def test_results_know_all_files_of_a_bracket(tmp_path):
    """A folder of results is not complete any more when any of the exposures changes."""
    spec = written(tmp_path)
    whole = FitSpec((spec,))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / origin.FILE).write_text(origin.dumps(whole))
    assert origin.difference(tmp_path / "out", whole) is None
    shorter = dataclasses.replace(spec, others=spec.others[:1])
    assert origin.difference(tmp_path / "out", FitSpec((shorter,))) == "the image has changed"
    imageio.write_exr(spec.others[1], FLAT, overwrite=True)
    assert origin.difference(tmp_path / "out", whole) == "the image has changed"
    assert many.folder_names([image.file for image in whole.images]) == ["a"]
