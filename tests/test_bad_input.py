"""Whatever is wrong with the input ends in one clear line, exit status 2, and no traceback."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from diffatmo import atmosphere, imageio, scene, sun
from diffatmo.camera import Equirectangular
from diffatmo.cli.main import main
from diffatmo.render import Scene

ROOT = Path(__file__).parent.parent


def sky(height=4, width=16, value=0.1):
    rng = np.random.default_rng(0)
    return (value * rng.uniform(0.9, 1.1, (height, width, 3))).astype(np.float32)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of good and of broken files."""
    folder = tmp_path_factory.mktemp("files")
    air = atmosphere.earth()
    text = atmosphere.dumps(air)

    def edited(name, old, new):
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    (folder / "good.toml").write_text(text)
    edited("negative.toml", "rayleigh_scale_height_km = 8.0", "rayleigh_scale_height_km = -8.0")
    edited("forward.toml", "mie_g = 0.8", "mie_g = 1.0")
    edited("inside_out.toml", "top_radius_km = ", "top_radius_km = 10.0 # ")
    edited("short.toml", "[\n    680.0,", "[")
    edited("nan.toml", "mie_scale_height_km = 1.2", "mie_scale_height_km = nan")
    edited("typo.toml", "mie_scale_height_km", "mie_scale_hieght_km")
    edited("word.toml", "mie_g = 0.8", 'mie_g = "0.8"')
    edited("missing.toml", "mie_g = 0.8", "")
    edited("unclosed.toml", "mie_g = 0.8", "mie_g = [0.8")
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00\x01")
    atmosphere.save(atmosphere.earth([450.0, 550.0, 650.0, 750.0]), folder / "four.toml")

    header = "altitude_km,sun_zenith_deg,view_zenith_deg,view_azimuth_deg\n"
    tables = {
        "good.csv": header + "0.1,60,30,0\n",
        "empty.csv": "",
        "header.csv": header,
        "column.csv": "altitude_km,sun_zenith_deg,view_zenith_deg\n0.1,60,30\n",
        "twice.csv": header.replace("altitude_km", "sun_zenith_deg,altitude_km") + "60,0.1,60,30,0\n",
        "word.csv": header + "0.1,60,up,0\n",
        "nan.csv": header + "0.1,60,nan,0\n",
        "low.csv": header + "-1,60,30,0\n",
        "steep.csv": header + "0.1,60,200,0\n",
        "ragged.csv": header + "0.1,60,30\n",
        "again.csv": header.replace("\n", ",radiance_680\n") + "0.1,60,30,0,1\n",
    }
    for name, content in tables.items():
        (folder / name).write_text(content)
    (folder / "binary.csv").write_bytes(b"\x80\x81\x82")

    camera = Equirectangular(4, 16, upper=True)
    seen = Scene(air, camera, 0.1, sun.direction(zenith=0.7, azimuth=0.0))
    scene.save(folder / "good.exr", sky(), seen)
    whole = (folder / "good.exr").read_bytes()
    (folder / "cut.exr").write_bytes(whole[:-100])
    (folder / "stub.exr").write_bytes(whole[:60])
    (folder / "empty.exr").touch()
    (folder / "text.exr").write_text("not an image")
    scene.save(folder / "nan.exr", np.full_like(sky(), np.nan), seen)
    scene.save(folder / "black.exr", np.zeros_like(sky()), seen)
    imageio.write_exr(folder / "bare.exr", sky())
    imageio.write_exr(folder / "grey.exr", sky()[..., :1])
    imageio.write_exr(folder / "square.exr", sky(8, 8))
    imageio.write_exr(folder / "other.exr", sky(), wavelengths=[700.0, 500.0, 400.0])
    imageio.write_exr(folder / "damaged.exr", sky(), {scene.ATTRIBUTE: "version = 1\n"})
    imageio.write_exr(
        folder / "notes.exr", sky(), {scene.ATTRIBUTE: "notes = 3\n" + scene.dumps(seen).replace("[notes]", "")}
    )
    imageio.write_exr(folder / "flat.exr", np.full((16, 32, 3), 0.1, np.float32))
    imageio.write_png(folder / "eight_bits.png", sky())
    Image.fromarray((255 * sky()).astype(np.uint8)).save(folder / "photo.jpg")

    scenes = {
        "unknown_key.scene": '[[image]]\nfile = "good.exr"\nsun_zenit_deg = 40\n',
        "unknown_top.scene": 'fre = ["mie_g"]\n[[image]]\nfile = "good.exr"\n',
        "no_image.scene": 'init = "earth"\n',
        "no_file.scene": "[[image]]\nnoise = 0.01\n",
        "table.scene": 'image = "good.exr"\n',
        "image_gone.scene": '[[image]]\nfile = "gone.exr"\n',
        "gone_init.scene": 'init = "gone.toml"\n[[image]]\nfile = "good.exr"\n',
        "free_text.scene": 'free = "mie_g"\n[[image]]\nfile = "good.exr"\n',
        "model.scene": 'model = "pathtrace"\n[[image]]\nfile = "good.exr"\n',
        "steps.scene": 'max_steps = 0\n[[image]]\nfile = "good.exr"\n',
        "starts.scene": 'starts = 0\n[[image]]\nfile = "good.exr"\n',
        "profile.scene": 'init = "earth"\nprofile = ["mie_h"]\n[[image]]\nfile = "good.exr"\n',
        "sun_twice.scene": '[[image]]\nfile = "good.exr"\nsun = "detect"\nsun_zenith_deg = 40\n',
        "time.scene": '[[image]]\nfile = "good.exr"\ntime = 2024-06-21T12:00:00\n',
        "time_alone.scene": '[[image]]\nfile = "good.exr"\ntime = 2024-06-21T12:00:00Z\nlatitude_deg = 48\n',
        "distortion.scene": '[[image]]\nfile = "good.exr"\ndistortion = 0.1\n',
        "sun_word.scene": '[[image]]\nfile = "good.exr"\nsun = "find"\n',
        "loss.scene": 'loss = "l1"\n[[image]]\nfile = "good.exr"\n',
        "prior_text.scene": 'prior = "molecular"\n[[image]]\nfile = "good.exr"\n',
        "prior_kind.scene": '[[image]]\nfile = "good.exr"\n[[prior]]\nkind = "moon"\n',
        "prior_error.scene": '[[image]]\nfile = "good.exr"\n[[prior]]\nname = "mie_g"\nvalue = 0.7\n',
        "prior_name.scene": 'init = "earth"\n[[image]]\nfile = "good.exr"\n'
        '[[prior]]\nname = "mie_h"\nvalue = 0.7\nerror = 0.1\n',
        "prior_ozone.scene": '[[image]]\nfile = "good.exr"\n[[prior]]\nkind = "ozone"\nlatitude_deg = 50\n',
        "prior_type.scene": 'init = "earth"\n[[image]]\nfile = "good.exr"\n[[prior]]\nkind = "aerosol"\ntype = "smog"\n',
        "tie_text.scene": 'tie = "grey"\n[[image]]\nfile = "good.exr"\n',
        "noise.scene": '[[image]]\nfile = "good.exr"\nnoise = "low"\n',
        "toml.scene": "init = \n",
        "nul.scene": '[[image]]\nfile = "a\\u0000b"\n',
        "large.scene": f'[[image]]\nfile = "good.exr"\nnoise = {"9" * 400}\n',
        "larger.scene": f'[[image]]\nfile = "good.exr"\nnoise = {"9" * 5000}\n',
        "deep.scene": f"free = {'[' * 5000}\n",
    }
    for name, content in scenes.items():
        (folder / name).write_text(content)
    return folder


