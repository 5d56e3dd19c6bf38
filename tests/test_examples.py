"""The examples run as they stand, small, and do what they say."""

import functools
import json
import re
import runpy
from pathlib import Path

import pytest

import fitting
from diffatmo import imageio

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name, *arguments):
    """Call the example's main function; as a script it would only start another process."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](*arguments)


@pytest.mark.slow
def test_render_day(tmp_path):
    run("render_day", str(tmp_path / "day.png"), "16")
    sheet = imageio.read_image(tmp_path / "day.png", transfer="srgb").pixels
    assert sheet.shape == (32, 64, 3)
    noon, night = sheet[8, 24], sheet[24, 56]  # the zeniths of the second and the last picture
    assert noon[2] > noon[0]
    assert night[2] > night[0]  # ozone keeps the zenith blue after sunset


@pytest.mark.slow
def test_recover_parameters(monkeypatch):
    """Without the finer model, to save its time: in air as clear it changes little."""
    monkeypatch.setattr(fitting, "fit", functools.partial(fitting.fit, refine=False))
    result = run("recover_parameters", "32")
    assert result.converged
    assert 0.8 < result.reduced_chi2 < 1.2
    assert all(abs(estimate.pull) < 4 for estimate in result.parameters)


@pytest.mark.slow
def test_model_biases(monkeypatch):
    """Single scattering makes up for the light it misses with less aerosol, and its residuals tell, of fewer pixels as well."""
    monkeypatch.setattr(fitting, "observe", functools.partial(fitting.observe, max_pixels=600))
    monkeypatch.setattr(fitting, "fit", functools.partial(fitting.fit, refine=False))
    result = run("model_biases", "raymarch", "clear")["clear/raymarch"]
    assert result.reduced_chi2 > 20
    depth = next(e for e in result.parameters if e.field == "mie_optical_depth")
    assert depth.pull < -5


@pytest.mark.slow
def test_tune_colour(tmp_path):
    assert run("tune_colour", str(tmp_path / "sky.png"), "24") < 0.05
    assert imageio.read_image(tmp_path / "sky.png", transfer="srgb").pixels.shape == (16, 24, 3)


def cells(script):
    """(type, source) of the cells of a script in the percent format."""
    for part in re.split(r"^# %% ?", script, flags=re.MULTILINE)[1:]:
        head, _, source = part.partition("\n")
        lines = source.strip("\n").split("\n")
        if head == "[markdown]":
            yield "markdown", "\n".join(re.sub("^# ?", "", line) for line in lines)
        else:
            assert head == ""
            yield "code", "\n".join(lines)


def test_script_and_notebook_are_the_same():
    """`jupytext --to ipynb --update examples/image_to_figure.py` brings them together again."""
    script = (EXAMPLES / "image_to_figure.py").read_text(encoding="utf-8")
    notebook = json.loads((EXAMPLES / "image_to_figure.ipynb").read_text(encoding="utf-8"))
    assert [(cell["cell_type"], "".join(cell["source"])) for cell in notebook["cells"]] == list(cells(script))
    # Nothing that a run has left behind.
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook["cells"])


@pytest.mark.slow
def test_image_to_figure(tmp_path, monkeypatch):
    """A sky that was left out of the fit is predicted to within its error bars; without the finer model, to save its time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fitting, "fit", functools.partial(fitting.fit, refine=False))
    ran = runpy.run_path(str(EXAMPLES / "image_to_figure.py"))
    assert ran["result"].converged
    # Some 13000 residuals: 1 ± 0.012 for a model without an error.
    assert ran["chi2"] == pytest.approx(1, abs=0.1)
    assert (tmp_path / "twilight.pdf").read_bytes().startswith(b"%PDF")
    assert imageio.read_image(tmp_path / "twilight.png", transfer="srgb").pixels.shape == (840, 1440, 3)
    assert {path.name for path in tmp_path.iterdir()} == {"clear.csv", "clear.npz", "twilight.pdf", "twilight.png"}
