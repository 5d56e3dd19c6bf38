"""Cameras: round trips, known directions, solid angles, derivatives."""

import functools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from few_programs import COMPILE_FAST

from diffatmo import camera
from diffatmo.camera import CameraError, Equirectangular, Fisheye, Pinhole

POSE = {"yaw": 0.7, "pitch": 0.4, "roll": -0.3}
BROWN = [-0.21, 0.09, -0.02, 1.5e-3, -8e-4]
KANNALA = [0.02, -0.012, 0.003, -3e-4]
CAMERAS = {
    "equirectangular": lambda: Equirectangular(12, 24),
    "equirectangular tilted": lambda: Equirectangular(12, 24, **POSE),
    "equirectangular upper": lambda: Equirectangular(6, 24, upper=True),
    "fisheye": lambda: Fisheye(15, 15),
    "fisheye wide": lambda: Fisheye(14, 21, fov=np.radians(220.0), **POSE),
    "equisolid": lambda: Fisheye(15, 15, fov=np.radians(200.0), mapping="equisolid"),
    "stereographic": lambda: Fisheye(15, 15, mapping="stereographic", circle=0.9, **POSE),
    "orthographic": lambda: Fisheye(15, 15, fov=np.radians(160.0), mapping="orthographic", **POSE),
    "fisheye cut": lambda: Fisheye(14, 21, fov=np.radians(170.0), mapping="equisolid", circle=1.3, **POSE),
    "fisheye distorted": lambda: Fisheye(15, 15, fov=np.radians(190.0), distortion=KANNALA, **POSE),
    "pinhole": lambda: Pinhole(9, 16),
    "pinhole distorted": lambda: Pinhole(9, 16, fov_y=np.radians(50.0), distortion=BROWN, **POSE),
    "pinhole tilted": lambda: Pinhole(9, 16, fov_y=np.radians(75.0), **POSE),
}


@pytest.fixture(params=CAMERAS)
def any_camera(request):
    return CAMERAS[request.param]()


@functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
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


LENSES = {
    **{mapping: lambda mapping=mapping: Fisheye(5, 7, fov=2.6, mapping=mapping) for mapping in camera.MAPPINGS},
    "cut": lambda: Fisheye(5, 7, fov=2.6, mapping="stereographic", circle=1.4, **POSE),
    "distorted": lambda: Fisheye(5, 7, fov=3.2, mapping="equidistant", distortion=KANNALA, **POSE),
    "distorted equisolid": lambda: Fisheye(5, 7, fov=3.0, mapping="equisolid", distortion=[0.05], circle=0.9),
    "pinhole": lambda: Pinhole(5, 7, fov_y=1.0),
    "pinhole barrel": lambda: Pinhole(5, 7, fov_y=1.0, distortion=BROWN, **POSE),
    # As many numbers as the other has: one program is of both.
    "pinhole pincushion": lambda: Pinhole(5, 7, fov_y=1.0, distortion=[0.15, 0.03, 0, 0, 0], **POSE),
}
"""All of one size, and given to programs as arguments, so that lenses of a kind share them."""


@pytest.fixture(params=LENSES)
def lens(request, x64):
    return LENSES[request.param]()


def rim(lens):
    """Points (x, y): the axis, inside, at the edge of the picture or just inside of the circle."""
    centre = np.array([(lens.width - 1) / 2, (lens.height - 1) / 2])
    reach = np.array([lens.width, lens.height]) / 2
    if isinstance(lens, Fisheye):
        reach = np.minimum(reach, 0.9999 * min(reach) * float(lens.circle) / np.sqrt(2))
    steps = np.array([[0, 0], [0.3, -0.4], [1, 1], [-1, 1], [1, -1], [0.6, 0]])
    return jnp.asarray(centre + steps * reach)


@functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def from_points(lens, points):
    return lens.directions_at(points[:, 0], points[:, 1])


def fields(lens):
    """Names of the numbers that a lens has, the distortion's last."""
    names = [name for name in ("fov", "fov_y", "circle", "yaw", "pitch", "roll") if hasattr(lens, name)]
    return [*names, *["distortion"] * bool(lens.distortion.size)]


