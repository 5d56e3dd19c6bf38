"""The renderer against a sky known in closed form; scenes in EXR headers."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import atmosphere, camera, constants, geometry, imageio, render, scene, sun
from diffatmo.camera import Equirectangular, Fisheye, Pinhole
from diffatmo.models import Model, Path, Sky
from diffatmo.render import Scene


class Haze(Model):
    """A sky in closed form: transmittance exp(-0.2 / (1 + mu)), smooth radiance, no ground."""

    def sky(self, atmosphere):
        return HazeSky(atmosphere)


class HazeSky(Sky):
    atmosphere: atmosphere.Atmosphere

    def path(self, *, altitude, mu, mu_s, nu, distance=None):
        colour = self.atmosphere.solar_irradiance * jnp.array([1.0, 2.0, 3.0])
        light = (1 + nu * nu + 0.3 * mu + jnp.exp(-altitude) * mu_s)[..., None] * colour
        return Path(light, jnp.exp(-0.2 / (1.05 + mu))[..., None] * jnp.array([1.0, 0.9, 0.8]))

    def sun_irradiance(self, *, altitude, mu_s):
        return jnp.zeros((*mu_s.shape, 3))

    def sky_irradiance(self, *, mu_s):
        return jnp.zeros((*mu_s.shape, 3))


CAMERAS = {
    "equirectangular": Equirectangular(32, 64),
    "fisheye": Fisheye(40, 40, fov=np.radians(170.0)),
    "pinhole": Pinhole(24, 36, yaw=0.4, pitch=0.5),
}


@pytest.fixture(params=CAMERAS)
def lens(request):
    return CAMERAS[request.param]


def make_scene(air, lens, zenith=0.9, azimuth=0.5, **rest):
    return Scene(air, lens, **{"altitude": 0.5, "sun": sun.direction(zenith=zenith, azimuth=azimuth)} | rest)


@eqx.filter_jit
def answer(shot, model):
    """What the model says along the directions of the camera, without the renderer."""
    sky = model.sky(shot.atmosphere)
    return sky.radiance(altitude=shot.altitude, view=shot.camera.directions(), sun=shot.sun)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"sun": jnp.array([0.0, 0.0, 1.05])}, "^sun: got .*1.049.*, expected a unit vector"),
        ({"sun": jnp.array([0.6, 0.8])}, "^sun: .* unit vector"),
        ({"sun": jnp.full(3, jnp.nan)}, "^sun: .* unit vector"),
        ({"altitude": -1.0}, "^altitude: got -1.0, expected kilometres >= 0"),
        ({"exposure": 0.0}, "^exposure: got 0.0, expected a finite number > 0"),
    ],
)
def test_a_scene_that_cannot_be_is_refused(s1, values, message):
    good = {"altitude": 0.1, "sun": sun.direction(zenith=1.0, azimuth=0.0)}
    with pytest.raises(render.SceneError, match=message):
        Scene(s1, Equirectangular(4, 8), **(good | values))


def test_scenes_are_made_inside_transformations(s1):
    suns = jax.vmap(lambda zenith: sun.direction(zenith=zenith, azimuth=0.0))(jnp.linspace(0, 1, 3))
    scenes = jax.vmap(lambda towards: Scene(s1, Equirectangular(4, 8), 0.1, towards))(suns)
    np.testing.assert_array_equal(scenes.sun, suns)


def test_pixels_are_the_models_radiance_times_exposure(s1, lens):
    shot = make_scene(s1, lens, exposure=2.5)
    expected = np.where(lens.valid()[..., None], 2.5 * answer(shot, Haze()).radiance, 0)
    np.testing.assert_allclose(render.render(shot, Haze()), expected, rtol=1e-6)


def test_tiles_change_nothing(s1, monkeypatch):
    shot = make_scene(s1, Equirectangular(20, 48))
    whole = render.render(shot, Haze(), sun_disc=True)
    monkeypatch.setattr(render, "TILE_PIXELS", 7 * 48)
    jax.clear_caches()
    np.testing.assert_allclose(render.render(shot, Haze(), sun_disc=True), whole, rtol=1e-6)


def flux_of_sun(shot, **rest):
    """Irradiance that drawing the disc adds to a picture, per wavelength."""
    difference = render.render(shot, Haze(), sun_disc=True, **rest) - render.render(shot, Haze())
    return np.sum(np.asarray(difference, np.float64) * np.asarray(shot.camera.solid_angles())[..., None], (0, 1))


def transmittance(shot, direction):
    return np.exp(-0.2 / (1.05 + float(direction[2]))) * np.array([1.0, 0.9, 0.8])


def test_small_sun_has_the_right_irradiance(s1):
    # Pixels of 1.4 to 5.6 degrees against a disc of half a degree; at the zenith and over the seam of the panorama too.
    for lens, zenith, azimuth in (
        (CAMERAS["equirectangular"], 0.9, 0.5),
        (CAMERAS["equirectangular"], 0.9, 0.0),
        (CAMERAS["equirectangular"], 0.0, 0.0),
        (CAMERAS["fisheye"], 0.9, 0.5),
        (CAMERAS["pinhole"], 0.9, 0.5),
    ):
        shot = make_scene(s1, lens, zenith, azimuth)
        np.testing.assert_allclose(flux_of_sun(shot), transmittance(shot, shot.sun), rtol=1e-3)


def test_resolved_sun_has_the_right_irradiance_and_is_darker_at_the_limb(s1):
    towards = sun.direction(zenith=0.9, azimuth=0.5)
    lens = Pinhole(120, 120, fov_y=np.radians(0.8), yaw=0.5, pitch=np.pi / 2 - 0.9)
    shot = make_scene(s1, lens)
    # 80 pixels across the disc: its rim makes 0.3 %.
    np.testing.assert_allclose(flux_of_sun(shot), transmittance(shot, towards), rtol=5e-3)
    picture = np.asarray(render.render(shot, Haze(), sun_disc=True))
    assert (picture[60, 60] > picture[60, 95]).all()
    # Blue falls off faster towards the limb than red.
    red, _, blue = picture[60, 95] / picture[60, 60]
    assert blue < red


def test_sun_behind_the_ground_or_the_camera_is_not_drawn(s1):
    lens = CAMERAS["equirectangular"]
    assert not flux_of_sun(make_scene(s1, lens, np.radians(92.0))).any()
    half = flux_of_sun(make_scene(s1, lens, float(np.arccos(geometry.horizon_mu(0.5, s1.bottom_radius)))))
    full = transmittance(make_scene(s1, lens), sun.direction(zenith=np.pi / 2, azimuth=0.5))
    np.testing.assert_allclose(half / full, 0.5, atol=0.03)
    assert not flux_of_sun(make_scene(s1, CAMERAS["pinhole"], 0.9, 0.5 + np.pi)).any()


def test_sun_of_another_planet(s1):
    shot = make_scene(s1, CAMERAS["equirectangular"])
    np.testing.assert_allclose(
        flux_of_sun(shot, sun_angular_radius=constants.SUN_ANGULAR_RADIUS / 1.52), flux_of_sun(shot), rtol=1e-3
    )


# --- Derivatives


def picture(parameters, air, shot_of, **options):
    return render.render(shot_of(parameters, air), Haze(), **options)


def posed(kind):
    """(yaw, pitch, roll, fov, sun x, y, z, altitude) -> scene; the sun is turned, not stretched."""

    def build(p, air):
        lens = kind(4, 5, yaw=p[0], pitch=p[1], roll=p[2], **({} if kind is Equirectangular else {FOV[kind]: p[3]}))
        towards = p[4:7] / jnp.linalg.norm(p[4:7])
        return Scene(air, lens, altitude=p[7], sun=towards, exposure=p[3])

    return build


FOV = {Fisheye: "fov", Pinhole: "fov_y"}
SUNS = {"ordinary": (0.3, 0.5, 0.7), "zenith": (0.0, 0.0, 1.0), "horizon": (0.6, 0.8, 0.0)}


@pytest.mark.parametrize("kind", [Equirectangular, Fisheye, Pinhole])
def test_picture_differentiates_in_pose_lens_sun_and_altitude(x64, s1, check_jacobian, kind):
    points = [[0.3, 0.6, 0.2, 0.8, *towards, 0.5] for towards in SUNS.values()]
    check_jacobian(partial(picture, shot_of=posed(kind)), points, s1)


def test_drawn_sun_differentiates(x64, s1, check_jacobian):
    # A sun smaller than a pixel moves through it smoothly; between pixels, and away from them.
    lens = Pinhole(4, 5, pitch=0.7)
    towards = lens.directions_at(jnp.array(2.3), jnp.array(1.4))

    def build(p, air):
        return Scene(air, lens, altitude=0.5, sun=p / jnp.linalg.norm(p))

    check_jacobian(partial(picture, shot_of=build, sun_disc=True), [towards], s1, step=1e-6)


def test_gradients_are_finite_at_special_points(s1):
    lens = Equirectangular(4, 8)

    @eqx.filter_jit
    @eqx.filter_grad
    def gradient(shot):
        return jnp.sum(render.render(shot, Haze(), sun_disc=True))

    for towards in ([0.0, 0, 1], [1.0, 0, 0], [0.0, 0, -1]):
        for leaf in jax.tree.leaves(gradient(Scene(s1, lens, altitude=0.0, sun=jnp.array(towards)))):
            assert np.isfinite(leaf).all()


# --- Scenes in headers


def test_scene_round_trip_loses_nothing(tmp_path, s1, lens):
    shot = make_scene(s1, lens, zenith=1.234567, azimuth=-2.0, exposure=0.37, altitude=1.7)
    pixels = np.asarray(render.render(shot, Haze()))
    path = tmp_path / "a.exr"
    scene.save(path, pixels, shot, notes={"model": "haze", "noise": 0.01, "seed": 3})
    found = scene.load(path)
    np.testing.assert_array_equal(found.pixels, pixels)
    assert eqx.tree_equal(found.scene, shot)
    assert found.notes == {"model": "haze", "noise": 0.01, "seed": 3}
    with pytest.raises(imageio.ImageError, match="exists already"):
        scene.save(path, pixels, shot)


LENSES = {
    "fisheye": lambda: Fisheye(4, 5, fov=3.0, mapping="equisolid", distortion=[0.01, -1 / 300], circle=1 / 1.1),
    "pinhole": lambda: Pinhole(4, 5, distortion=[-0.1, 0.01, 0.0, 1 / 3000]),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_scene_of_many_wavelengths_and_in_double_precision(tmp_path, x64, lens):
    air = atmosphere.earth(jnp.array([620.0, 410.5, 455.1, 500.0]))
    shot = make_scene(air, lens(), exposure=1 / 3)
    pixels = np.random.default_rng(0).random((4, 5, 4)).astype(np.float32)
    scene.save(tmp_path / "a.exr", pixels, shot)
    found = scene.load(tmp_path / "a.exr")
    np.testing.assert_array_equal(found.pixels, pixels)
    assert eqx.tree_equal(found.scene, shot)


def test_header_is_readable(s1):
    text = scene.dumps(make_scene(s1, Pinhole(4, 5), zenith=np.radians(40.0), azimuth=0.0))
    for line in (
        "altitude_km = 0.5",
        "sun_zenith_deg = 40.0",
        'projection = "pinhole"',
        "mie_g = 0.8",
        "fov_y_deg = 60.0",
    ):
        assert line in text.splitlines()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("altitude_km = 0.5", ""), "altitude_km: missing"),
        (("altitude_km = 0.5", 'altitude_km = "high"'), "altitude_km: got 'high', expected a number"),
        (("version = 1", "version = 9"), "version: got 9, expected 1"),
        (("version = 1", "version = "), "not TOML"),
        (("mie_g = 0.8", "mie_g = 1.5"), "mie_g: got 1.5"),
        (('"pinhole"', '"cube"'), "projection: got 'cube'"),
        (("height = 4", "height = 5"), "but its header says"),
    ],
)
def test_damaged_headers_are_refused(tmp_path, s1, change, message):
    text = scene.dumps(make_scene(s1, Pinhole(4, 5)))
    assert change[0] in text
    wavelengths = np.asarray(s1.wavelengths)
    path = tmp_path / "a.exr"
    imageio.write_exr(path, np.ones((4, 5, 3)), {scene.ATTRIBUTE: text.replace(*change, 1)}, wavelengths=wavelengths)
    with pytest.raises(
        imageio.ImageError, match=r"scene in the header: " if "header says" not in message else message
    ) as caught:
        scene.load(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_pictures_without_a_scene_and_of_the_wrong_size(tmp_path, s1):
    imageio.write_exr(tmp_path / "a.exr", np.ones((4, 5, 3)))
    with pytest.raises(imageio.ImageError, match="no attribute 'diffatmo' in the header"):
        scene.load(tmp_path / "a.exr")
    with pytest.raises(imageio.ImageError, match=r"pixels of shape \(4, 6, 3\), expected \(4, 5, 3\) like the scene"):
        scene.save(tmp_path / "b.exr", np.ones((4, 6, 3)), make_scene(s1, Pinhole(4, 5)))


def test_every_projection_has_a_file_name():
    assert set(camera.PROJECTIONS.values()) == {Equirectangular, Fisheye, Pinhole}
