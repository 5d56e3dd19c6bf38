"""Many images in one run: whatever happens to one of them, or to the run, nothing that was done is lost.

Most tests put a stand-in for the fit (`stub_fit.py`), as they are about what goes on around it; its processes are real.
"""

import csv
import dataclasses
import io
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import stub_fit
import toy_fit
from quick_sky import toy_image

from diffatmo import atmosphere, folders, imageio
from diffatmo.cli import many, origin, results, workers
from diffatmo.cli.common import InputError
from diffatmo.cli.main import main
from diffatmo.cli.scenefile import FitSpec, ImageSpec

STUB = many.Fitter(stub_fit.prepare, stub_fit.run)
HERE = Path(__file__).parent


def images(folder, **texts):
    for name, text in texts.items():
        (folder / f"{name}.txt").write_text(str(text))
    return sorted(folder.glob("*.txt"))


def table(output):
    with open(output / results.FILE, newline="") as file:
        return {Path(row["file"]).stem: row for row in csv.DictReader(file)}


def fit(files, output, **options):
    return many.fit_each(stub_fit.spec(*files), output, STUB, **options)


def leftovers(output):
    return [path for path in output.rglob("*") if path.name.endswith(".part")]


# What happens to one image --------------------------------------------------------------------------------------------


def test_a_row_for_every_image_whatever_becomes_of_it(tmp_path, capfd):
    """Read, unreadable, not converging, gone, killed, and a fault of the program itself: the others go on."""
    files = images(tmp_path, a=1, b="no number", c=200, d=4, e=5, f="a fault", g=7)
    (tmp_path / "d.txt.fault").write_text("self write")
    files[4].unlink()
    out = tmp_path / "out"
    assert fit(files, out, jobs=2) == 1
    rows = table(out)
    assert list(rows) == list("abcdefg")
    assert [row["status"] for row in rows.values()] == [
        "converged", "failed", "not converged", "failed", "failed", "failed", "converged",
    ]  # fmt: skip
    assert rows["b"]["message"] == f"{tmp_path / 'b.txt'}: not a number"
    assert "ended by signal 9 (SIGKILL)" in rows["d"]["message"]
    assert rows["e"]["message"] == f"{tmp_path / 'e.txt'}: No such file or directory"
    assert "exit status 1" in rows["f"]["message"]
    assert (rows["g"]["mie_g"], rows["g"]["mie_g_standard_error"]) == ("7.0", "0.1")
    assert sorted(path.name for path in out.iterdir()) == ["a", "c", "g", "results.csv"]
    shown, errors = capfd.readouterr()
    assert "2 converged, 1 not converged, 4 failed" in shown
    assert "KeyError: 'a fault'" in errors  # its traceback
    # And again: what is complete stays, what failed is tried again.
    before = (out / "a" / results.RECORD).stat().st_mtime_ns
    images(tmp_path, b=2, f=6)
    assert fit(files, out, resume=True) == 1
    assert [row["status"] for row in table(out).values()] == [
        "converged", "converged", "not converged", "converged", "failed", "converged", "converged",
    ]  # fmt: skip
    assert (out / "a" / results.RECORD).stat().st_mtime_ns == before
    assert "3 of 7 images fitted already" in capfd.readouterr().out
    assert not leftovers(out)


def test_results_that_cannot_be_written(tmp_path, monkeypatch, capfd):
    """A full disk: the run says so, goes on, ends with 1, and keeps the table it had."""
    files = images(tmp_path, a=1, b=2)
    out = tmp_path / "out"
    assert fit(files[:1], out) == 0
    kept = (out / results.FILE).read_text()
    write = imageio.atomic_write

    def full(path, **options):
        if path.name == results.FILE:
            raise imageio.ImageError(f"{path}: cannot be written: No space left on device")
        return write(path, **options)

    monkeypatch.setattr(imageio, "atomic_write", full)
    (out / "b").write_text("in the way of the folder")
    assert fit(files, out, resume=True) == 1
    assert (out / results.FILE).read_text() == kept
    shown, errors = capfd.readouterr()
    assert "b: failed" in shown
    assert errors == f"diffatmo: error: {out / results.FILE}: cannot be written: No space left on device\n"


# What happens to the run ----------------------------------------------------------------------------------------------


