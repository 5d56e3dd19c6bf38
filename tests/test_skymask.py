"""Sky masks: on skies of the model with clouds, trees and wires put in, on broken pictures, and on real photographs."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

import diffatmo
from diffatmo import codecs, features, horizon, imageio, render, saturation, skymask, sun
from diffatmo.camera import Equirectangular
from diffatmo.models import Hillaire

CAMERA = Equirectangular(96, 384, upper=True)
AZIMUTH = 3.7
SKIES = {"high sun": (1, 30), "low sun": (1, 80), "haze": (60, 70), "sunset": (20, 89), "twilight": (1, 94)}
"""Aerosol relative to the preset's optical depth of 0.005, and zenith angle of the sun in degrees."""


class Angles:
    """What is known of a panorama's pixels: elevation and angle to the sun, rad, and solid angle."""

    def __init__(self, camera, zenith_deg, azimuth=AZIMUTH):
        towards = np.asarray(camera.directions(), dtype=np.float64)
        to_sun = np.asarray(sun.direction(zenith=np.radians(zenith_deg), azimuth=azimuth), dtype=np.float64)
        self.elevation = np.arcsin(np.clip(towards[..., 2], -1, 1))
        self.from_sun = np.arccos(np.clip(towards @ to_sun, -1, 1))
        self.area = np.asarray(camera.solid_angles())
        self.known = {"elevation": self.elevation, "from_sun": self.from_sun}

    def share(self, part, whole):
        return float(self.area[part & whole].sum() / self.area[whole].sum())


@pytest.fixture(scope="module")
def skies():
    earth = diffatmo.earth(jnp.array([630.0, 540.0, 460.0]))

    @partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
    def sky(haze, zenith):
        atmosphere = eqx.tree_at(
            lambda a: (a.mie_scattering, a.mie_absorption),
            earth,
            (earth.mie_scattering * haze, earth.mie_absorption * haze),
        )
        scene = render.Scene(atmosphere, CAMERA, 0.1, sun.direction(zenith=zenith, azimuth=AZIMUTH))
        return render.render(scene, Hillaire())

    return {
        name: (np.asarray(sky(jnp.array(float(haze)), jnp.radians(zenith))), Angles(CAMERA, zenith))
        for name, (haze, zenith) in SKIES.items()
    }


def smooth_noise(camera, seed, exponent=2.0):
    """A random field over a panorama, of mean 0 and variance 1, whose spectrum falls off as a power: the shape of clouds."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(camera.width), np.fft.fftfreq(2 * camera.height)))
    amplitude = 1 / np.maximum(frequency, 2 / camera.width) ** exponent
    phase = rng.normal(size=(2, *frequency.shape))
    field = np.fft.irfft2(amplitude * (phase[0] + 1j * phase[1]), s=(2 * camera.height, camera.width))[: camera.height]
    return (field - field.mean()) / field.std()


def cloudy(pixels, cover, seed):
    """A sky with white clouds over a share of it, and how much of the light of each pixel is theirs."""
    field = smooth_noise(CAMERA, seed)
    opacity = 1 - np.exp(-6 * np.maximum(field - np.quantile(field, 1 - cover), 0))[..., None]
    white = 1.8 * np.median(pixels.mean(axis=-1)) * np.array([1, 0.97, 0.93])
    return (pixels * (1 - opacity) + white * opacity).astype(np.float32), opacity[..., 0]


@pytest.mark.parametrize("name", SKIES)
def test_a_clear_sky_is_kept(skies, name):
    """In any exposure, with any white balance, with the noise of a camera, and whether or not the sun's place is known."""
    pixels, angles = skies[name]
    rng = np.random.default_rng(0)
    seen = 3e-5 * np.array([0.5, 1, 2]) * pixels * (1 + 0.01 * rng.normal(size=pixels.shape))
    away = angles.from_sun > skymask.SUN_RADIUS
    for picture, known in ((pixels, angles.known), (seen, angles.known), (seen, {"elevation": angles.elevation})):
        mask = skymask.find_sky(picture, **known)
        assert angles.share(~mask.sky, away) < 0.03
        assert mask.cloud_cover < 0.03
        assert not mask.overcast


