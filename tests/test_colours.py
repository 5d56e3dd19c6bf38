"""A sky in the colours of a photo: what a fit says of its camera is what `render --colours` does to the light."""

import json

import numpy as np
import pytest

from diffatmo import atmosphere, bands, imageio
from diffatmo.cli import colours
from diffatmo.cli.common import InputError
from diffatmo.cli.main import main
from diffatmo.cli.photo import start
from diffatmo.color import LUMINANCE

SEEN = {
    "wavelengths_nm": list(bands.NODES),
    "response": bands.srgb().response.tolist(),
    "factor": [0.5, 0.6, 0.8],
    "saturation": 0.3,
    "encoded": True,
}


@pytest.fixture
def record(tmp_path):
    def write(*seen):
        path = tmp_path / "fit.json"
        path.write_text(json.dumps({"images": [{"colours": one} for one in seen]}))
        return path

    return write


def test_purity_is_that_of_the_fit(record):
    """pixel = light exp(s (1 - Y / pixel)), with Y and the pixel on both sides (`fitting.nuisances`); without s the bands."""
    radiance = np.random.default_rng(0).uniform(0.5, 1.0, (4, 5, 6))
    light = radiance @ np.array(SEEN["response"]).T * SEEN["factor"]
    pixel = colours.read(record(SEEN), start(1013.0)).develop(radiance).astype(float)
    luminance = (pixel @ np.asarray(LUMINANCE))[..., None]
    np.testing.assert_allclose(pixel, light * np.exp(0.3 * (1 - luminance / pixel)), rtol=1e-5)
    plain = colours.read(record(SEEN | {"saturation": 0.0}), start(1013.0)).develop(radiance)
    np.testing.assert_allclose(plain, light, rtol=1e-6)
    # Light that is not there has no colour.
    assert np.all(colours.read(record(SEEN), start(1013.0)).develop(0 * radiance) == 0)


@pytest.mark.parametrize("saturation", [-0.4, 0.1, 0.33, 0.6])
def test_a_channel_that_fades_does_not_break_off(record, saturation):
    """The deep orange of a low sun: blue falls evenly to nothing, and so it does in the picture."""
    seen = SEEN | {"response": np.eye(3).tolist(), "wavelengths_nm": list(bands.NODES[:3]), "saturation": saturation}
    photo = colours.Colours(
        *(np.asarray(seen[key]) for key in ("wavelengths_nm", "response")), np.ones(3), saturation, True
    )
    blue = np.geomspace(1, 1e-4, 2000)
    pixel = photo.develop(np.stack([1 + 0 * blue, 0.7 + 0 * blue, blue], -1)).astype(float)
    fall = np.diff(np.log(pixel[:, 2])) / np.diff(np.log(blue))
    # Its slope is 1 / (1 - s Y / pixel): at most 5 with `STEEPEST`, less than 1 where colours are made paler.
    assert fall.max() < 5.2
    assert fall.min() > 0


def test_the_first_photo_counts(record):
    other = SEEN | {"factor": [9.0, 9.0, 9.0]}
    assert colours.read(record(None, SEEN, other), start(1013.0)).factor.tolist() == SEEN["factor"]


def test_what_is_no_photo_is_refused(record, tmp_path):
    air = start(1013.0)
    with pytest.raises(InputError, match=r"nothing\.json: cannot be read"):
        colours.read(tmp_path / "nothing.json", air)
    with pytest.raises(InputError, match="none of its images is a photo"):
        colours.read(record(None), air)
    with pytest.raises(InputError, match="not at the wavelengths of the fit, 400, 500 nm"):
        colours.read(record(SEEN | {"wavelengths_nm": [400.0, 500.0]}), air)
    path = tmp_path / "fit.json"
    for text in ("{", "[]", '{"images": [{}]}'):
        path.write_text(text)
        with pytest.raises(InputError, match=r"fit\.json: expected the fit.json of a photo"):
            colours.read(path, air)


def test_another_hour_is_rendered(record, tmp_path):
    """An EXR has the photo's channels and units; the PNG of an encoded photo is that, clipped and encoded."""
    air, exr, png = tmp_path / "air.toml", tmp_path / "sky.exr", tmp_path / "sky.png"
    atmosphere.save(start(1013.0), air)
    options = ["--width", "8", "--upper", "--sun-zenith-deg", "70", "--model", "raymarch"]
    said = ["-o", str(exr), "-o", str(png), "--colours", str(record(SEEN)), *options]
    assert main(["render", str(air), *said]) == 0
    linear, shown = imageio.read_image(exr).pixels, imageio.read_image(png, transfer="srgb").pixels
    assert linear.shape == (2, 8, 3)
    np.testing.assert_allclose(shown, np.clip(linear, 0, 1), atol=5e-3)
