"""Photos: what they say themselves is taken, what they do not say is asked for, and what the user says stands."""

import dataclasses
import math
import types
from datetime import UTC, datetime

import numpy as np
import photographs
import pytest

import fitting
from diffatmo import bands, color, imageio, sun
from diffatmo.camera import Equirectangular, Pinhole
from diffatmo.cli import photo
from diffatmo.cli.common import InputError
from diffatmo.cli.fit import check_masks
from diffatmo.cli.images import find_camera
from diffatmo.cli.jobs import prepare
from diffatmo.cli.running import plates
from diffatmo.cli.scenefile import FitSpec, ImageSpec, check_image_options
from diffatmo.exif import Exif
from diffatmo.horizon import Horizon
from diffatmo.imageio import Image

DEG = math.pi / 180
HEIGHT, WIDTH = 60, 80
TIME = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
EXIF = Exif(
    size=(HEIGHT, WIDTH),
    focal_length_mm=50.0,
    focal_length_35mm_mm=50.0,
    time=TIME,
    latitude_deg=48.0,
    longitude_deg=11.0,
    compass_deg=200.0,
    compass_is_magnetic=False,
    make="A maker",
)


def seascape(row=45.0, slope=0.0, height=HEIGHT, width=WIDTH):
    """A bright sky over a dark, rough sea."""
    rng = np.random.default_rng(0)
    below = np.arange(height)[:, None] - row - slope * (np.arange(width) - (width - 1) / 2) > 0
    sea = np.array([0.05, 0.1, 0.12]) * np.exp(0.3 * rng.normal(size=(height, width, 1)))
    return np.where(below[..., None], sea, np.array([0.3, 0.5, 0.9])).astype(np.float32)


def image(pixels=None, exif=EXIF, **options):
    said = {"metadata": {}, "wavelengths": None, "exif": exif, "saturation": 1.0}
    return Image(seascape() if pixels is None else pixels, **said | options)


NOTHING = Exif(size=(HEIGHT, WIDTH))
PANORAMA = np.full((20, 40, 3), 0.5, np.float32)


# What is asked for --------------------------------------------------------------------------------------------------

TIME_FLAG, PLACE_FLAGS = "--time", "--latitude-deg and --longitude-deg"
ANGLES = "or --sun-zenith-deg and --sun-azimuth-deg"
LACKS = {
    "no projection": (NOTHING, {}, "projection: the file does not say how 80 x 60 pixels map to directions; give --projec"),
    "no focal length": (
        EXIF._replace(focal_length_mm=None, focal_length_35mm_mm=None),
        {},
        "fov_deg: the file does not say; give --fov-deg, from the top to the bottom of the picture",
    ),
    "no time": (
        EXIF._replace(time=None),
        {},
        f"the sun: the file does not say when it was taken; give {TIME_FLAG}, {ANGLES}",
    ),
    "no offset": (
        EXIF._replace(time=None, local_time=TIME.replace(tzinfo=None)),
        {},
        f"the sun: the file does not say the offset of its clock from UTC; give {TIME_FLAG}, {ANGLES}",
    ),
    "no place": (
        EXIF._replace(latitude_deg=None, longitude_deg=None),
        {},
        f"the sun: the file does not say where it was taken; give {PLACE_FLAGS}, {ANGLES}",
    ),
    "neither time nor place": (
        EXIF._replace(time=None, latitude_deg=None, longitude_deg=None),
        {},
        "the sun: the file does not say when it was taken nor where it was taken; give --time and --latitude-deg and --lon",
    ),
    "no place, but the time": (
        EXIF._replace(time=None, latitude_deg=None, longitude_deg=None),
        {"time": TIME},
        f"the sun: the file does not say where it was taken; give {PLACE_FLAGS}, {ANGLES}",
    ),
    "no time, but the place": (
        EXIF._replace(time=None, latitude_deg=None, longitude_deg=None),
        {"latitude_deg": 48.0, "longitude_deg": 11.0},
        f"the sun: the file does not say when it was taken; give {TIME_FLAG}, {ANGLES}",
    ),
    "no compass": (EXIF._replace(compass_deg=None), {}, "yaw_deg: the file has no compass; give --yaw-deg, the azimuth of"),
}  # fmt: skip