@pytest.mark.parametrize("name", SKIES)
def test_clouds_are_found(skies, name):
    pixels, angles = skies[name]
    picture, opacity = cloudy(pixels, 0.18, seed=1)
    mask = skymask.find_sky(picture, **angles.known)
    away = angles.from_sun > np.radians(5)
    # A white cloud on a white sky is not seen; the others are.
    visible = away & (opacity > 0.15) & (np.abs(np.log(picture / pixels)).max(axis=-1) > 0.1)
    assert angles.share(~mask.sky, visible) > 0.9
    # A margin of two to three pixels, of 0.9 degrees each here, goes as well.
    assert angles.share(mask.sky, away & (opacity == 0)) > 0.65
    assert 0.1 < mask.cloud_cover < 0.4


def test_broken_clouds(skies):
    """Also where most of the sky is cloud, the clear part is what is taken for clear."""
    pixels, angles = skies["high sun"]
    picture, opacity = cloudy(pixels, 0.6, seed=7)
    mask = skymask.find_sky(picture, **angles.known)
    away = angles.from_sun > np.radians(15)
    assert angles.share(~mask.sky, away & (opacity > 0.15)) > 0.75
    assert angles.share(mask.sky, away & (opacity == 0)) > 0.4
    assert 0.4 < mask.cloud_cover < 0.9


@pytest.mark.parametrize("lumps", [0.0, 0.25])
@pytest.mark.parametrize("balance", [(1, 1, 1), (1.6, 1, 0.6)])
def test_an_overcast_sky_is_said_to_be_one(lumps, balance):
    """The CIE overcast sky, with and without texture, over a dark ground."""
    camera = Equirectangular(128, 256)
    angles = Angles(camera, 50)
    light = (1 + 2 * np.sin(np.maximum(angles.elevation, 0))) / 3 * np.exp(lumps * smooth_noise(camera, 3))
    pixels = np.where(angles.elevation[..., None] > 0, light[..., None] * np.array([0.95, 1, 1.05]) * balance, 0.05)
    for known in (angles.known, {"elevation": angles.elevation}):
        mask = skymask.find_sky(pixels, **known)
        assert mask.overcast
        assert mask.cloud_cover == 1
        assert not mask.sky.any()


def test_trees_wires_and_what_is_clipped(skies):
    pixels, angles = skies["low sun"]
    rng = np.random.default_rng(4)
    picture = pixels.copy()
    tree = np.zeros(pixels.shape[:2], dtype=bool)
    for column in range(20, 370, 45):
        height = int(rng.integers(8, 30))
        tree[-height:, column : column + 14] = True
    picture[tree] = np.array([0.1, 0.12, 0.05]) * np.median(pixels) * rng.uniform(0.3, 1.5, (tree.sum(), 1))
    picture[52, :] *= 0.7
    peak = np.quantile(pixels, 0.995)
    mask = skymask.find_sky(np.minimum(picture, peak), **angles.known)
    assert not mask.sky[tree].any()
    assert not mask.sky[52].any()
    assert np.mean(mask.sky[:45]) > 0.95
    assert (mask.label[(picture > peak).any(axis=-1)] == skymask.SATURATED).all()
    assert mask.counts()["ground or object"] > tree.sum()
    assert sum(mask.counts().values()) == mask.label.size


