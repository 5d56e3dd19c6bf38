"""The examples run as they stand, small, and do what they say."""

import runpy
from pathlib import Path

import pytest

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
def test_recover_parameters():
    result = run("recover_parameters", "32")
    assert result.converged
    assert 0.8 < result.reduced_chi2 < 1.2
    assert all(abs(estimate.pull) < 4 for estimate in result.parameters)


@pytest.mark.slow
def test_model_biases():
    """Single scattering makes up for the light it misses with less aerosol, and its residuals tell."""
    result = run("model_biases", "raymarch", "clear")["clear/raymarch"]
    assert result.reduced_chi2 > 20
    depth = next(e for e in result.parameters if e.field == "mie_optical_depth")
    assert depth.pull < -5


@pytest.mark.slow
def test_tune_colour(tmp_path):
    assert run("tune_colour", str(tmp_path / "sky.png"), "24") < 0.05
    assert imageio.read_image(tmp_path / "sky.png", transfer="srgb").pixels.shape == (16, 24, 3)