@pytest.mark.parametrize("name", LACKS)
def test_what_is_missing_is_asked_for_and_nothing_else(name):
    exif, said, message = LACKS[name]
    with pytest.raises(InputError) as caught:
        photo.complete(image(exif=exif), said, True)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_all_that_is_missing_is_asked_for_at_once():
    bare = EXIF._replace(focal_length_mm=None, focal_length_35mm_mm=None, time=None, compass_deg=None)
    flat = image(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32), exif=bare)
    with pytest.raises(InputError) as caught:
        photo.complete(flat, {}, True)
    told = str(caught.value)
    assert [part.split(":")[0] for part in told.split("; ") if ":" in part] == [
        "fov_deg",
        "the sun",
        "yaw_deg",
        "pitch_deg",
    ]
    assert all(flag in told for flag in ("--fov-deg", TIME_FLAG, "--yaw-deg", "--pitch-deg"))
    answers = {"fov_deg": 60.0, "time": TIME, "yaw_deg": 10.0, "pitch_deg": 20.0}
    assert photo.complete(flat, answers, True).options["projection"] == "pinhole"


def test_what_is_taken_as_linear_is_said_to_be():
    """Sixteen bits a channel that say nothing of a transfer function; an editor may have left them encoded."""
    silent = image()._replace(taken_as_linear=True)
    assert any("--transfer srgb" in line for line in photo.complete(silent, {}, False).assumed)
    assert not any("--transfer srgb" in line for line in photo.complete(image(), {}, False).assumed)


def test_a_picture_without_a_horizon_needs_its_pitch():
    flat = image(np.full((HEIGHT, WIDTH, 3), 0.5, np.float32))
    with pytest.raises(InputError, match=r"^pitch_deg: there is no straight horizon in the picture; give --pitch-deg,"):
        photo.complete(flat, {}, True)
    assert photo.complete(flat, {"pitch_deg": 20.0}, True).options["pitch_deg"] == 20


ANSWERS = {
    "no projection": {"projection": "pinhole", "fov_deg": 50.0},
    "no focal length": {"fov_deg": 50.0},
    "no time": {"time": TIME},
    "no offset": {"time": TIME},
    "no place": {"latitude_deg": 48.0, "longitude_deg": 11.0},
    "neither time nor place": {"sun_zenith_deg": 30.0, "sun_azimuth_deg": 180.0},
    "no place, but the time": {"latitude_deg": 48.0, "longitude_deg": 11.0},
    "no time, but the place": {"time": TIME},
    "no compass": {"yaw_deg": 200.0},
}


@pytest.mark.parametrize("name", ANSWERS)
def test_what_was_asked_for_is_enough(name):
    """The options make sense together, and the answer stands as it was given."""
    exif, said, _ = LACKS[name]
    if name == "no projection":
        exif = EXIF._replace(focal_length_mm=None, focal_length_35mm_mm=None, make=None)
    answer = said | ANSWERS[name]
    options = photo.complete(image(exif=exif), answer, True).options
    assert options.items() >= answer.items()
    check_image_options(options)
    assert "sun_zenith_deg" in options or {"time", "latitude_deg", "longitude_deg"} <= set(options)


# What is taken ------------------------------------------------------------------------------------------------------


def test_what_the_file_says_is_taken():
    made = photo.complete(image(), {}, True)
    options = made.options
    assert options["projection"] == "pinhole"
    # A lens of 50 mm sees 43.27 mm of diagonal: 60 rows of a picture of 100 pixels across are 26 mm.
    assert math.tan(options["fov_deg"] * DEG / 2) == pytest.approx(0.6 * math.hypot(36, 24) / 2 / 50)
    assert (options["time"], options["latitude_deg"], options["longitude_deg"]) == (TIME, 48.0, 11.0)
    assert options["yaw_deg"] == 200
    assert [options[kind] for kind in ("pose", "focal", "vignetting", "tone", "chroma")] == ["free"] * 5
    assert options["exposure"] == "free-per-channel"
    assert "focal_error" not in options
    said = "\n".join(made.assumed)
    for word in ("Exif", "compass", "horizon in row", "transfer function", "white balance"):
        assert word in said
    assert all("\n" not in line for line in made.assumed)


