"""Bracketed exposures: the truth comes back, with the error that is stated."""

import numpy as np
import pytest

from diffatmo import brackets
from diffatmo.exif import Exif

RNG = np.random.default_rng(0)
EXPOSURES = np.array([1 / 1000, 1 / 125, 1 / 15])


def bracket(light, exposures=EXPOSURES, shot=brackets.SHOT, floor=brackets.FLOOR):
    """What a sensor that clips at 1 makes of light, with the noise of the model."""
    noise = lambda v: RNG.normal(size=v.shape) * np.sqrt(shot * v + floor**2)
    return [np.minimum(exposure * light + noise(exposure * light), 1) for exposure in exposures]


def test_without_noise_the_light_comes_back():
    light = np.geomspace(0.1, 900, 300).reshape(10, 10, 3)
    merged = brackets.merge([np.minimum(t * light, 1) for t in EXPOSURES], EXPOSURES)
    assert merged.pixels.dtype == np.float32
    np.testing.assert_allclose(merged.pixels, light, rtol=1e-6)


@pytest.mark.parametrize("level", [0.1, 1.0, 10.0, 100.0, 800.0])
def test_mean_and_noise_are_as_stated(level):
    light = np.full((200, 200, 1), level)
    merged = brackets.merge(bracket(light), EXPOSURES)
    error = merged.pixels / level - 1
    # The mean of 40 000 is known to a 200th of their spread, and the spread itself to 0.35 %; four times each.
    stated = merged.noise.mean()
    assert abs(error.mean()) < 4 / 200 * stated
    assert error.std() == pytest.approx(stated, rel=0.02)


def test_noise_is_that_of_all_exposures_together():
    """Two that photons limit count photons like one of their sum; clipped ones do not count."""
    shot, floor = 1e-4, 1e-9
    light = np.full((2, 2, 3), 10.0)
    both = brackets.merge([0.03 * light, 0.06 * light], [0.03, 0.06], shot=shot, floor=floor)
    np.testing.assert_allclose(both.noise, np.sqrt(shot / (0.09 * 10)), rtol=1e-5)
    one = brackets.merge([0.03 * light, np.ones_like(light)], [0.03, 0.2], shot=shot, floor=floor)
    np.testing.assert_allclose(one.noise, np.sqrt(shot / (0.03 * 10)), rtol=1e-5)
    np.testing.assert_allclose(one.pixels, 10, rtol=1e-6)


def test_no_unbiased_weights_beat_it():
    """Equal weights, the longest exposure alone, and those of Debevec & Malik's hat are all noisier."""
    light = np.full((300, 300, 1), 5.0)
    pictures = bracket(light)
    estimates = [v / t for v, t in zip(pictures, EXPOSURES, strict=True)]
    hats = [np.minimum(v, 1 - v) for v in pictures]
    hat = np.average(estimates, axis=0, weights=np.maximum(hats, 0) + 1e-9)
    merged = brackets.merge(pictures, EXPOSURES).pixels
    for other in (np.mean(estimates, axis=0), estimates[-1], hat):
        assert merged.std() < 1.0001 * other.std()


def test_what_no_exposure_shows_is_not_a_number():
    pictures = [np.full((2, 4, 3), 0.2), np.full((2, 4, 3), 0.4)]
    for picture in pictures:
        picture[0, 0] = 1.0  # clipped in all
        picture[0, 1] = 1e-5  # noise in all
        picture[0, 2, 1] = np.nan
    pictures[1][1, 0] = 1.0
    merged = brackets.merge(pictures, [0.1, 0.2])
    lost = np.zeros((2, 4, 3), bool)
    lost[0, :2] = lost[0, 2, 1] = True
    np.testing.assert_array_equal(np.isnan(merged.pixels), lost)
    np.testing.assert_array_equal(np.isnan(merged.noise), lost)
    np.testing.assert_allclose(merged.pixels[~lost], 2, rtol=1e-6)


def test_saturation_is_that_of_the_pictures():
    light = np.full((2, 2, 3), 4.0)
    pictures = [0.05 * light, np.minimum(0.2 * light, 0.5)]
    np.testing.assert_allclose(brackets.merge(pictures, [0.05, 0.2], saturation=0.5).pixels, 4, rtol=1e-6)


PICTURE = np.full((2, 3, 3), 0.5)


@pytest.mark.parametrize(
    ("pictures", "exposures", "options", "message"),
    [
        ([PICTURE], [1], {}, "1 pictures to merge, expected at least two"),
        ([], [], {}, "0 pictures to merge"),
        ([PICTURE] * 2, [1], {}, "1 exposures for 2 pictures"),
        ([PICTURE] * 2, [1, 0], {}, "exposures 1, 0, expected positive"),
        ([PICTURE] * 2, [1, np.nan], {}, "exposures 1, nan, expected positive"),
        ([PICTURE] * 2, [1, None], {}, "exposures 1, nan, expected positive"),
        ([PICTURE] * 2, [2, 2], {}, "every picture has the exposure 2, expected different ones"),
        ([PICTURE, PICTURE[:1]], [1, 2], {}, r"shape \(1, 3, 3\), \(2, 3, 3\), expected"),
        ([PICTURE[0]] * 2, [1, 2], {}, r"shape \(3, 3\), expected"),
        ([PICTURE] * 2, [1, 2], {"floor": 0.0}, "floor = 0, expected positive"),
        ([PICTURE] * 2, [1, 2], {"saturation": np.nan}, "saturation = nan"),
    ],
)
def test_bad_brackets(pictures, exposures, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        brackets.merge(pictures, exposures, **options)
    assert "\n" not in str(caught.value)


def test_exposure_from_the_camera():
    notes = Exif(exposure_s=1 / 100, iso=400, f_number=2.0)
    assert brackets.exposure_of(notes) == pytest.approx(0.01)
    for name in ("exposure_s", "iso", "f_number"):
        assert brackets.exposure_of(notes._replace(**{name: None})) is None