def start(output, files, jobs):
    code = "import stub_fit; stub_fit.main()"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)])}
    command = [sys.executable, "-c", code, str(output), str(jobs), *map(str, files)]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def processes(group):
    """Those of a session that are alive."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[3]) == group and fields[0] != "Z":
            found.append(int(entry.parent.name))
    return found


def wait_until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_killed_run_is_taken_up_where_it_was(tmp_path):
    """kill -9 of the run in every phase of a fit and of the table: its children end with it, and nothing is lost."""
    files = images(tmp_path, a=1, b=2, c=3, d=4, e=5)
    out = tmp_path / "out"
    for name, fault in {"b": "parent read", "c": "parent write", "d": "parent between", "e": "self table"}.items():
        (tmp_path / f"{name}.txt.fault").write_text(fault)
        complete = {path: path.stat().st_mtime_ns for path in out.glob(f"*/{origin.FILE}")}
        run = start(out, files, 1)
        assert run.communicate()[1] == ""
        assert run.returncode == -signal.SIGKILL
        if Path("/proc").is_dir():
            wait_until(lambda run=run: not processes(run.pid))
        # What was complete is untouched, and the table, if the run came to write one, is whole.
        assert all(path.stat().st_mtime_ns == at for path, at in complete.items())
        if (out / results.FILE).exists():
            assert all(row["mie_g"] for row in table(out).values())
    run = start(out, files, 1)
    shown, errors = run.communicate()
    assert (run.returncode, errors) == (0, "")
    assert "5 of 5 images fitted already" in shown  # the last had only its row left to be written
    assert [float(row["mie_g"]) for row in table(out).values()] == [1, 2, 3, 4, 5]
    assert {path.name for path in out.iterdir()} == {*"abcde", results.FILE}
    assert not leftovers(out)


def test_an_interrupt_keeps_what_is_done(tmp_path):
    files = images(tmp_path, a=1, b=2, c=3)
    for name in "bc":
        (tmp_path / f"{name}.txt.fault").write_text("sleep write")
    out = tmp_path / "out"
    run = start(out, files, 2)
    wait_until(lambda: (out / results.FILE).exists() and len(leftovers(out)) == 2)
    os.killpg(run.pid, signal.SIGINT)  # as Ctrl-C does
    shown, errors = run.communicate()
    assert (run.returncode, errors) == (130, "")
    assert "Interrupted, 2 images left; the same command with --resume goes on" in shown
    assert list(table(out)) == ["a"]
    assert sorted(path.name for path in out.iterdir()) == ["a", results.FILE]


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with folders.claim(out), pytest.raises(folders.FolderError, match="another process is writing"):
        fit(images(tmp_path, a=1), out)
    assert not list(out.iterdir())
    with folders.claim(out):  # free again
        pass


# What is done again ---------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Wider(FitSpec):
    """A fit with more to be said about it than there was when this was written."""

    nuisance: dict | None = None


def test_what_a_result_was_made_from(tmp_path):
    """Every change of image, options, files that options name, and version is seen and named; nothing else is."""
    (image,) = images(tmp_path, a=1)
    init, mask = tmp_path / "init.toml", tmp_path / "mask.png"
    init.write_text("one")
    mask.write_text("two")
    spec = Wider(
        (ImageSpec(image, {"noise": 0.01, "mask": str(mask)}),),
        init=str(init),
        free=("mie_g",),
        nuisance={"x": (1, 2.5)},
    )
    (tmp_path / origin.FILE).write_text(origin.dumps(spec))

    def differs(**values):
        return origin.difference(tmp_path, dataclasses.replace(spec, **values))

    assert differs() is None
    assert differs(nuisance={"x": [1, 2.5]}) is None
    assert differs(free=("mie_g", "ozone_absorption")) == 'free was ["mie_g"], is ["mie_g", "ozone_absorption"]'
    assert differs(model="raymarch") == 'model was not given, is "raymarch"'
    assert differs(nuisance=None, init=None).startswith("init was a file (")
    assert differs(nuisance={"x": (1, 3)}) == 'nuisance was {"x": [1, 2.5]}, is {"x": [1, 3]}'
    assert differs(images=(ImageSpec(image, {"noise": 0.02, "mask": str(mask)}),)) == "noise was 0.01, is 0.02"
    moved = mask.rename(tmp_path / "moved.png")
    assert differs(images=(ImageSpec(image, {"noise": 0.01, "mask": str(moved)}),)) is None
    moved.write_text("three")
    assert differs(images=(ImageSpec(image, {"noise": 0.01, "mask": str(moved)}),)).startswith("mask was a file (")
    image.write_text("2")
    assert differs() == "the image has changed"
    image.unlink()
    assert differs() == "the image cannot be read: No such file or directory"
    image.write_text("1")
    moved.rename(mask).write_text("two")
    for change, expected in {"version": "made by version 0.0.1, this is", "options": "not complete"}.items():
        (tmp_path / origin.FILE).write_text(json.dumps(origin.describe(spec) | {change: "0.0.1"}))
        assert differs().startswith(expected)
    (tmp_path / origin.FILE).write_text(origin.dumps(spec)[:100])
    assert differs() == "not complete"


def test_resume_says_why_and_loses_no_row(tmp_path, capsys):
    files = images(tmp_path, a=1, b=2, c=3, d=4)
    out = tmp_path / "out"
    assert fit(files, out, jobs=1) == 0
    (out / "a" / results.RECORD).write_text("{")
    (out / "b" / origin.FILE).unlink()
    files[2].write_text("30")
    files[3].unlink()  # after it was fitted
    capsys.readouterr()
    assert fit(files[:3], out, resume=True, jobs=1) == 0
    shown = capsys.readouterr().out
    for line in (
        "0 of 3 images fitted already",
        "a: fit.json is damaged",
        "b: not complete",
        "c: the image has changed",
    ):
        assert line in shown
    assert {name: float(row["mie_g"]) for name, row in table(out).items()} == {"a": 1, "b": 2, "c": 30, "d": 4}
    assert fit(files[:3], out, resume=True) == 0
    assert "3 of 3 images fitted already" in capsys.readouterr().out


def test_nothing_is_replaced_unless_asked(tmp_path):
    files = images(tmp_path, a=1)
    out = tmp_path / "out"
    (out / "a").mkdir(parents=True)
    (out / "a" / results.RECORD).write_text("mine")
    with pytest.raises(folders.FolderError, match="holds results already"):
        fit(files, out)
    # Nor is a fit of one image joined by those of a folder.
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / results.RECORD).write_text("mine")
    with pytest.raises(folders.FolderError, match="holds results already"):
        fit(files, tmp_path / "one")
    (out / results.FILE).write_text("mine")
    with pytest.raises(InputError, match="--resume to go on, or --overwrite"):
        fit(files, out)
    assert (out / "a" / results.RECORD).read_text() == (out / results.FILE).read_text() == "mine"
    assert fit(files, out, overwrite=True) == 0
    assert table(out)["a"]["mie_g"] == "1.0"


# The table ------------------------------------------------------------------------------------------------------------


def test_table(tmp_path):
    """All columns of all rows; spectral numbers by wavelength; an image's own exposure is the same column for all."""
    for name, exposure in {"sky_680": "exposure_sky_680", "b": "exposure_b", "c": "exposure_group"}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / results.RECORD).write_text(stub_fit.record(name, 0.5, **{exposure: 2.0}))
    names = ["sky_680", "b", "c", "none"]
    found = [results.row(Path(name), tmp_path / name) for name in names]
    assert found.pop() is None
    failed = results.failure(Path("bad\udcff.exr"), 'a "quoted", message\udcff')
    first, second, third, fourth = csv.DictReader(io.StringIO(results.dumps([*found, failed])))
    assert tuple(list(first)[:7]) == results.COLUMNS
    # The residual is that of the worst of the channels.
    assert (first["doubts"], float(first["residual_percent"])) == ("It is a stub. So it is.", 3.0)
    assert (first["status"], first["seconds"], first["exposure"]) == ("converged", "0.123", "2.0")
    assert (first["ozone_absorption_680"], first["ozone_absorption_680_standard_error"]) == ("1.0", "0.5")
    assert (first["ozone_absorption_550.5"], first["ozone_absorption_550.5_standard_error"]) == ("0.5", "")
    assert (second["exposure"], second["exposure_group"]) == ("2.0", "")
    assert (third["exposure"], third["exposure_group"]) == ("", "2.0")
    assert (fourth["file"], fourth["message"]) == ("bad\\udcff.exr", 'a "quoted", message\\udcff')
    assert fourth["mie_g"] == ""