def test_what_the_user_says_stands():
    """Every option there is, one by one: none of them is changed, and none is said to be assumed."""
    usual = photo.complete(image(), {}, True)
    other = {
        "projection": "pinhole", "fov_deg": 33.0, "altitude_km": 1.5, "time": TIME.replace(hour=3), "latitude_deg": -3.0,
        "longitude_deg": 5.0, "yaw_deg": 12.0, "heading_error_deg": 3.0, "pitch_deg": -7.0, "roll_deg": 1.0,
        "pose": "fixed", "pose_error_deg": 1.0, "focal": "lens", "vignetting": "fixed", "tone": "fixed",
        "chroma": "mine", "exposure": "fixed", "saturation": 0.5, "noise": 0.01, "sun_exclusion_deg": 3.0,
        "horizon_exclusion_deg": 1.0,
    }  # fmt: skip
    assert set(other) == set(usual.options)
    for key, value in other.items():
        said = {key: value}
        if key in ("latitude_deg", "longitude_deg"):
            said = {name: other[name] for name in ("latitude_deg", "longitude_deg")}
        options = photo.complete(image(), said, True).options
        assert options.items() >= said.items(), key
    whole = photo.complete(image(), other, True)
    assert whole.options == other
    assert not [line for line in whole.assumed if "transfer function" not in line and "exposure" not in line]
    white = photo.complete(image(), {"white_balance": "free"}, True).options
    assert "exposure" not in white


def test_a_phone_without_an_equivalent_focal_length():
    """2.75 mm before a sensor of 6.9 mm: 4:3, so 5.52 mm wide; what the picture has been cut to counts."""
    exif = EXIF._replace(focal_length_mm=2.75, focal_length_35mm_mm=None)
    options = photo.complete(image(exif=exif), {}, True).options
    assert 2 * 2.75 * math.tan(options["fov_deg"] * DEG / 2) == pytest.approx(0.6 * 6.9)
    cut = image(seascape(35.0, height=50), exif)
    assert 2 * 2.75 * math.tan(photo.complete(cut, {}, True).options["fov_deg"] * DEG / 2) == pytest.approx(0.5 * 6.9)
    assert options["focal_error"] == 0.25


def test_a_large_picture_is_reduced_and_says_so(monkeypatch):
    """The horizon of the messages is in a row of the smaller picture."""
    monkeypatch.setattr(photo, "LONGEST_SIDE", 20)
    made = photo.complete(image(PANORAMA, NOTHING), {}, False)
    assert made.pixels.shape == (10, 20, 3)
    assert made.assumed[0] == "reduced to 20 × 10 pixels, in which all that follows is counted"


@pytest.mark.parametrize("shape", [(20, 40), (10, 40)])
def test_a_panorama_is_known_by_its_shape(shape):
    """A whole sphere, or its upper half; it finds its own sun, and has neither compass nor lens."""
    made = photo.complete(image(np.full((*shape, 3), 0.5, np.float32), NOTHING), {}, False)
    options = made.options
    assert options["projection"] == "equirectangular"
    assert options["sun"] == "detect"
    assert not {"pose", "focal", "vignetting", "tone", "yaw_deg"} & set(options)
    assert options["chroma"] == "free"
    check_image_options(options)
    # Half a sphere is called one by the camera, which is found by the same shape.
    lowest = np.asarray(find_camera(options, made.pixels, None).directions())[-1, 0, 2]
    assert lowest == pytest.approx(-1 if shape[0] == 20 else 0, abs=0.1)