PLACE = ["--altitude-km", "0.1", "--sun-zenith-deg", "40", "--sun-azimuth-deg", "0"]
HERE = ["--time", "2024-06-21T12:00:00+02:00", "--latitude-deg", "48", "--longitude-deg", "11"]
WIDE = ["--mapping", "orthographic", "--fov-deg", "200"]
PANORAMA = ["--projection", "equirectangular", *PLACE]

# Arguments, and what the message has to mention. Names in capitals are files of the fixture.
CASES = {
    # the command line
    "unknown command": (["fitt"], "fitt"),
    "unknown option": (["render", "GOOD.toml", "-o", "new.exr", "--fow", "3"], "--fow"),
    "no output": (["radiance", "GOOD.toml", "GOOD.csv"], "--output"),
    "unknown model": (["radiance", "GOOD.toml", "GOOD.csv", "-o", "new.csv", "--model", "magic"], "magic"),
    # atmospheres
    "seed of too many bits": (
        ["render", "GOOD.toml", "-o", "new.png", "--model", "pathtrace", "--seed", "9" * 20],
        "--seed",
    ),
    "exposure beyond single precision": (
        ["render", "GOOD.toml", "-o", "new.exr", "--exposure", "1e39"],
        "from 1e-30 to 1e+30",
    ),
    "altitude beyond single precision": (
        ["render", "GOOD.toml", "-o", "new.exr", "--altitude-km", "1e39"],
        "from 0 to 1e+09",
    ),
    "azimuth beyond reason": (
        ["render", "GOOD.toml", "-o", "new.exr", "--sun-azimuth-deg", "1e300"],
        "from -3600 to 3600",
    ),
    "no such atmosphere": (["render", "venus", "-o", "new.exr"], "presets"),
    "not TOML": (["render", "UNCLOSED.toml", "-o", "new.exr"], "TOML"),
    "binary atmosphere": (["render", "BINARY.toml", "-o", "new.exr"], "BINARY.toml"),
    "negative length": (["render", "NEGATIVE.toml", "-o", "new.exr"], "rayleigh_scale_height_km"),
    "g of one": (["render", "FORWARD.toml", "-o", "new.exr"], "mie_g"),
    "top below bottom": (["render", "INSIDE_OUT.toml", "-o", "new.exr"], "top_radius_km"),
    "unequal lengths": (["render", "SHORT.toml", "-o", "new.exr"], "wavelengths_nm"),
    "NaN in an atmosphere": (["render", "NAN.toml", "-o", "new.exr"], "mie_scale_height_km"),
    "unknown key in an atmosphere": (["render", "TYPO.toml", "-o", "new.exr"], "mie_scale_hieght_km"),
    "missing key in an atmosphere": (["render", "MISSING.toml", "-o", "new.exr"], "mie_g"),
    "text for a number": (["render", "WORD.toml", "-o", "new.exr"], "mie_g"),
    # tables of directions
    "no such table": (["radiance", "GOOD.toml", "GONE.csv", "-o", "new.csv"], "GONE.csv"),
    "empty table": (["radiance", "GOOD.toml", "EMPTY.csv", "-o", "new.csv"], "empty"),
    "table without rows": (["radiance", "GOOD.toml", "HEADER.csv", "-o", "new.csv"], "no rows"),
    "missing column": (["radiance", "GOOD.toml", "COLUMN.csv", "-o", "new.csv"], "view_azimuth_deg"),
    "column given twice": (["radiance", "GOOD.toml", "TWICE.csv", "-o", "new.csv"], "sun_zenith_deg"),
    "text in a table": (["radiance", "GOOD.toml", "WORD.csv", "-o", "new.csv"], "line 2: view_zenith_deg"),
    "NaN in a table": (["radiance", "GOOD.toml", "NAN.csv", "-o", "new.csv"], "line 2: view_zenith_deg"),
    "below the ground": (["radiance", "GOOD.toml", "LOW.csv", "-o", "new.csv"], "line 2: altitude_km"),
    "angle out of range": (["radiance", "GOOD.toml", "STEEP.csv", "-o", "new.csv"], "180"),
    "ragged table": (["radiance", "GOOD.toml", "RAGGED.csv", "-o", "new.csv"], "line 2: 3 values"),
    "result as input": (["radiance", "GOOD.toml", "AGAIN.csv", "-o", "new.csv"], "radiance_680"),
    "binary table": (["radiance", "GOOD.toml", "BINARY.csv", "-o", "new.csv"], "CSV"),
    # output
    "output exists": (["radiance", "GOOD.toml", "GOOD.csv", "-o", "WORD.csv"], "--overwrite"),
    "no folder for output": (["render", "GOOD.toml", "-o", "gone/new.exr"], "gone"),
    "output is a folder": (["render", "GOOD.toml", "-o", "FOLDER.exr"], "directory"),
    "unknown picture format": (["render", "GOOD.toml", "-o", "new.bmp"], ".exr or .png"),
    "unwritable folder": (["fit", "GOOD.exr", "-o", "/dev/null/out"], "/dev/null/out"),
    "unwritable picture": (["render", "GOOD.toml", "-o", "/dev/null/new.exr"], "/dev/null"),
    "results in a file": (["fit", "GOOD.exr", "-o", "GOOD.csv"], "GOOD.csv"),
    # rendering
    "upper fisheye": (["render", "GOOD.toml", "-o", "new.exr", "--upper", "--projection", "fisheye"], "upper"),
    "field of view of a panorama": (["render", "GOOD.toml", "-o", "new.exr", "--fov-deg", "60"], "fov_deg"),
    "pinhole too wide": (
        ["render", "GOOD.toml", "-o", "new.exr", "--projection", "pinhole", "--fov-deg", "180"],
        "fov_deg",
    ),
    "field of view of nothing": (
        ["fit", "GOOD.exr", "--projection", "fisheye", "--fov-deg", "1e-30"],
        "--fov-deg: got 1e-30, expected a number from 0.01 to 360",
    ),
    "mapping of a pinhole": (
        ["render", "GOOD.toml", "-o", "new.exr", "--projection", "pinhole", "--mapping", "equisolid"],
        "mapping: unknown key; a camera with pinhole projection has",
    ),
    "no distortion": (
        ["render", "GOOD.toml", "-o", "new.exr", "--projection", "pinhole", "--distortion", "much"],
        "--distortion: got 'much', expected numbers, like",
    ),
    "folding distortion": (
        ["render", "GOOD.toml", "-o", "new.exr", "--projection", "pinhole", "--distortion", "-2"],
        "folds the picture",
    ),
    "more than orthographic": (
        [*("render", "GOOD.toml", "-o", "new.exr", "--projection", "fisheye"), *WIDE],
        "fov: got 200 degrees",
    ),
    "no pixels": (["render", "GOOD.toml", "-o", "new.exr", "--width", "0"], "--width"),
    "altitude below ground": (["render", "GOOD.toml", "-o", "new.exr", "--altitude-km", "-1"], "--altitude-km"),
    "sun not a number": (["render", "GOOD.toml", "-o", "new.exr", "--sun-zenith-deg", "nan"], "--sun-zenith-deg"),
    "no exposure": (["render", "GOOD.toml", "-o", "new.exr", "--exposure", "0"], "--exposure"),
    # images
    "no such image": (["fit", "GONE.exr"], "GONE.exr"),
    "truncated EXR": (["fit", "CUT.exr"], "CUT.exr"),
    "EXR cut in its header": (["fit", "STUB.exr"], "STUB.exr"),
    "empty EXR": (["fit", "EMPTY.exr"], "empty"),
    "text called EXR": (["fit", "TEXT.exr"], "TEXT.exr"),
    "all NaN": (["fit", "NAN.exr"], "NAN.exr"),
    "all black": (["fit", "BLACK.exr"], "black"),
    "damaged header": (["fit", "DAMAGED.exr"], "header"),
    "header with a wrong type": (["fit", "NOTES.exr"], "notes"),
    "NUL in a name": (["fit", "--config", "NUL.scene"], "file name"),
    "number too large": (["fit", "--config", "LARGE.scene"], "too large"),
    "number without end": (["fit", "--config", "LARGER.scene"], "TOML"),
    "nested without end": (["fit", "--config", "DEEP.scene"], "TOML"),
    "no header": (["fit", "BARE.exr", "--init", "earth"], "projection"),
    "no header, no altitude": (
        ["fit", "BARE.exr", "--init", "earth", "--projection", "equirectangular"],
        "altitude_km",
    ),
    "no header, no sun": (["fit", "BARE.exr", "--init", "earth", *PANORAMA[:4]], "sun_zenith_deg"),
    "panorama without a sun": (["fit", "BARE.exr"], "give --sun-zenith-deg"),
    "photo of no camera": (["fit", "SQUARE.exr"], "--fov-deg"),
    "no header, no azimuth": (["fit", "BARE.exr", *PANORAMA[:6]], "sun_azimuth_deg"),
    "wrong size": (["fit", "SQUARE.exr", *PANORAMA], "2:1"),
    "one channel": (["fit", "GREY.exr", *PANORAMA], "1 channel"),
    "three channels for four wavelengths": (["fit", "GOOD.exr", "--init", "FOUR.toml"], "3 channels"),
    "other wavelengths": (["fit", "OTHER.exr", *PANORAMA], "700"),
    "eight bits": (["fit", "EIGHT_BITS.png", "--init", "earth", *PANORAMA], "transfer"),
    "JPEG": (["fit", "PHOTO.jpg", "--init", "earth", *PANORAMA], "transfer"),
    "encoded EXR": (["fit", "GOOD.exr", "--transfer", "srgb"], "transfer"),
    "no sun to be seen": (["fit", "FLAT.exr", *PANORAMA[:4], "--sun", "detect"], "sun"),
    "sun out of reach": (["fit", "GOOD.exr", "--sun-zenith-deg", "120"], "--sun-zenith-deg"),
    "mask of another size": (["fit", "GOOD.exr", "--mask", "FLAT.exr"], "mask"),
    "all masked": (["fit", "GOOD.exr", "--mask", "BLACK.exr"], "no pixel is left"),
    "all excluded": (["fit", "GOOD.exr", "--sun-exclusion-deg", "179"], "no pixel is left"),
    # options of a fit
    "unknown parameter": (["fit", "GOOD.exr", "--free", "mie_gg"], "did you mean 'mie_g'"),
    "nothing free": (["fit", "GOOD.exr", "--free", ""], "free"),
    "parameter given twice": (["fit", "GOOD.exr", "--free", "mie_g,mie_g"], "mie_g"),
    "tied but not free": (
        ["fit", "GOOD.exr", "--free", "mie_g", "--tie", "mie_scattering=grey"],
        "tie: 'mie_scattering'",
    ),
    "tie of no kind": (["fit", "GOOD.exr", "--free", "mie_g", "--tie", "mie_scattering"], "--tie"),
    "sun given twice": (["fit", "GOOD.exr", "--sun", "detect", "--sun-zenith-deg", "40"], "contradicts"),
    "time without an offset": (
        ["fit", "GOOD.exr", "--time", "2024-06-21T12:00:00"],
        "--time: got '2024-06-21T12:00:00', expected a date and time with its offset from UTC",
    ),
    "time in words": (["render", "GOOD.toml", "-o", "new.exr", "--time", "noon"], "--time: got 'noon'"),
    "time without a place": (["fit", "GOOD.exr", "--time", "2024-06-21T12:00:00Z"], "latitude_deg: missing"),
    "place without a time": (
        ["render", "GOOD.toml", "-o", "new.exr", "--latitude-deg", "48", "--longitude-deg", "11"],
        "time: missing",
    ),
    "time and angles": (["fit", "GOOD.exr", *HERE, "--sun-azimuth-deg", "3"], "time contradicts sun_azimuth_deg"),
    "time and detection": (["fit", "GOOD.exr", *HERE, "--sun", "detect"], '"detect" contradicts time'),
    "at night": (["fit", "GOOD.exr", *HERE[:3], "0", "--longitude-deg", "-150"], "degrees below the horizon"),
    "scene as an image": (["fit", "GOOD.exr", "GOOD.toml"], "a scene file goes alone, an atmosphere with --init"),
    "atmosphere as a scene": (
        ["fit", "GOOD.toml"],
        "an atmosphere, expected a scene file, which names an atmosphere under init",
    ),
    "scan with a mask": (["fit", "GOOD.csv", "--mask", "GOOD.exr"], "mask: "),
    "scan with a camera": (["fit", "GOOD.csv", "--projection", "fisheye"], "which says itself where it looks"),
    "image and scene": (["fit", "GOOD.exr", "--config", "NOISE.scene"], "contradict"),
    "option without image": (["fit", "--noise", "0.1"], "--noise"),
    "option beside a scene": (["fit", "--config", "NOISE.scene", "--altitude-km", "1"], "--altitude-km"),
    "negative noise": (["fit", "GOOD.exr", "--noise", "-0.1"], "--noise"),
    "noise in percent": (["fit", "GOOD.exr", "--noise", "5"], "--noise: got 5.0, expected a number from 0 to 1"),
    "no noise": (["fit", "GOOD.exr", "--noise", "0", "--noise-floor", "0"], "noise"),
    "no steps": (["fit", "GOOD.exr", "--max-steps", "0"], "--max-steps"),
    "fit by path tracing": (["fit", "GOOD.exr", "--model", "pathtrace"], "pathtrace"),
    # many fits
    "folder without images": (["fit", "FOLDER.exr"], "FOLDER.exr: no image in this folder"),
    "each of nothing": (["fit", "--each"], "--each"),
    "jobs of one fit": (["fit", "GOOD.exr", "--jobs", "2"], "--jobs"),
    "no jobs": (["fit", "GOOD.exr", "--each", "--jobs", "0"], "--jobs"),
    "resume and overwrite": (["fit", "GOOD.exr", "--each", "--resume", "--overwrite"], "contradict"),
    "unknown parameter of all": (["fit", "GOOD.exr", "--each", "--free", "mie_gg"], "did you mean 'mie_g'"),
    "start of all gone": (["fit", "GOOD.exr", "--each", "--init", "gone.toml"], "gone.toml"),
    "unwritable folder for all": (["fit", "GOOD.exr", "--each", "-o", "/dev/null/out"], "/dev/null/out"),
    # scene files
    "no such scene": (["fit", "--config", "GONE.scene"], "GONE.scene"),
    "scene not TOML": (["fit", "--config", "TOML.scene"], "TOML"),
    "unknown key of an image": (["fit", "--config", "UNKNOWN_KEY.scene"], "did you mean 'sun_zenith_deg'"),
    "unknown key of a scene": (["fit", "--config", "UNKNOWN_TOP.scene"], "did you mean 'free'"),
    "scene without images": (["fit", "--config", "NO_IMAGE.scene"], "[[image]]"),
    "image without file": (["fit", "--config", "NO_FILE.scene"], "image 1: file"),
    "image not a table": (["fit", "--config", "TABLE.scene"], "[[image]]"),
    "image gone": (["fit", "--config", "IMAGE_GONE.scene"], "gone.exr"),
    "init gone": (["fit", "--config", "GONE_INIT.scene"], "gone.toml"),
    "free not a list": (["fit", "--config", "FREE_TEXT.scene"], "free"),
    "model without derivatives": (["fit", "--config", "MODEL.scene"], "model"),
    "no steps in a scene": (["fit", "--config", "STEPS.scene"], "max_steps"),
    "no starts in a scene": (["fit", "--config", "STARTS.scene"], "starts: got 0"),
    "profile of no number": (["fit", "--config", "PROFILE.scene"], "did you mean 'mie_g'"),
    "time without an offset in a scene": (
        ["fit", "--config", "TIME.scene"],
        "image 1: time: got 2024-06-21 12:00:00, expected a date and time with its offset from UTC",
    ),
    "time without a place in a scene": (["fit", "--config", "TIME_ALONE.scene"], "longitude_deg: missing"),
    "distortion that is no list": (["fit", "--config", "DISTORTION.scene"], "distortion: got 0.1, expected numbers"),
    "contradiction in a scene": (["fit", "--config", "SUN_TWICE.scene"], "contradicts"),
    "unknown word in a scene": (["fit", "--config", "SUN_WORD.scene"], "detect"),
    "unknown loss": (["fit", "--config", "LOSS.scene"], "loss"),
    "prior that is no table": (["fit", "--config", "PRIOR_TEXT.scene"], "[[prior]]"),
    "prior of no kind": (["fit", "--config", "PRIOR_KIND.scene"], "prior: kind: got 'moon'"),
    "prior without error": (["fit", "--config", "PRIOR_ERROR.scene"], "one of error and relative_error"),
    "prior on nothing": (["fit", "--config", "PRIOR_NAME.scene"], "'mie_h' does not vary"),
    "ozone without a place": (["fit", "--config", "PRIOR_OZONE.scene"], "longitude_deg: missing"),
    "aerosol of no type": (["fit", "--config", "PRIOR_TYPE.scene"], "continental average"),
    "tie that is no table": (["fit", "--config", "TIE_TEXT.scene"], "tie: got 'grey'"),
    "text for a number in a scene": (["fit", "--config", "NOISE.scene"], "image 1: noise"),
}


@pytest.mark.parametrize(("arguments", "mentions"), CASES.values(), ids=CASES)
def test_bad_input(files, tmp_path, monkeypatch, capfd, arguments, mentions):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FOLDER.exr").mkdir()
    for path in files.iterdir():
        (tmp_path / (path.stem.upper() + path.suffix)).symlink_to(path)
    before = sorted(tmp_path.iterdir())
    assert main(arguments) == 2
    shown, errors = capfd.readouterr()
    assert shown == ""
    assert errors.startswith("diffatmo: error: ")
    assert errors.count("\n") == 1
    assert mentions in errors
    assert "Traceback" not in errors
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("name", ["truncated EXR", "unknown option"])
def test_bad_input_of_a_process(files, name):
    arguments, mentions = CASES[name]
    arguments = [str(files / word.lower()) if word.isupper() else word for word in arguments]
    command = [sys.executable, "-m", "diffatmo", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("diffatmo: error: ")
    assert done.stderr.count("\n") == 1
    assert mentions.lower() in done.stderr.lower()