def test_folders_have_the_names_of_the_images():
    files = ["x/a.exr", "x/b.exr", "x/b.hdr", "y/B.exr", "results.csv.exr", "...exr", "q\udcff.exr", "z/a.exr"]
    assert many.folder_names([Path(file) for file in files]) == [
        "a.exr", "b.exr", "b.hdr", "B.exr_2", "results.csv_2", "...exr", "q\\udcff", "a.exr_2",
    ]  # fmt: skip


def test_images_of_a_folder(tmp_path):
    for name in ("b.EXR", "a.png", "mask.png", ".hidden.exr", "notes.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.exr").mkdir()
    (tmp_path / "lost.exr").symlink_to("nowhere")  # has to be reported, not passed over
    found = many.expand([Path("other.raw"), tmp_path], mask=tmp_path / "folder.exr" / ".." / "mask.png")
    assert found == [Path("other.raw"), *(tmp_path / name for name in ("a.png", "b.EXR", "lost.exr"))]


def test_signals_are_named():
    assert "signal 11 (SIGSEGV)" in str(workers.Died(-signal.SIGSEGV))
    assert "want of memory" in str(workers.Died(-signal.SIGKILL))
    assert "signal 99 (unknown)" in str(workers.Died(-99))


# The command ----------------------------------------------------------------------------------------------------------


