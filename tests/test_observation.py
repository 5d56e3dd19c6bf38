"""Images made ready for the fit: masks, noise, exposure groups, binning, and what is refused."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import fitting
from diffatmo import sun
from diffatmo.camera import Equirectangular, Fisheye
from fitting import FitError, observation
from fitting.batch import stack
from fitting.nuisances import gather
from fitting.observation import exclusions, sigma, unstack

CAMERA = Equirectangular(32, 64)
SUN = sun.direction(zenith=math.radians(40), azimuth=0.0)
NM = [680.0, 550.0, 440.0]


def observe(pixels=None, **options):
    settings = {"camera": CAMERA, "altitude": 0.1, "sun": SUN, "sun_exclusion": 0.0, "name": "sky"} | options
    return fitting.observe(np.ones((32, 64, 3)) if pixels is None else pixels, **settings)


def test_only_the_sky_is_used_unless_asked():
    assert observe().used.sum() == 16 * 64
    assert observe(view_zenith_max=math.pi).used.sum() == 32 * 64
    assert observe(view_zenith_max=math.pi).masked == {}


def test_pixels_are_masked_for_the_first_reason_that_applies():
    pixels = np.ones((32, 64, 3))
    pixels[0, 0, 1] = np.nan
    pixels[0, 1, 2] = np.inf
    pixels[0, 2, 0] = -1e-3
    pixels[0, 3] = 0
    pixels[0, 4, 1] = 50
    mask = np.ones((32, 64), bool)
    mask[0, :8] = False
    found = observe(pixels, saturation=50.0, mask=mask)
    assert found.masked == {
        "below the horizon": 16 * 64,
        "not finite": 2,
        "negative": 1,
        "black": 1,
        "saturated": 1,
        "masked by the user": 3,
    }
    assert found.used.sum() == 16 * 64 - 8


def test_a_pixel_that_noise_makes_negative_is_dark_and_not_broken():
    """Left out, it would leave the bright ones: half of the pixels of a black image, whose mean would be 0.8 sigma."""
    pixels = np.random.default_rng(0).standard_normal((32, 64, 3))
    kept = observe(pixels, noise_floor=1.0)
    assert "negative" not in kept.masked
    # 3072 pixels: a standard deviation of 0.02.
    assert kept.image[kept.used].mean() == pytest.approx(0, abs=0.08)
    pixels[0, 0, 0] = -6
    assert observe(pixels, noise_floor=1.0).masked["negative"] == 1


def test_every_pixel_has_one_reason_or_is_used():
    """Also one that two reasons name, and one that is named twice."""
    pixels = np.ones((32, 64, 3))
    pixels[0, 4, 1] = 50
    pixels[0, :2] = np.nan
    clipped, cloud = np.zeros((2, 32, 64), bool)
    clipped[0, :8] = cloud[0, 6:12] = True
    given = {"saturation": 50.0, "mask": {"saturated": clipped, "cloud": cloud}, "horizon_exclusion": math.radians(10)}
    found = observe(pixels, **given)
    left_out = exclusions(pixels, camera=CAMERA, sun=found.sun, sun_exclusion=0.0, **given)
    assert {reason: bad.sum() for reason, bad in left_out.items()} == found.masked
    assert found.masked == {
        "below the horizon": 16 * 64,
        "not finite": 2,
        "saturated": 6,
        "cloud": 4,
        "near the horizon": 2 * 64,
    }
    np.testing.assert_array_equal(sum(bad.astype(int) for bad in left_out.values()), ~found.used)


def test_the_disc_around_the_sun():
    camera = Equirectangular(180, 360)
    radius = math.radians(15)
    found = observe(np.ones((180, 360, 3)), camera=camera, sun_exclusion=radius, max_pixels=10**6)
    excluded = (camera.solid_angles() * (found.shown & ~found.used)).sum()
    # A cap of the sphere, seen in pixels of a degree: the edge of 2π 15° sin(40°) / 1° pixels blurs it by about 1 %.
    assert float(excluded) == pytest.approx(2 * math.pi * (1 - math.cos(radius)), rel=0.02)


def test_the_strip_at_the_horizon():
    found = observe(view_zenith_max=math.pi, horizon_exclusion=math.radians(10))
    # Rows are 5.625 degrees high, with centres at 2.8 and 8.4 degrees on either side of the horizon.
    assert found.masked == {"near the horizon": 4 * 64}


def test_outside_a_fisheye_is_not_used():
    camera = Fisheye(32, 32, pitch=math.pi / 2)
    found = observe(np.ones((32, 32, 3)), camera=camera)
    assert found.used.sum() == pytest.approx(math.pi * 16**2, rel=0.02)
    assert "outside the camera's field of view" in found.masked


def test_noise_is_relative_plus_shot_plus_floor():
    found = observe(noise=0.02, noise_shot=1e-4, noise_floor=0.01)
    expected = math.sqrt(0.02**2 * 0.5**2 + 1e-4 * 0.5 + 0.01**2)
    np.testing.assert_allclose(sigma(found, jnp.full((32, 64, 3), 0.5)), expected, rtol=1e-6)
    # A negative signal has no photon noise.
    np.testing.assert_allclose(sigma(found, jnp.full((32, 64, 3), -1.0)), 0.01, rtol=1e-6)
    assert np.all(observe(2 * np.ones((32, 64, 3))).noise_floor == np.float32(2e-4))


@pytest.mark.parametrize("shape", [(), (3,), (32, 64), (32, 64, 3), (32, 64, 1)])
def test_noise_may_be_given_per_channel_and_pixel(shape):
    assert observe(noise=np.full(shape, 0.03)).noise.shape == (32, 64, 3)


def test_binning_averages_radiance_direction_and_noise():
    random = np.random.default_rng(0)
    camera = Equirectangular(64, 128, upper=True)
    signal = np.linspace(1, 2, 64)[:, None, None] * np.array([1.0, 2.0, 3.0])
    pixels = signal * (1 + 0.1 * random.standard_normal((64, 128, 3)))
    options = {"camera": camera, "noise": 0.1, "noise_floor": 0.0}
    found = observe(pixels, max_pixels=64 * 128 // 16, **options)
    assert found.block == 4
    assert found.image.shape == (16, 32, 3)
    np.testing.assert_allclose(found.image.mean((0, 1)), pixels.mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=-1), 1, atol=1e-6)
    block = np.asarray(camera.directions())[4:8, 8:12].mean((0, 1))
    np.testing.assert_allclose(found.directions[1, 2], block / np.linalg.norm(block), atol=1e-6)
    # Sixteen pixels, a quarter of the noise; 1536 deviations have a scatter known to 1.8 %.
    exact = observe(signal * np.ones((1, 128, 1)), max_pixels=64 * 128 // 16, **options).image
    whitened = (found.image - exact) / np.asarray(sigma(found, exact))
    assert whitened.std() == pytest.approx(1, abs=0.06)
    assert found.noise.mean() == pytest.approx(0.1 / 4, rel=0.02)


def test_four_directions_stand_for_a_block():
    """The mean of 1 / (mu + 0.1), which is as steep as a sky at the horizon, over blocks of 6°, some with holes.

    Mean and variance of the directions are right, so that only the third order (of the holes) and the fourth are left.
    """
    camera = Equirectangular(64, 128, upper=True)
    mask = np.random.default_rng(2).uniform(size=(64, 128)) < 0.9

    def sky(directions):
        return np.asarray(1 / (directions[..., 2] + 0.1))

    pixels = sky(np.asarray(camera.directions()))[..., None] * np.ones(3)
    found = observe(pixels, camera=camera, mask=mask, max_pixels=64 * 128 // 16)
    directions = stack([found], NM).directions
    assert directions.shape == (1, 16 * 32, 4, 3)
    four = sky(directions[0]).mean(axis=1).reshape(16, 32)
    wrong, rest = (np.std((x / found.image[..., 0] - 1)[-4:]) for x in (sky(found.directions), four))
    assert wrong > 5e-3
    assert rest < wrong / 10


def test_a_black_level_is_no_light():
    """With a free pedestal neither noise floor nor the noise of averaged pixels depends on what was added to an image."""
    light = 1 + np.random.default_rng(0).random((32, 64, 3))
    options = {"pedestal": "free", "noise": 0.1, "max_pixels": 32 * 64 // 8}
    plain, *raised = (observe(light + level, **options) for level in (0.0, -1.5, -10.0, 100.0))
    assert plain.block > 1
    for found in raised:
        np.testing.assert_allclose(found.noise_floor, plain.noise_floor, rtol=1e-4)
        np.testing.assert_allclose(found.noise, plain.noise, rtol=1e-6)
    np.testing.assert_allclose(plain.noise[plain.used], 0.1 / plain.block, rtol=1e-6)
    # An image without contrast has no darkest pixels.
    assert np.all(observe(-np.ones((32, 64, 3)), pedestal="free").noise_floor == np.float32(1e-4))


def test_binning_takes_a_sun_that_is_infinite():
    """As in a half-precision file; it is left out, whatever it is squared."""
    pixels = np.ones((32, 64, 3), np.float32)
    pixels[3, 5] = np.inf
    found = observe(pixels, max_pixels=32 * 64 // 8, noise=0.1, noise_floor=0.0)
    assert found.masked["not finite"] == 1
    assert np.isfinite(found.noise[found.used]).all()


def test_binning_leaves_masked_pixels_out():
    pixels = np.ones((32, 64, 3))
    pixels[0, 0] = np.nan
    pixels[0, 1] = 1000
    pixels[4:6, 4:6] = np.nan
    mask = np.ones((32, 64), bool)
    mask[0, 1] = False
    found = observe(pixels, mask=mask, max_pixels=32 * 64 // 8, noise=0.1, noise_floor=0.0)
    assert found.block == 2
    np.testing.assert_allclose(found.image[found.used], 1, rtol=1e-6)
    assert not found.used[2, 2]
    assert found.noise[0, 0, 0] == pytest.approx(0.1 / math.sqrt(2), rel=1e-5)
    assert found.noise[0, 1, 0] == pytest.approx(0.1 / 2, rel=1e-5)


def test_sizes_that_the_blocks_do_not_divide():
    camera = Equirectangular(15, 31, upper=True)
    found = observe(np.ones((15, 31, 3)), camera=camera, max_pixels=60)
    assert found.image.shape == (5, 11, 3)
    np.testing.assert_allclose(found.image, 1, rtol=1e-6)


def test_bands_of_rows_make_no_difference(monkeypatch):
    random = np.random.default_rng(2)
    camera = Equirectangular(31, 62)
    pixels = random.uniform(1, 2, (31, 62, 3))
    options = {"camera": camera, "max_pixels": 60, "noise": random.uniform(0.01, 0.02, (31, 62)), "noise_shot": 1e-3}
    whole = observe(pixels, **options)
    monkeypatch.setattr(observation, "BAND", 100)
    banded = observe(pixels, **options)
    assert whole.block > 1
    for name in ("image", "directions", "radius", "spread", "shown", "used", "noise", "noise_shot", "noise_floor"):
        np.testing.assert_array_equal(getattr(banded, name), getattr(whole, name))


@pytest.mark.parametrize(("pixel", "kept"), [(0.0, 1), (0.01, 2048)])
def test_noise_that_is_the_same_everywhere_is_kept_once(pixel, kept):
    """And means the same as that of every pixel: a hundred megabytes of ten megapixels, for each kind of it."""
    each = np.full((32, 64), 0.02)
    each[3, 5] += pixel
    batch = stack([observe(noise=each), observe(noise=0.03, name="other")], NM)
    assert batch.noise.shape == (2, kept, 3)
    assert batch.noise_floor.shape == (2, 1, 3)
    expected = [np.asarray(sigma(o, o.image))[o.shown] for o in (observe(noise=each), observe(noise=0.03))]
    found = np.asarray(sigma(batch, batch.measured))
    for image in range(2):
        np.testing.assert_allclose(found[image, : len(expected[image])], expected[image], rtol=1e-6)


def test_stack_pads_and_unstack_restores():
    few = observe(2 * np.ones((32, 64, 3)), name="few", view_zenith_max=math.radians(45))
    many = observe(name="many")
    batch = stack([few, many], NM)
    assert batch.measured.shape == (2, 2048, 3)
    assert batch.used.sum(axis=1).tolist() == [8 * 64, 16 * 64]
    assert np.all(np.isfinite(batch.measured))
    np.testing.assert_allclose(jnp.linalg.norm(batch.directions, axis=-1), 1, atol=1e-6)
    restored = unstack(few, np.asarray(batch.measured[0]))
    np.testing.assert_array_equal(restored[few.shown], few.image[few.shown])
    assert np.isnan(restored[~few.shown]).all()


def test_exposure_groups():
    given = ["fixed", "free", "camera", "camera", "free-per-channel", "lens-per-channel"]
    images = [observe(name=f"i{n}", exposure=exposure, exposure_value=2.0) for n, exposure in enumerate(given)]
    labels, found = gather(images, NM)
    names, index = [label.name for label in labels], np.asarray(found.factor_index)
    assert names == [
        *("exposure_i1", "exposure_camera"),
        *(f"exposure_{own}_{nm}" for own in ("i4", "lens") for nm in (680, 550, 440)),
    ]
    assert index[..., 0].tolist() == [[-1] * 3, [0] * 3, [1] * 3, [1] * 3, [2, 3, 4], [5, 6, 7]]
    assert np.all(index[..., 1] == -1)
    factors = stack(images, NM).exposure(jnp.log(jnp.arange(1.0, 9.0)))
    np.testing.assert_allclose(factors[:, 0, 0], [2, 2, 4, 4, 6, 12], rtol=1e-6)


def test_white_balance_leaves_the_middle_channel():
    given = [("free", "fixed"), ("free", "lens"), ("body", "lens"), ("body", "free")]
    images = [observe(name=f"i{n}", exposure=e, white_balance=w) for n, (e, w) in enumerate(given)]
    labels, found = gather(images, NM)
    names, index = [label.name for label in labels], np.asarray(found.factor_index)
    assert names[:3] == ["exposure_i0", "exposure_i1", "exposure_body"]
    assert names[3:] == [f"white_balance_{own}_{nm}" for own in ("lens", "i3") for nm in (680, 440)]
    assert index[..., 1].tolist() == [[-1] * 3, [3, -1, 4], [3, -1, 4], [5, -1, 6]]
    factors = stack(images, NM).exposure(jnp.log(jnp.array([1.0, 2.0, 3.0, 10.0, 20.0, 5.0, 7.0])))
    np.testing.assert_allclose(factors[:, 0], [[1, 1, 1], [20, 2, 40], [30, 3, 60], [15, 3, 21]], rtol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exposure": "free-per-channel", "white_balance": "lens"}, "a factor for each channel already"),
        ({"white_balance": ""}, "white_balance: got ''"),
        ({"exposure": "fixd"}, "exposure: got 'fixd', did you mean 'fixed'"),
        ({"exposure": "fre-per-channel"}, "exposure: .* did you mean 'free'"),
        ({"pose": "free-per-channel"}, "pose: got 'free-per-channel', expected"),
        ({"pose": "Free"}, "pose: got 'Free', did you mean 'free'"),
        ({"pose": 2}, 'pose: got 2, expected "fixed"'),
        ({"pixels": np.ones((32, 64))}, "expected real numbers in the shape"),
        ({"pixels": np.ones((32, 63, 3))}, "63 x 32 .* and the camera 64 x 32"),
        ({"pixels": np.zeros((32, 64, 3))}, "no pixel is left to fit: of 2048 pixels .* black"),
        ({"pixels": np.full((32, 64, 3), np.nan)}, "no pixel is left .* not finite"),
        ({"mask": np.zeros((32, 64), bool)}, "no pixel is left .* masked by the user"),
        ({"mask": np.ones((3, 3), bool)}, "mask: got shape"),
        ({"sun": np.array([0.0, 0.0, 2.0])}, "expected a unit vector"),
        ({"sun": np.array([0.0, 0.0, np.nan])}, "expected a unit vector"),
        ({"altitude": -1.0}, "altitude: got -1.0, expected kilometres"),
        ({"altitude": math.inf}, "altitude"),
        ({"noise": -0.1}, "noise: expected finite numbers >= 0"),
        ({"noise": 0.0, "noise_floor": 0.0}, "noise: it is zero"),
        ({"noise": np.ones(5)}, "noise: got shape"),
        ({"sun_exclusion": 4.0}, "sun_exclusion"),
        ({"sun_exclusion": math.nan}, "sun_exclusion"),
        ({"sun_exclusion": 3.1}, "no pixel is left .* near the sun"),
        ({"view_zenith_max": 0.0}, "view_zenith_max"),
        ({"horizon_exclusion": 2.0}, "horizon_exclusion"),
        ({"exposure": ""}, "exposure"),
        ({"exposure": "fixed-per-channel"}, "exposure"),
        ({"exposure_value": 0.0}, "exposure_value"),
        ({"exposure": 2.0}, "exposure: got 2.0, .*a number that is known is exposure_value"),
        ({"saturation": 0.0}, "saturation"),
        ({"max_pixels": 0}, "max_pixels"),
        ({"max_pixels": math.inf}, "max_pixels: got inf, expected a whole number"),
        ({"merged": "two"}, "merged: got 'two', expected a whole number"),
        ({"pixels": np.ones((32, 64, 3), complex)}, "of complex128, expected real numbers"),
        ({"camera": "fisheye"}, "camera: got 'fisheye', expected a camera"),
        ({"bands": "rgb"}, "bands: got 'rgb'"),
        ({"sun": "up"}, "sun: got 'up', expected a unit vector"),
        ({"altitude": None}, "altitude: got None, expected kilometres"),
        ({"altitude": [0.1, 0.2]}, r"altitude: got \[0.1, 0.2\]"),
        ({"exposure_value": "2"}, "exposure_value: got '2'"),
        ({"pose_error": None}, "pose_error: got None"),
        ({"heading_error": "wide"}, "heading_error: got 'wide'"),
        ({"time_h": "noon"}, "time_h: got 'noon'"),
        ({"mask": {"cloud": 1}}, r"mask: got shape \(\) of int64"),
        ({"mask": np.full((32, 64), np.nan)}, "of float64, expected .* of bool"),
    ],
)
def test_refuses(options, message):
    with pytest.raises(FitError, match=f"^sky: .*{message}"):
        observe(**options)


def test_a_mask_may_hold_whole_numbers():
    mask = np.where(np.arange(64) < 16, 0, 255) * np.ones((32, 1), np.uint8)
    assert observe(mask=mask).masked["masked by the user"] == 16 * 16
    assert observe(mask={"cloud": mask}).masked["cloud"] == 16 * 48


def test_refuses_images_that_do_not_go_together():
    with pytest.raises(FitError, match="no observation"):
        stack([], NM)
    with pytest.raises(FitError, match="sky: the name of 2 observations"):
        stack([observe(), observe()], NM)
    with pytest.raises(FitError, match=r"3 channels, expected 2, one for each wavelength .*680, 550 nm"):
        stack([observe()], NM[:2])
    with pytest.raises(FitError, match="rename the group"):
        stack([observe(name="a", exposure="free"), observe(name="b", exposure="a")], NM)