def values(lens):
    return np.concatenate([np.ravel(getattr(lens, name)) for name in fields(lens)])


def with_values(lens, x):
    names, last = fields(lens), x.size - lens.distortion.size
    parts = [*x[:last], x[last:]][: len(names)]
    return replace(lens, **dict(zip(names, parts, strict=True)))


def both_ways(x, lens):
    """Directions of six points, and points of six directions, in these, in a zoom and in all that a lens has."""
    points, towards, other = x[:12].reshape(6, 2), x[12:30].reshape(6, 3), with_values(lens, x[31:]).zoomed(x[30])
    return jnp.concatenate([other.directions_at(points[:, 0], points[:, 1]).ravel(), other.pixels(towards).ravel()])


def test_lenses_differentiate_in_all_they_have_and_invert(lens, check_jacobian):
    """There and back again is where one was, whatever the lens: by the chain rule of both Jacobians."""
    points = rim(lens)
    towards = from_points(lens, points)
    np.testing.assert_allclose(lens.pixels(towards), points, atol=1e-9)
    x = np.concatenate([np.ravel(points), np.ravel(towards), [1.0], values(lens)])
    (slope,) = check_jacobian(both_ways, [x], lens)
    there, back = slope[:18], slope[18:]
    by_towards = back[:, 12:30]
    np.testing.assert_allclose(by_towards @ there[:, :12], np.eye(12), atol=1e-6)
    np.testing.assert_allclose(back[:, 30:] + by_towards @ there[:, 30:], 0, atol=1e-6)


@functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def bent(function, points, *rest):
    """Second derivatives in a point, at every one of ``points``."""
    return jax.vmap(jax.jacfwd(jax.jacfwd(lambda point: function(point, *rest))))(points)


def there_and_back(point, lens):
    return lens.pixels(lens.directions_at(point[0], point[1]))


def distorted_back(point, own):
    return camera._distorted(camera._undistorted(point, own), own)


@pytest.mark.parametrize("name", [name for name, make in LENSES.items() if not make().distortion.size])
def test_lenses_invert_to_second_order(x64, name):
    """Off the axis, where a distance has no second derivative."""
    lens = LENSES[name]()
    np.testing.assert_allclose(bent(there_and_back, rim(lens)[1:], lens), 0, atol=1e-6)


def test_distortions_invert_to_second_order(x64):
    """And so do their lenses, which put them between what is tested above: all distortions by one program, padded alike."""
    for lens in (make() for make in LENSES.values() if make().distortion.size):
        own = lens._lens()
        own = own._replace(radial=jnp.pad(own.radial, (0, 4 - own.radial.size)))
        points = (rim(lens)[1:] - np.array([3, 2])) * lens.pixel_angle
        np.testing.assert_allclose(bent(distorted_back, points, own), 0, atol=1e-6)


@functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
def areas(lens):
    """Of every pixel: what its derivatives span, what its lens says, and whether it is in the picture."""

    def spanned(x, y):
        derivative = jax.jacfwd(lambda xy: lens.directions_at(xy[0], xy[1]))(jnp.stack([x, y]))
        return jnp.linalg.norm(jnp.cross(derivative[:, 0], derivative[:, 1]))

    x, y = jnp.meshgrid(jnp.arange(lens.width) * 1.0, jnp.arange(lens.height) * 1.0)
    return jax.vmap(jax.vmap(spanned))(x, y), lens.solid_angles(), lens.valid()


def test_solid_angles_are_what_pixels_cover(lens):
    spanned, said, valid = map(np.asarray, areas(lens))
    np.testing.assert_allclose(said[valid], spanned[valid], rtol=1e-9)


def test_a_longer_focal_length_magnifies_every_lens(lens):
    points = rim(lens)
    centre = np.array([(lens.width - 1) / 2, (lens.height - 1) / 2])
    # Down to a smaller picture: what is outside of one is continued in another way.
    near = lens.zoomed(0.9).pixels(from_points(lens, points))
    np.testing.assert_allclose(near - centre, 0.9 * (points - centre), atol=1e-9)