BROKEN = {
    "constant": np.ones((60, 100, 3)),
    "black": np.zeros((60, 100, 3)),
    "negative": -np.ones((60, 100, 3)),
    "nan": np.full((60, 100, 3), np.nan),
    "infinite": np.full((60, 100, 3), np.inf),
    "huge": np.full((60, 100, 3), 3e38),
    "one pixel": np.ones((1, 1, 3)),
    "a line": np.random.default_rng(0).random((3, 1000, 3)),
    "noise": np.random.default_rng(0).random((90, 200, 3)),
    "holes": np.where(np.random.default_rng(0).random((60, 100, 3)) < 0.3, np.nan, 1.5),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_picture_of_nothing_has_no_sky(name):
    pixels = BROKEN[name].astype(np.float32)
    height, width = pixels.shape[:2]
    elevation = np.broadcast_to(np.linspace(1.5, -1.5, height)[:, None], (height, width))
    for known in ({}, {"elevation": elevation}, {"elevation": elevation * np.nan}, {"from_sun": np.abs(elevation)}):
        mask = skymask.find_sky(pixels, **known)
        assert mask.label.shape == (height, width)
        assert not mask.sky.any()
        shown = skymask.picture(pixels, mask)
        assert shown.shape == pixels.shape
        assert ((shown >= 0) & (shown <= 1)).all()
    assert horizon.find_horizon(pixels) is None


def test_wrong_shapes_are_refused():
    with pytest.raises(features.MaskError, match=r"pixels of shape \(3, 4\), expected \(height, width, 3\)"):
        skymask.find_sky(np.ones((3, 4)))
    with pytest.raises(features.MaskError, match="elevation of shape"):
        skymask.find_sky(np.ones((3, 4, 3)), elevation=np.ones((4, 3)))


def seascape(height, width, row, slope):
    """A photograph of a sea with waves under a clear sky."""
    rng = np.random.default_rng(1)
    above = row + slope * (np.arange(width) - (width - 1) / 2) - np.arange(height)[:, None]
    glow = np.exp(-np.maximum(above, 0) / (height / 2))
    sky = np.stack([0.2 + 0.5 * glow, 0.35 + 0.5 * glow, np.full_like(glow, 0.9)], axis=-1)
    sea = np.array([0.1, 0.2, 0.3]) * np.exp(0.3 * rng.normal(size=(height, width, 1)))
    return np.where(above[..., None] > 0, sky, sea) * (1 + 0.01 * rng.normal(size=(height, width, 3)))


@pytest.mark.parametrize(("row", "slope", "scales"), [(75.3, 0.0, (1,)), (100.0, 0.1, (1, 3)), (60.0, -0.2, (1,))])
def test_horizon_of_the_sea(monkeypatch, row, slope, scales):
    """To a pixel, and with it the mask; a picture larger than the working size has the same horizon."""
    monkeypatch.setattr(features, "WORKING_SIZE", 256)
    pixels = seascape(150, 200, row, slope)
    for scale in scales:
        found = horizon.find_horizon(pixels.repeat(scale, axis=0).repeat(scale, axis=1))
        assert found.row == pytest.approx((row + 0.5) * scale - 0.5, abs=scale)
        assert found.slope == pytest.approx(slope, abs=0.002)
        assert found.confidence > 0.95
    below = np.arange(150)[:, None] - (row + slope * (np.arange(200) - 99.5))
    mask = skymask.find_sky(pixels)
    assert not mask.sky[below > 1].any()
    assert np.mean(mask.sky[below < -10]) > 0.97


def test_no_horizon_where_there_is_none(skies):
    rng = np.random.default_rng(5)
    street = seascape(300, 400, 1e4, 0.0)
    for column in range(0, 400, 40):
        top = int(rng.integers(60, 220))
        street[top:, column : column + 40] = rng.uniform(0.05, 0.4, 3)
        street[top + 5 :: 12, column + 4 : column + 36 : 8] = 0.02
    assert horizon.find_horizon(street) is None
    assert horizon.find_horizon(seascape(150, 200, 1e4, 0.0)) is None
    for name in ("haze", "twilight"):
        assert horizon.find_horizon(skies[name][0][:84]) is None


def test_plateaus_and_peaks():
    """A clipped picture has a plateau; a smooth one, even of eight bits, has none."""
    y, x = np.mgrid[-50:50, -80:80]
    bump = np.repeat(np.exp(-(x**2 + y**2) / 800.0)[..., None], 3, axis=-1).astype(np.float32)
    assert not saturation.clipped(bump).any()
    assert not saturation.clipped(np.round(bump * 255) / 255).any()
    clipped = np.minimum(bump, np.array([0.5, 0.6, 0.7], dtype=np.float32))
    assert saturation.clipped(clipped)[bump[..., 0] > 0.5].all()
    assert not saturation.clipped(clipped)[bump[..., 0] < 0.45].any()
    assert saturation.clipped(bump, saturation=0.8).sum() == (bump[..., 0] >= 0.8).sum()


# Real photographs -----------------------------------------------------------------------------------------------------

REAL = {
    "syferfontein_18d_clear_puresky_1k": (18.46, 215.9, 0.93),
    "spruit_sunrise_1k": (8.03, 215.7, 0.85),
    "kloofendal_43d_clear_puresky_1k": (42.97, 216.1, 0.87),
}
"""Elevation and azimuth of the sun, and how much of the sky above 10 degrees is kept at least."""


TREES = [(slice(217, 250), slice(310, 370)), (slice(192, 255), slice(925, 940)), (slice(210, 250), slice(472, 492))]
"""Rows and columns of a willow, a pylon and a tree against the light in the second of them."""


@pytest.mark.parametrize("name", REAL)
def test_real_panoramas(shared, name):
    elevation_deg, azimuth_deg, kept = REAL[name]
    pixels = codecs.radiance((shared / "real_sky" / f"{name}.hdr").read_bytes())
    angles = Angles(Equirectangular(512, 1024), 90 - elevation_deg, np.radians(azimuth_deg))
    mask = skymask.find_sky(pixels, **angles.known)
    assert angles.share(mask.sky, angles.elevation > np.radians(10)) > kept
    assert not mask.sky[angles.elevation < 0].any()
    assert not mask.sky[angles.from_sun < skymask.SUN_RADIUS].any()
    assert mask.cloud_cover < 0.15
    if name.startswith("spruit"):
        for rows, columns in TREES:
            assert np.mean(mask.sky[rows, columns]) < 0.02
    if name.startswith("kloofendal"):
        # Cirrus on either side of the sun; the blue sky opposite has none.
        assert np.mean(mask.label[122:150, 715:760] == skymask.CLOUD) > 0.5
        assert np.mean(mask.sky[:200, :350]) > 0.99


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("level", [200, 20, 4, 1])
def test_a_clipped_sun_is_found_or_refused(shared, name, level):
    """Wherever it is said to be, there it is: within two standard errors."""
    elevation_deg, azimuth_deg, _ = REAL[name]
    pixels = codecs.radiance((shared / "real_sky" / f"{name}.hdr").read_bytes())
    clipped = np.minimum(pixels, level * np.median(pixels[:250]))
    truth = sun.direction(zenith=np.radians(90 - elevation_deg), azimuth=np.radians(azimuth_deg))
    try:
        found = sun.find(clipped, Equirectangular(512, 1024))
    except sun.SunError:
        assert level < 100
    else:
        assert np.linalg.norm(found.direction - np.asarray(truth)) < 2 * found.uncertainty


def test_real_photograph(shared):
    """A phone's picture of a harbour: the sea's horizon is near row 1130 at the right edge."""
    path = shared / "real_sky" / "helsinki_20220814T111231Z_HMD_Nokia_8.3_5G.jpg"
    pixels = imageio.read_image(path, transfer="srgb").pixels[::2, ::2]
    mask = skymask.find_sky(pixels)
    # A margin of one row of the working size, of three of these, goes as well.
    assert np.flatnonzero(mask.label[:, -1] == skymask.BELOW)[0] == pytest.approx(1130 / 2, abs=5)
    assert not mask.sky[585:].any()
    assert np.mean(mask.sky[:400]) > 0.95
    # The tall building on the left and the ship on the right.
    assert not mask.sky[470:560, 320:385].any()
    assert not mask.sky[505:570, 1450:1775].any()