def test_a_panorama_that_knows_better_does_not_look_for_the_sun():
    known = NOTHING._replace(time=TIME, latitude_deg=48.0, longitude_deg=11.0)
    assert photo.complete(image(PANORAMA, known), {}, False).options["time"] == TIME
    said = photo.complete(image(PANORAMA, NOTHING), {"sun_zenith_deg": 20.0, "sun_azimuth_deg": 0.0}, False).options
    assert "sun" not in said
    # 2:1 of a camera with a lens is a picture.
    wide = EXIF._replace(size=(20, 40))
    assert photo.complete(image(PANORAMA, wide), {"pitch_deg": 3.0}, False).options["projection"] == "pinhole"


def test_the_sun_is_where_the_sky_is_brightest_if_that_is_one_place():
    """A glow is found, and one at the horizon; a horizon that is bright all around tells nothing, nor do two glows."""
    camera = Equirectangular(60, 120)
    directions = np.asarray(camera.directions())
    spot = lambda towards: np.exp(-np.sum((directions - towards) ** 2, axis=-1))[..., None] * np.ones(3)
    for zenith in (30.0, 88.0):
        towards = np.asarray(sun.direction(zenith=zenith * DEG, azimuth=2.0))
        # Towards the horizon half of the glow is below it.
        assert photo.glow(spot(towards), camera) @ towards > np.cos(4 * DEG)
        # One that is clipped far around the sun has its middle there all the same.
        clipped = np.minimum(spot(towards), np.exp(-((15 * DEG) ** 2)))
        assert photo.glow(clipped, camera) @ towards > np.cos(9 * DEG)
    ring = np.exp(-directions[..., 2:]) * np.ones(3)
    assert photo.glow(ring, camera) is None
    both = spot(np.array([0.8, 0.0, 0.6])) + spot(np.array([-0.8, 0.0, 0.6]))
    assert photo.glow(both, camera) is None
    assert photo.glow(np.ones((60, 120, 3)), camera) is None


def test_a_wide_picture_is_no_panorama():
    """Only a full turn comes back to where it began; unless the user says that it is one."""
    sky = np.exp(np.linspace(0, 1, 40))[None, :, None] * np.full((20, 1, 3), 0.5, np.float32)
    with pytest.raises(InputError, match=r"^projection: .* its left and right edge differ by 100 %; give --projection"):
        photo.complete(image(sky, NOTHING), {}, False)
    assert photo.complete(image(sky, NOTHING), {"projection": "equirectangular"}, False).options["sun"] == "detect"
    there_and_back = np.concatenate([sky[:, ::2], sky[:, ::-2]], axis=1)
    assert photo.complete(image(there_and_back, NOTHING), {}, False).options["projection"] == "equirectangular"


def test_a_picture_without_colours_is_refused():
    """Black and white, and tinted; one with colours of its own is not, nor one without light."""
    grey = seascape().mean(axis=-1, keepdims=True)
    for tint in ([1, 1, 1], [1.1, 0.9, 0.6]):
        with pytest.raises(InputError, match="black and white, or of one colour"):
            photo.check_colour(grey * np.array(tint, np.float32))
    photo.check_colour(seascape())
    photo.check_colour(np.zeros((4, 8, 3), np.float32))


def test_the_sun_is_said_where_it_is():
    """Of a clock that is off: by how much the sun was down, and refused if the exposure says that it was up."""
    made = photo.complete(image(), {}, True)
    assert any("above the horizon at azimuth" in line for line in made.assumed)
    night = EXIF._replace(time=TIME.replace(hour=20))
    assert any("below the horizon at azimuth" in line for line in photo.complete(image(exif=night), {}, True).assumed)
    day = night._replace(exposure_s=1 / 500, f_number=8.0, iso=100.0)
    with pytest.raises(
        InputError, match=r"^time: the sun is .* degrees below the horizon then, but the exposure is one for"
    ):
        photo.complete(image(exif=day), {}, True)
    photo.complete(image(exif=day._replace(exposure_s=4.0, f_number=2.0)), {}, True)
    photo.complete(image(exif=day), {"time": TIME}, True)


