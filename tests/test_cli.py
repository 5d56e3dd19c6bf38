"""The command line: what goes in, what comes out, and the exit status. A model of a few operations keeps it quick."""

import csv
import math
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import click
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import radiance
from quick_sky import Toy

from diffatmo import atmosphere, imageio, models, scene, sun
from diffatmo.camera import Equirectangular, Fisheye, Pinhole
from diffatmo.cli import cache
from diffatmo.cli import radiance as radiance_command
from diffatmo.cli.common import INTERRUPTED
from diffatmo.cli.main import main
from diffatmo.cli.render import picture_size

ROOT = Path(__file__).parent.parent


@pytest.fixture
def atm(tmp_path, s1):
    atmosphere.save(s1, tmp_path / "atm.toml")
    return str(tmp_path / "atm.toml")


def write_csv(path, header, rows):
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return str(path)


def read_csv(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


DIRECTIONS = ["altitude_km", "sun_zenith_deg", "view_zenith_deg", "view_azimuth_deg"]


def direct(model, air, row):
    """Radiance and transmittance of one row, asked of the library."""
    zenith, view, azimuth = (math.radians(float(row[name])) for name in DIRECTIONS[1:])
    ray = radiance(
        model.sky(air),
        float(row["altitude_km"]),
        sun.direction(zenith=view, azimuth=azimuth),
        sun.direction(zenith=zenith, azimuth=0.0),
    )
    return np.concatenate([ray.radiance, ray.transmittance])


def test_radiance_keeps_rows_columns_and_order(tmp_path, atm, s1, toy, monkeypatch):
    monkeypatch.setattr(radiance_command, "CHUNK", 4)
    rng = np.random.default_rng(1)
    header = ["name", "view_azimuth_deg", " sun_zenith_deg", "view_zenith_deg", "altitude_km"]
    rows = [
        [f"ray {i}, so", *(f"{x:.3f}" for x in rng.uniform((-180, 0, 0, 0), (360, 96, 180, 20)))] for i in range(11)
    ]
    table = write_csv(tmp_path / "in.csv", header, rows)
    assert main(["radiance", atm, table, "-o", str(tmp_path / "out.csv")]) == 0
    with open(tmp_path / "out.csv", newline="") as file:
        written = list(csv.reader(file))
    added = [f"{quantity}_{nm}" for quantity in ("radiance", "transmittance") for nm in (680, 550, 440)]
    assert written[0] == [*map(str.strip, header), *added]
    assert [row[:5] for row in written[1:]] == rows
    for row in read_csv(tmp_path / "out.csv"):
        expected = direct(Toy(), s1, row)
        assert [float(row[name]) for name in added] == pytest.approx(expected, rel=2e-6)


def test_radiance_in_double_precision(tmp_path, atm, toy):
    table = write_csv(tmp_path / "in.csv", DIRECTIONS, [[0.5, 60, 30, 10]])
    values = {}
    for name, options in {"single": [], "double": ["--x64"]}.items():
        assert main(["radiance", atm, table, "-o", str(tmp_path / name), *options]) == 0
        values[name] = read_csv(tmp_path / name)[0]["radiance_680"]
    assert len(values["double"]) > len(values["single"]) + 4  # digits
    assert float(values["double"]) == pytest.approx(float(values["single"]), rel=1e-6)
    assert jnp.zeros(()).dtype == jnp.float32  # the precision of this process is untouched


def test_radiance_names_wavelengths_with_as_few_digits_as_possible():
    air = atmosphere.earth([680.0, 550.55])
    assert radiance_command.new_columns(air, models.Moments()) == [
        "radiance_680",
        "radiance_550.55",
        "transmittance_680",
        "transmittance_550.55",
    ]


def test_radiance_as_a_process_agrees_with_the_library(tmp_path, atm, s1):
    rows = [[0.5, 60, 0, 0], [0.5, 60, 85, 90], [0.5, 60, 150, 180], [2.0, 91, 89.9, 0]]
    table = write_csv(tmp_path / "in.csv", DIRECTIONS, rows)
    out = tmp_path / "out.csv"
    command = [sys.executable, "-m", "diffatmo", "radiance", atm, table, "-o", str(out), "--model", "raymarch"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    for row in read_csv(out):
        written = [float(value) for name, value in row.items() if name not in DIRECTIONS]
        assert written == pytest.approx(direct(models.RayMarch(), s1, row), rel=1e-4)


def test_radiance_may_replace_an_empty_file(tmp_path, atm, toy):
    table = write_csv(tmp_path / "in.csv", DIRECTIONS, [[0.5, 60, 30, 10]])
    (tmp_path / "out.csv").touch()
    assert main(["radiance", atm, table, "-o", str(tmp_path / "out.csv")]) == 0
    assert main(["radiance", atm, table, "-o", str(tmp_path / "out.csv")]) == 2
    assert main(["radiance", atm, table, "-o", str(tmp_path / "out.csv"), "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--width", "16"], Equirectangular(8, 16)),
        (["--height", "8", "--projection", "fisheye", "--fov-deg", "120"], Fisheye(8, 8, math.radians(120))),
        (
            ["--width", "12", "--projection", "pinhole", "--fov-deg", "40", "--yaw-deg", "30", "--pitch-deg", "10"],
            Pinhole(8, 12, math.radians(40), math.radians(30), math.radians(10)),
        ),
    ],
)
def test_render_writes_the_scene_it_was_asked_for(tmp_path, toy, options, expected):
    path = tmp_path / "sky.exr"
    place = ["--altitude-km", "2", "--sun-zenith-deg", "70", "--sun-azimuth-deg", "20", "--exposure", "3"]
    assert main(["render", "mars", "-o", str(path), *options, *place]) == 0
    pixels, shown, notes = scene.load(path)
    assert notes == {"model": "moments", "sun_disc": False}
    assert type(shown.camera) is type(expected)
    assert np.allclose(shown.camera.directions(), expected.directions(), atol=1e-6)
    assert float(shown.altitude) == 2.0
    assert np.allclose(shown.sun, sun.direction(zenith=math.radians(70), azimuth=math.radians(20)))
    assert atmosphere.dumps(shown.atmosphere) == atmosphere.dumps(atmosphere.mars())
    sky = Toy().sky(shown.atmosphere)
    radiance = sky.radiance(altitude=shown.altitude, view=expected.directions(), sun=shown.sun).radiance
    lit = np.asarray(expected.valid())
    assert np.allclose(pixels[lit], 3 * np.asarray(radiance)[lit], rtol=1e-5)