@pytest.mark.parametrize(
    ("mapping", "share"),
    [
        ("equidistant", 2 / 3),
        ("equisolid", np.sin(np.pi / 6) / np.sin(np.pi / 4)),
        ("stereographic", np.tan(np.pi / 6)),
        ("orthographic", np.sin(np.pi / 3)),
    ],
)
def test_mappings_at_sixty_degrees(mapping, share):
    lens = Fisheye(101, 101, mapping=mapping)
    north = jnp.array([0.0, np.sin(np.pi / 3), np.cos(np.pi / 3)])
    np.testing.assert_allclose(lens.pixels(north), [50, 50 - 50.5 * share], atol=1e-4)
    # What is below the horizon is outside, also right behind.
    below = jnp.array([[0.0, 0.0, -1.0], [0.0, 0.6, -0.8], [0.6, -0.79, -0.1]])
    assert not np.any(lens.sees(below))


def test_distortions_are_the_published_polynomials(x64):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.5, 0.5, (2, 50))
    k1, k2, k3, p1, p2 = BROWN
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    shown = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ]
    lens = Pinhole(100, 100, fov_y=np.radians(60.0), distortion=BROWN)
    towards = np.stack([x, np.ones_like(x), -y], -1) / np.sqrt(1 + r2)[:, None]
    focal = 50 / np.tan(np.radians(30))
    np.testing.assert_allclose(lens.pixels(jnp.asarray(towards)), 49.5 + focal * np.stack(shown, -1), atol=1e-9)

    # What is left out is zero.
    short, padded = (replace(lens, distortion=jnp.array([k1, k2, *rest])) for rest in ([], [0, 0, 0]))
    np.testing.assert_array_equal(short.pixels(jnp.asarray(towards)), padded.pixels(jnp.asarray(towards)))

    angle = np.linspace(0, np.radians(85), 20)
    polynomial = np.polynomial.polynomial.polyval(angle**2, [1, *KANNALA]) * angle
    lens = Fisheye(100, 100, fov=np.radians(170.0), distortion=KANNALA)
    north = np.stack([0 * angle, np.sin(angle), np.cos(angle)], -1)
    np.testing.assert_allclose(
        49.5 - lens.pixels(jnp.asarray(north))[:, 1], 50 * polynomial / polynomial[-1], atol=1e-9
    )


def test_what_is_far_outside_is_not_folded_into_the_picture():
    lens = Pinhole(60, 80, fov_y=np.radians(50.0), distortion=[-0.25, 0.04])
    angle = np.radians(np.linspace(0, 89.9, 200))
    x, _ = np.moveaxis(np.asarray(lens.pixels(np.stack([np.sin(angle), np.cos(angle), 0 * angle], -1))), -1, 0)
    assert np.all(np.diff(x) > 0)
    assert not bool(lens.sees(jnp.array([0.95, 0.3122499, 0.0])))


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
        (lambda: Fisheye(5, 5, mapping="cubic"), "mapping: got 'cubic', expected one of equidistant, equisolid"),
        (lambda: Fisheye(5, 5, fov=3.2, mapping="orthographic"), "fov: got 183.346 degrees, .* at most 180"),
        (lambda: Fisheye(5, 5, circle=0.0), "circle: got 0, expected a number above 0"),
        (lambda: Fisheye(5, 5, distortion=[-0.3]), r"distortion: \[-0.3.*\] folds the picture"),
        (lambda: Pinhole(5, 5, fov_y=1.5, distortion=[-0.4]), r"distortion: \[-0.4.*\] folds the picture"),
        (lambda: Pinhole(5, 5, distortion=[0.1] * 6), "distortion: got 6 numbers, expected at most 5"),
        (lambda: Pinhole(5, 5, distortion=[np.nan]), "distortion: got .nan., expected finite"),
        (lambda: Pinhole(5, 5, distortion=0.1), "distortion: got an array of shape"),
        (
            lambda: camera.from_dict({"projection": "pinhole", "height": 5, "width": 5, "distortion": ["a"]}),
            "distortion: got .'a'., expected a list of numbers",
        ),
        (
            lambda: camera.from_dict({"projection": "pinhole", "height": 5, "width": 5, "mapping": "equisolid"}),
            "mapping: unknown key",
        ),
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