def test_photos_are_pictures_of_three_channels_without_wavelengths():
    assert photo.is_photo(image())
    assert not photo.is_photo(image(wavelengths=(680.0, 550.0, 440.0)))
    assert not photo.is_photo(image(np.ones((4, 4, 1), np.float32)))


def test_a_raw_goes_through_its_own_matrix():
    """Colours by the camera's matrix, for which daylight is white, just below saturation in its largest channel."""
    to_xyz = np.linalg.inv(photographs.XYZ_TO_CAMERA)
    made = photo.complete(image(to_xyz=to_xyz), {}, False).pixels
    daylight = photographs.XYZ_TO_CAMERA @ np.linalg.inv(color.XYZ_TO_SRGB).sum(axis=1)
    flat = np.broadcast_to((0.5 * daylight / daylight.max()).astype(np.float32), (HEIGHT, WIDTH, 3))
    white = photo.complete(image(flat, to_xyz=to_xyz), {"pitch_deg": 0.0}, False)
    np.testing.assert_allclose(white.pixels, 0.5, rtol=1e-5)
    # But for one factor in each channel it is sRGB of the camera's XYZ.
    ratio = made / (seascape() @ (color.XYZ_TO_SRGB @ to_xyz).T)
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[0, 0], ratio.shape), rtol=1e-3)
    np.testing.assert_array_equal(photo.complete(image(), {}, True).pixels, image().pixels)


# The horizon --------------------------------------------------------------------------------------------------------


def camera_of(made):
    """The camera that the options describe."""
    return find_camera(made.options, made.pixels, None)


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.1])
@pytest.mark.parametrize("row", [10.0, 45.0])
def test_the_horizon_is_level(monkeypatch, row, slope):
    """A line anywhere, however the camera was tilted: all of it looks along the ground."""
    monkeypatch.setattr("diffatmo.horizon.find_horizon", lambda _: Horizon(row, slope, 1.0))
    made = photo.complete(image(), {}, True)
    x = np.linspace(0, WIDTH - 1, 7)
    elevation = np.arcsin(np.asarray(camera_of(made).directions_at(x, row + slope * (x - (WIDTH - 1) / 2)))[..., 2])
    np.testing.assert_allclose(elevation, 0, atol=1e-5)
    # Sky is above: a horizon below the middle is seen by a camera that looks up.
    assert np.sign(made.options["pitch_deg"]) == (1 if row > HEIGHT / 2 else -1)
    top = np.asarray(camera_of(made).directions_at(np.array(40.0), np.array(-0.5)))
    assert top[2] > 0


def test_a_camera_is_found_from_its_own_picture():
    """A sea rendered for a known pose: pitch and roll to a tenth of a degree, of half a degree in a pixel."""
    pose = {"fov_y": 40 * DEG, "pitch": 6 * DEG, "roll": -4 * DEG, "yaw": 1.0}
    camera = Pinhole(90, 120, **pose)
    down = np.asarray(camera.directions())[..., 2:] < 0
    sea = np.array([0.05, 0.1, 0.12]) * np.exp(0.3 * np.random.default_rng(0).normal(size=(90, 120, 1)))
    picture = image(np.where(down, sea, [0.3, 0.5, 0.9]).astype(np.float32))
    found = photo.complete(picture, {"fov_deg": 40.0}, True).options
    assert found["pitch_deg"] == pytest.approx(6, abs=0.2)
    assert found["roll_deg"] == pytest.approx(-4, abs=0.2)


