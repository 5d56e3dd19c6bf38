"""Scans to be fitted: what cannot be a sky under one sun is refused, in one line that names the file."""

import numpy as np
import pytest

from diffatmo import spectrum
from diffatmo.cli.common import InputError
from diffatmo.cli.jobs import prepare
from diffatmo.cli.scenefile import FitSpec, ImageSpec

WAVELENGTHS = np.arange(400.0, 701.0, 50.0)
SUN_ZENITH, SUN_AZIMUTH = 40.0, 150.0


def sky(**changes):
    """A sky that is symmetric about the sun, in a grid of 8 azimuths by 6 zenith angles, some of it changed."""
    azimuth, zenith = (x.ravel() for x in np.meshgrid(np.arange(0.0, 360, 45), np.arange(5.0, 80, 14)))
    away = np.radians(azimuth - SUN_AZIMUTH)
    z, s = np.radians(zenith), np.radians(SUN_ZENITH)
    angle = np.arccos(np.cos(z) * np.cos(s) + np.sin(z) * np.sin(s) * np.cos(away))
    shape = (1 + 2 * np.exp(-4 * angle) + 0.5 * np.cos(angle) ** 2) / (np.cos(z) + 0.3)
    colour = 0.03 * np.asarray(spectrum.solar_irradiance(WAVELENGTHS)) * (WAVELENGTHS / 550) ** -3
    return {
        "wavelength_nm": WAVELENGTHS,
        "radiance": shape[:, None] * colour,
        "view_zenith_deg": zenith,
        "view_azimuth_deg": azimuth,
        "sun_zenith_deg": np.full(zenith.size, SUN_ZENITH),
        "sun_azimuth_deg": np.full(zenith.size, SUN_AZIMUTH),
    } | changes


def job(folder, scan, **options):
    np.savez(folder / "a.npz", **scan)
    return prepare(FitSpec((ImageSpec(folder / "a.npz", options),)))


WHOLE = sky()
BAD = {
    "milliwatts": ({"radiance": 1000 * WHOLE["radiance"]}, "radiance: π times its median is "),
    "counts of dark": ({"radiance": 1e-4 * WHOLE["radiance"]}, "expected 0.0005 to 3; give W m^-2 sr^-1 nm^-1, or"),
    "from south": ({"view_azimuth_deg": WHOLE["view_azimuth_deg"] + 180}, "the sun if turned by 180 degrees, expected"),
    "counter-clockwise": ({"view_azimuth_deg": -WHOLE["view_azimuth_deg"]}, "view_azimuth_deg: the sky is symmetric about"),
    "another sun": ({"sun_azimuth_deg": WHOLE["sun_azimuth_deg"] + 90}, "give azimuths clockwise from north"),
    "midnight": ({"sun_zenith_deg": np.array(120.0)}, "sun_zenith_deg: got 120, expected at most 108"),
    "a day": ({"sun_zenith_deg": np.linspace(20, 80, 48)}, "sun_zenith_deg: from 20.0 to 80.0, expected a scan that lasts"),
    "infrared": ({"wavelength_nm": 720 + 5 * np.arange(7.0)}, "wavelength_nm: from 720, expected some up to 712.5"),
    "no number": ({"radiance": np.full((48, 7), np.nan)}, "no pixel is left to fit: of 48 pixels 48 not finite"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_a_sky_is_refused(name, tmp_path):
    changes, message = BAD[name]
    with pytest.raises(InputError) as caught:
        job(tmp_path, WHOLE | changes)
    assert str(caught.value).startswith(f"{tmp_path / 'a.npz'}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_more_samples_than_can_be_told_apart(tmp_path):
    many = {name: np.resize(values, (20_001, *values.shape[1:])) for name, values in WHOLE.items()}
    with pytest.raises(InputError, match="20,001 samples, expected at most 20,000"):
        job(tmp_path, many | {"wavelength_nm": WAVELENGTHS})


@pytest.mark.parametrize("key", ["sun_zenith_deg", "fov_deg", "mask"])
def test_an_option_that_does_nothing_is_refused(key, tmp_path):
    with pytest.raises(InputError, match=f"{key}: .*a.npz is a scan, which says itself"):
        job(tmp_path, WHOLE, **{key: 1.0})


def test_a_free_exposure_takes_any_unit(tmp_path):
    assert job(tmp_path, sky(radiance=1000 * WHOLE["radiance"]), exposure="free").observations[0].exposure == "free"


def test_samples_without_a_number_are_left_out_and_change_nothing(tmp_path):
    """The order of the rows neither; nor where on the circle the sun is."""
    whole = job(tmp_path, WHOLE).observations[0]
    spoilt = WHOLE["radiance"].copy()
    spoilt[5, 2], spoilt[9], spoilt[11] = np.nan, np.inf, -1.0
    good = ~np.isin(np.arange(48), (5, 9, 11))
    found = job(tmp_path, sky(radiance=spoilt)).observations[0]
    np.testing.assert_array_equal(found.used[0], whole.used[0] & good)
    assert found.masked["not finite"] == 2
    # The floor is that of the mean of the rest.
    np.testing.assert_allclose(found.noise_floor, whole.noise_floor, rtol=0.1)
    order = np.random.default_rng(0).permutation(48)
    mixed = {name: values if name == "wavelength_nm" else values[order] for name, values in WHOLE.items()}
    np.testing.assert_array_equal(job(tmp_path, mixed).observations[0].used[0], whole.used[0, order])
    # The sun passes north while the scan lasts.
    moving = (359.5 + np.linspace(0, 1, 48)) % 360
    north = sky(view_azimuth_deg=WHOLE["view_azimuth_deg"] - SUN_AZIMUTH, sun_azimuth_deg=moving)
    np.testing.assert_allclose(job(tmp_path, north).observations[0].sun[:2], [0, np.sin(np.radians(40))], atol=1e-6)