def test_a_folder_on_the_command_line(tmp_path, s1, monkeypatch, capfd):
    """True fits of a quick model: the truth is found, all that a fit writes is there, only the first compiles anything."""
    folder, out = tmp_path / "skies", tmp_path / "out"
    folder.mkdir()
    for number, zenith in enumerate((40, 60)):
        toy_image(folder / f"sky_{zenith}.exr", s1, zenith=zenith, seed=number)
    (folder / "cut.exr").write_bytes((folder / "sky_40.exr").read_bytes()[:-100])
    atmosphere.save(dataclasses.replace(s1, mie_g=0.6), tmp_path / "start.toml")
    monkeypatch.setattr("diffatmo.cli.fit.run_quietly", toy_fit.run_quietly)
    options = ["--init", str(tmp_path / "start.toml"), "--free", "rayleigh_scattering,mie_g"]
    assert main(["fit", str(folder), *options, "--jobs", "1", "-o", str(out)]) == 1
    rows = table(out)
    assert list(rows) == ["cut", "sky_40", "sky_60"]
    assert rows["cut"]["status"] == "failed"
    assert "cut.exr: the EXR is cut short" in rows["cut"]["message"]
    for name in list(rows)[1:]:
        g, error = float(rows[name]["mie_g"]), float(rows[name]["mie_g_standard_error"])
        assert abs(g - 0.8) < 4 * error
        assert math.isclose(float(rows[name]["reduced_chi2"]), 1, abs_tol=0.3)
        assert {"fit.json", "atmosphere.toml", "report.html", origin.FILE} <= {p.name for p in (out / name).iterdir()}
    assert (out / "sky_60" / "compilations").read_text() == "0"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("arguments", [["a.exr", "b.exr", "--each"], ["--config", "scene.toml", "--each"], ["."]])
def test_ways_to_ask_for_it(tmp_path, monkeypatch, arguments):
    asked = []

    def fit_each(spec, output, fitter, **options):
        asked.append((spec, output, options))
        return 0

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(many, "fit_each", fit_each)
    for name in "ab":
        imageio.write_exr(Path(f"{name}.exr"), np.ones((4, 16, 3)))
    Path("scene.toml").write_text(
        'model = "hillaire"\n[[image]]\nfile = "a.exr"\n[[image]]\nfile = "b.exr"\nnoise = 1\n'
    )
    assert main(["fit", *arguments, "--free", "mie_g", "--jobs", "3", "--resume", "-o", "found"]) == 0
    ((spec, output, options),) = asked
    assert [image.file for image in spec.images] == [Path("a.exr"), Path("b.exr")]
    assert (spec.free, output) == (("mie_g",), Path("found"))
    assert options == {"jobs": 3, "resume": True, "overwrite": False}