def test_a_real_photograph(shared):
    path = shared / "real_sky" / "helsinki_20220814T111231Z_HMD_Nokia_8.3_5G.jpg"
    if not path.is_file():
        pytest.skip(f"no {path.name} among the reference data")
    whole = imageio.read_image(path, transfer="srgb")
    # A quarter of its size is as sharp as the horizon of a sea is.
    made = photo.complete(whole._replace(pixels=whole.pixels[::4, ::4]), {}, True)
    options = made.options
    assert options["time"] == datetime(2022, 8, 14, 11, 12, 31, tzinfo=UTC)
    assert (options["latitude_deg"], options["longitude_deg"]) == pytest.approx((60.14671, 24.90677), abs=1e-4)
    assert options["yaw_deg"] == 56
    # By hand: the sea's horizon is near row 1130 at the right edge, and the field of view is a guess (46.6° ± 25 %).
    assert options["fov_deg"] == pytest.approx(46.6, abs=0.1)
    camera = camera_of(made)
    right = np.asarray(camera.directions_at(np.array(1151.0), np.array(1130.0 / 4)))
    assert math.degrees(math.asin(right[2])) == pytest.approx(0, abs=0.2)
    # A camera that looks up by 4°, straight ahead at the azimuth of the compass.
    ahead = np.asarray(camera.rotation())[:, 1]
    assert math.degrees(math.atan2(ahead[0], ahead[1])) == pytest.approx(56, abs=1e-3)
    row = next(float(line.split("row ")[1].split(";")[0]) for line in made.assumed if "horizon in row" in line)
    centre = np.asarray(camera.directions_at(np.array((1152 - 1) / 2), np.array(row)))
    assert math.degrees(math.asin(centre[2])) == pytest.approx(0, abs=0.2)


# Noise and pressure -------------------------------------------------------------------------------------------------


def test_information_does_not_grow_with_pixels():
    """However fine the picture, however it was averaged: Σ 1/σ² is the number of patches over ERROR²."""
    sums = []
    for height, most in ((16, 10**6), (64, 10**6), (64, 100)):
        camera = Equirectangular(height, 4 * height, upper=True)
        pixels = np.ones((height, 4 * height, 3))
        seen = fitting.observe(
            pixels, camera=camera, altitude=0.0, sun=np.array([0, 0, 1.0]), noise=photo.ERROR, sun_exclusion=0.0,
            max_pixels=most,
        )  # fmt: skip
        noise = photo.shared_noise(seen)
        assert noise.shape == seen.noise.shape
        sums.append(float(np.sum(1 / noise[seen.used] ** 2)) / 3)
    # A hemisphere is 2π sr.
    np.testing.assert_allclose(sums, 2 * np.pi / photo.PATCH_SR / photo.ERROR**2, rtol=0.01)


def test_pixels_larger_than_a_patch_keep_their_noise():
    camera = Equirectangular(2, 8, upper=True)
    seen = fitting.observe(np.ones((2, 8, 3)), camera=camera, altitude=0.0, sun=np.array([0, 0, 1.0]), noise=0.2)
    np.testing.assert_array_equal(photo.shared_noise(seen), seen.noise)
    fine = dataclasses.replace(seen, noise=np.full_like(seen.noise, 1e-3))
    np.testing.assert_allclose(photo.shared_noise(fine), photo.ERROR)


def test_pressure_falls_with_altitude():
    """By 1/e in a scale height; that of an unknown place is less sure."""
    at = lambda metres: photo.pressure(image(exif=EXIF._replace(altitude_m=metres)))
    assert at(0.0) == (1013.25, 0.02)
    assert at(8400.0)[0] == pytest.approx(1013.25 / math.e)
    # The standard atmosphere's 899 hPa at 1000 m, which is colder than the mean.
    assert at(1000.0)[0] == pytest.approx(899, rel=0.01)
    assert at(-400.0)[0] == 1013.25
    assert at(2000.0)[0] < at(None)[0] < at(0.0)[0]
    assert at(None)[1] > at(0.0)[1]


def test_the_start_is_a_clear_day():
    """At the wavelengths of the bands, under a sun of 1, with an aerosol optical depth of 0.12 at 550 nm; air by pressure."""
    sea, high = photo.start(), photo.start(700.0)
    assert sea.wavelengths.tolist() == list(bands.NODES)
    np.testing.assert_array_equal(sea.solar_irradiance, 1)
    depth = np.asarray((sea.mie_scattering + sea.mie_absorption) * sea.mie_scale_height)
    assert np.interp(550, bands.NODES, depth) == pytest.approx(0.12, rel=0.02)
    np.testing.assert_allclose(high.rayleigh_scattering / sea.rayleigh_scattering, 700 / 1013.25, rtol=1e-6)


