"""Cameras: round trips, known directions, solid angles, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import camera
from diffatmo.camera import CameraError, Equirectangular, Fisheye, Pinhole

POSE = {"yaw": 0.7, "pitch": 0.4, "roll": -0.3}
CAMERAS = {
    "equirectangular": lambda: Equirectangular(12, 24),
    "equirectangular tilted": lambda: Equirectangular(12, 24, **POSE),
    "equirectangular upper": lambda: Equirectangular(6, 24, upper=True),
    "fisheye": lambda: Fisheye(15, 15),
    "fisheye wide": lambda: Fisheye(14, 21, fov=np.radians(220.0), **POSE),
    "pinhole": lambda: Pinhole(9, 16),
    "pinhole tilted": lambda: Pinhole(9, 16, fov_y=np.radians(75.0), **POSE),
}


@pytest.fixture(params=CAMERAS)
def any_camera(request):
    return CAMERAS[request.param]()


@eqx.filter_jit
def round_trip(lens, towards):
    """Everything the round trips below need, compiled once per camera."""
    directions, xy = lens.directions(), lens.pixels(towards)
    return {
        "directions": directions,
        "pixels": lens.pixels(directions),
        "pixels seen": lens.sees(directions),
        "valid": lens.valid(),
        "solid angles": lens.solid_angles(),
        "seen": lens.sees(towards),
        "xy": xy,
        "again": lens.directions_at(xy[..., 0], xy[..., 1]),
    }


def test_pixels_and_directions_are_inverse(any_camera):
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(4000, 3)).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    found = {name: np.asarray(value) for name, value in round_trip(any_camera, towards).items()}

    np.testing.assert_allclose(np.linalg.norm(found["directions"], axis=-1), 1, atol=1e-6)
    valid = found["valid"]
    y, x = np.mgrid[: any_camera.height, : any_camera.width]
    # float32 angles are good to 1e-6 rad, a pixel here is 0.1 rad or more.
    np.testing.assert_allclose(found["pixels"][valid], np.stack([x, y], -1)[valid], atol=2e-4)
    assert found["pixels seen"][valid].all()

    seen = found["seen"]
    assert np.isfinite(found["xy"]).all()
    np.testing.assert_allclose(found["again"][seen], towards[seen], atol=3e-6)
    # The share of random directions that is seen is the picture's solid angle; 4000 of them know it to 0.008 (1 σ).
    share = found["solid angles"][valid].sum() / (4 * np.pi)
    assert seen.mean() == pytest.approx(share, abs=0.025)


def test_equirectangular_convention():
    height, width = 8, 16
    v = np.asarray(Equirectangular(height, width).directions(), dtype=np.float64)
    azimuth = np.degrees(np.arctan2(v[..., 0], v[..., 1])) % 360
    zenith = np.degrees(np.arccos(v[..., 2]))
    np.testing.assert_allclose(azimuth, np.broadcast_to(360 * (np.arange(width) + 0.5) / width, v.shape[:2]), atol=1e-4)
    np.testing.assert_allclose(
        zenith, np.broadcast_to((180 * (np.arange(height) + 0.5) / height)[:, None], v.shape[:2]), atol=1e-4
    )
    upper = Equirectangular(height, width, upper=True).directions()
    np.testing.assert_allclose(np.degrees(np.arcsin(upper[-1, :, 2])), 90 / height / 2, atol=1e-4)


def test_equirectangular_solid_angles_add_up():
    assert float(jnp.sum(Equirectangular(64, 128).solid_angles())) == pytest.approx(4 * np.pi, rel=1e-6)
    assert float(jnp.sum(Equirectangular(64, 128, upper=True).solid_angles())) == pytest.approx(2 * np.pi, rel=1e-6)


def test_solid_angles_of_circle_and_rectangle():
    # A fisheye's circle is a cap, 2 pi (1 - cos(fov / 2)); pixels cut by its rim leave 1 %.
    lens = Fisheye(200, 200, fov=np.radians(150.0))
    total = float(jnp.sum(jnp.where(lens.valid(), lens.solid_angles(), 0)))
    assert total == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(75.0))), rel=0.01)
    # Rectangle seen from above its centre: 4 arcsin(sin(a) sin(b)), a and b the half-angles of the two planes.
    lens = Pinhole(100, 200, fov_y=np.radians(60.0))
    a, b = np.radians(30.0), np.arctan(2 * np.tan(np.radians(30.0)))
    assert float(jnp.sum(lens.solid_angles())) == pytest.approx(4 * np.arcsin(np.sin(a) * np.sin(b)), rel=1e-3)


def test_fisheye_looks_up_with_north_at_the_top_and_east_on_the_left():
    lens = Fisheye(101, 101)
    up, north, east = jnp.eye(3)[2], jnp.eye(3)[1], jnp.eye(3)[0]
    np.testing.assert_allclose(lens.pixels(up), [50, 50], atol=1e-4)
    np.testing.assert_allclose(lens.pixels(north), [50, -0.5], atol=1e-4)
    np.testing.assert_allclose(lens.pixels(east), [-0.5, 50], atol=1e-4)
    # Equidistant: half way to the horizon is half way to the rim.
    np.testing.assert_allclose(lens.pixels((up + north) / np.sqrt(2)), [50, 24.75], atol=1e-4)


def test_pinhole_frame():
    lens = Pinhole(101, 201, fov_y=np.radians(90.0), yaw=np.radians(90.0))
    east, south, up = jnp.array([1.0, 0, 0]), jnp.array([0, -1.0, 0]), jnp.array([0, 0, 1.0])
    np.testing.assert_allclose(lens.pixels(east), [100, 50], atol=1e-4)
    # At 45 degrees to the axis, in a lens of 90 degrees: on the edge.
    np.testing.assert_allclose(lens.pixels((east + up) / np.sqrt(2)), [100, -0.5], atol=1e-4)
    np.testing.assert_allclose(lens.pixels((east + south) / np.sqrt(2)), [150.5, 50], atol=1e-4)
    assert not bool(lens.sees(-east))
    assert not bool(lens.sees(up))
    # Rolled clockwise by 90 degrees its right side points down.
    rolled = Pinhole(101, 201, roll=np.radians(90.0))
    np.testing.assert_allclose(rolled.rotation() @ jnp.array([1.0, 0, 0]), [0, 0, -1], atol=1e-6)


def test_pitch_and_yaw_point_the_axis():
    lens = Pinhole(3, 3, yaw=np.radians(30.0), pitch=np.radians(40.0), roll=0.2)
    expected = [np.sin(np.radians(30)) * np.cos(np.radians(40)), np.cos(np.radians(30)) * np.cos(np.radians(40))]
    np.testing.assert_allclose(lens.directions()[1, 1], [*expected, np.sin(np.radians(40))], atol=1e-6)


@pytest.mark.parametrize("kind", [Equirectangular, Fisheye, Pinhole])
def test_directions_differentiate_in_every_angle(x64, check_jacobian, kind):
    names = [name for name in ("yaw", "pitch", "roll", "fov", "fov_y") if name in kind.__dataclass_fields__]

    def directions(angles):
        return kind(5, 7, **dict(zip(names, angles, strict=True))).directions()

    # An ordinary pose, and cameras that look straight up and down.
    points = [[0.7, pitch, -0.3, 1.2][: len(names)] for pitch in (0.3, np.pi / 2, -np.pi / 2)]
    check_jacobian(directions, points, tolerance=1e-8)


@pytest.mark.parametrize("kind", [Equirectangular, Fisheye, Pinhole])
def test_projection_differentiates(x64, check_jacobian, kind):
    lens = kind(50, 70, yaw=0.7, pitch=0.2, roll=-0.3)
    points = lens.directions_at(jnp.array([20.3, 40.0]), jnp.array([11.2, 30.0]))
    check_jacobian(lambda v, lens: lens.pixels(v), points, lens)


@pytest.mark.parametrize("kind", [Equirectangular, Fisheye, Pinhole])
def test_no_nan_at_special_directions(kind):
    lens = kind(5, 5)
    axes = jnp.concatenate([lens.rotation().T, -lens.rotation().T, jnp.eye(3), -jnp.eye(3)])
    assert np.isfinite(lens.pixels(axes)).all()
    assert np.isfinite(jax.jit(jax.vmap(jax.jacrev(lambda v: lens.pixels(v))))(axes)).all()
    assert np.isfinite(jax.jit(jax.jacfwd(lambda xy: lens.directions_at(*xy)))(jnp.array([2.0, 2.0]))).all()


def test_vmap_over_poses_and_jit():
    yaws = jnp.linspace(0.0, 1.0, 4)
    fast = jax.jit(jax.vmap(lambda yaw: Pinhole(4, 6, yaw=yaw).directions()))(yaws)
    np.testing.assert_allclose(fast[2], Pinhole(4, 6, yaw=yaws[2]).directions(), atol=1e-6)


def test_dict_round_trip_loses_nothing(any_camera):
    data = camera.to_dict(any_camera)
    again = camera.from_dict(data)
    assert type(again) is type(any_camera)
    assert eqx.tree_equal(again, any_camera)


def test_dict_is_readable():
    data = camera.to_dict(Fisheye(4, 5, fov=np.radians(185.0)))
    assert data == {
        "projection": "fisheye",
        "height": 4,
        "width": 5,
        "fov_deg": 185.0,
        "yaw_deg": 180.0,
        "pitch_deg": 90.0,
        "roll_deg": 0.0,
    }


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Pinhole(0, 5), "height: got 0, expected a whole number"),
        (lambda: Pinhole(5, 2.5), "width: got 2.5"),
        (lambda: Pinhole(5, True), "width: got True"),
        (lambda: Pinhole(5, 5, yaw=float("nan")), "yaw: got nan, expected a finite angle"),
        (lambda: Pinhole(5, 5, fov_y=np.pi), "fov_y: got 180 degrees, expected more than 0 and at most 179"),
        (lambda: Fisheye(5, 5, fov=0.0), "fov: got 0 degrees"),
        (lambda: Fisheye(5, 5, fov=np.zeros(2)), "fov: got an array"),
        (lambda: camera.from_dict({"projection": "cube"}), "projection: got 'cube', expected one of equirectangular"),
        (lambda: camera.from_dict({"projection": "pinhole", "height": 5}), "width: missing"),
        (
            lambda: camera.from_dict({"projection": "pinhole", "height": 5, "width": 5, "fov_deg": 3.0}),
            "fov_deg: unknown key; a camera with pinhole projection has height, width, fov_y_deg",
        ),
        (
            lambda: camera.from_dict({"projection": "pinhole", "height": 5, "width": 5, "yaw": 3.0}),
            "yaw: unknown key",
        ),
        (
            lambda: camera.from_dict({"projection": "fisheye", "height": 5, "width": 5, "fov_deg": "wide"}),
            "fov_deg: got 'wide', expected a number",
        ),
        (
            lambda: camera.from_dict({"projection": "equirectangular", "height": 5, "width": 5, "upper": 1}),
            "upper: got 1, expected true or false",
        ),
    ],
)
def test_bad_values_are_refused(make, message):
    with pytest.raises(CameraError, match="^" + message):
        make()