def test_render_of_several_files(tmp_path, toy):
    """The exposure of a PNG is chosen by the picture; asked for, it is that of both files."""
    for name, options in {"chosen": [], "asked": ["--exposure", "0.01"]}.items():
        outputs = [word for suffix in ("exr", "png") for word in ("-o", str(tmp_path / f"{name}.{suffix}"))]
        assert main(["render", "earth", "--width", "8", "--upper", *outputs, *options]) == 0
    linear = {name: scene.load(tmp_path / f"{name}.exr").pixels for name in ("chosen", "asked")}
    shown = {name: imageio.read_image(tmp_path / f"{name}.png", transfer="srgb").pixels for name in linear}
    assert np.allclose(linear["asked"], 0.01 * linear["chosen"], rtol=1e-5)
    assert shown["chosen"].shape == (2, 8, 3)
    assert 0.4 < shown["chosen"].max() <= 1
    assert shown["asked"].max() < 0.1


@pytest.mark.parametrize(
    ("options", "width", "height", "expected"),
    [
        ({"projection": "equirectangular"}, None, None, (512, 256)),
        ({"projection": "equirectangular", "upper": True}, 128, None, (128, 32)),
        ({"projection": "equirectangular", "upper": True}, 128, 64, (128, 64)),
        ({"projection": "fisheye"}, None, 100, (100, 100)),
        ({"projection": "pinhole"}, 300, None, (300, 200)),
    ],
)
def test_pixels_are_square_unless_said_otherwise(options, width, height, expected):
    assert picture_size(options, width, height) == expected


def test_a_scheduler_ends_a_run_like_ctrl_c(monkeypatch):
    assert threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(cache, "enable", lambda: signal.raise_signal(signal.SIGTERM))
    try:
        assert main(["render", "--help"]) == INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_fault_of_ours_keeps_its_traceback(tmp_path, atm, monkeypatch):
    def broken():
        raise ValueError("a fault")

    monkeypatch.setitem(models.MODELS, "moments", broken)
    table = write_csv(tmp_path / "in.csv", DIRECTIONS, [[0.5, 60, 30, 10]])
    with pytest.raises(ValueError, match="a fault"):
        main(["radiance", atm, table, "-o", str(tmp_path / "out.csv")])


@pytest.mark.parametrize(
    ("preset", "caches", "expected"),
    [(None, "here", "here/diffatmo"), (None, "/dev/null", None), ("", "here", ""), ("mine", "here", "mine")],
)
def test_compiled_programs_are_kept_where_the_user_keeps_caches(tmp_path, monkeypatch, preset, caches, expected):
    monkeypatch.delitem(sys.modules, "jax")  # as at the start of a process
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / caches))
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    if preset is not None:
        monkeypatch.setenv(cache.VARIABLE, preset)
    cache.enable()
    found = os.environ.get(cache.VARIABLE)
    assert found == (str(tmp_path / expected) if expected == "here/diffatmo" else expected)


def test_help_has_every_option_under_a_heading(capsys):
    """Those of the camera under that of the camera, and so on; a heading that no option begins would be lost."""
    from diffatmo.cli.fit import HEADINGS, fit

    assert main(["fit", "--help"]) == 0
    shown = capsys.readouterr().out
    assert {option.name for option in fit.params} >= set(HEADINGS)
    parts = re.split(r"^(\S.*):$", shown, flags=re.MULTILINE)
    under = dict(zip(parts[1::2], parts[2::2], strict=True))
    assert [*under] == [*HEADINGS.values()]
    assert "--fov-deg" in under["Camera"]
    assert "--sun-zenith-deg" in under["Place and sun"]
    assert "--pose-error-deg" in under["What may be off"]
    for option in fit.params:
        if isinstance(option, click.Option):
            assert sum(option.opts[0] in text for text in under.values()) >= 1


def test_help_and_version(capsys):
    for arguments in ([], ["--help"], ["fit", "-h"], ["radiance", "--help"], ["render", "--help"], ["--version"]):
        assert main(arguments) == 0
        shown, errors = capsys.readouterr()
        assert "diffatmo" in shown
        assert errors == ""
    assert jax.config.jax_enable_x64 is False