def test_a_mask_leaves_out_what_is_not_sky(monkeypatch):
    """Of a photo the pose is not believed, of a panorama it is."""
    asked = []
    monkeypatch.setattr(
        "diffatmo.skymask.find_sky", lambda pixels, **known: asked.append(known) or types.SimpleNamespace()
    )
    towards = np.array([0.0, 0.0, 1.0])
    photo.find_mask(PANORAMA, Equirectangular(20, 40), towards, {"projection": "equirectangular"})
    photo.find_mask(seascape(), Pinhole(HEIGHT, WIDTH), towards, {"projection": "pinhole", "saturation": 0.9})
    panorama, picture = asked
    assert panorama["elevation"].shape == (20, 40)
    # With the sun at the zenith the angle to it is the rest of the elevation.
    np.testing.assert_allclose(panorama["from_sun"], np.pi / 2 - panorama["elevation"], atol=1e-3)
    assert picture["elevation"] is None
    assert picture["saturation"] == 0.9


def photographed(tmp_path, **options):
    """A photo of a sky over a sea, as it is fitted."""
    height, width = 96, 128
    rows = np.arange(height)[:, None, None]
    sky = np.array([0.25, 0.45, 0.9]) * np.ones((height, width, 1)) * (0.6 + 0.4 * rows / height)
    rough = np.exp(0.3 * np.random.default_rng(0).normal(size=(height, width, 1)))
    pixels = np.where(rows < 72, sky, np.array([0.05, 0.1, 0.12]) * rough).astype(np.float32)
    imageio.write_png(tmp_path / "sea.png", color.srgb_encode(pixels))
    said = {"projection": "pinhole", "fov_deg": 40.0, "yaw_deg": 0.0, "pitch_deg": 10.0, "transfer": "srgb"}
    said |= {"sun_zenith_deg": 40.0, "sun_azimuth_deg": 180.0}
    return prepare(FitSpec((ImageSpec(tmp_path / "sea.png", said | options),)))


def test_a_photo_is_shown_with_what_is_left_out_of_it(tmp_path):
    """Every pixel is counted once, in the report as in the fit."""
    job = photographed(tmp_path)
    (plate,), (view,), (seen,) = plates(job), job.views, job.observations
    assert view.pixels.shape == (96, 128, 3)
    assert {reason: bad.sum() for reason, bad in view.left_out.items()} == seen.masked
    assert plate.file == "mask.png"
    assert plate.caption.startswith("sea: of the picture ")
    assert "left out " in plate.caption
    assert "below the horizon" in plate.caption
    assert "give --mask: a picture of the size of the photo, black where" in plate.caption


def test_a_mask_of_the_user_is_the_one_that_is_shown(tmp_path):
    mask = np.zeros((96, 128, 3))
    mask[:40] = 1
    imageio.write_png(tmp_path / "sky.png", mask)
    job = photographed(tmp_path, mask=str(tmp_path / "sky.png"))
    (plate,), (view,) = plates(job), job.views
    assert "masked by the user" in view.left_out
    assert "ground or object" not in view.left_out
    assert not view.left_out["masked by the user"][:40].any()
    assert plate.caption.endswith("What is sky is what --mask says.")


def test_a_mask_is_not_replaced_by_its_picture(tmp_path):
    spec = FitSpec((ImageSpec(tmp_path / "a.jpg", {"mask": str(tmp_path / "out" / "mask.png")}),))
    with pytest.raises(
        InputError, match=r"mask: .*mask\.png bears the name of a file of the report, expected one outside"
    ):
        check_masks(spec, tmp_path / "out")
    check_masks(spec, tmp_path / "elsewhere")
