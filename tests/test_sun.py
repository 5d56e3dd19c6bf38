"""The sun: limb darkening against measurements, flux by quadrature, derivatives, detection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo import codecs, constants, sun
from diffatmo.camera import Equirectangular, Fisheye, Pinhole

BANDS = jnp.array([680.0, 550.0, 440.0])
IRRADIANCE = jnp.array([1.5, 1.85, 1.78])
RADIUS = constants.SUN_ANGULAR_RADIUS


def around(centre, angles, turns):
    """Unit vectors at given angles from a direction, one per turn about it (NumPy, double precision)."""
    centre = np.asarray(centre, dtype=np.float64)
    side = np.cross(centre, [0.3, -0.5, 0.8])
    side /= np.linalg.norm(side)
    other = np.cross(centre, side)
    across = np.cos(turns)[..., None] * side + np.sin(turns)[..., None] * other
    return np.cos(angles)[..., None] * centre + np.sin(angles)[..., None] * across


def test_direction_and_angles():
    np.testing.assert_allclose(sun.direction(zenith=0.0, azimuth=1.0), [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(sun.direction(zenith=jnp.pi / 2, azimuth=jnp.pi / 2), [1, 0, 0], atol=1e-7)
    zenith, azimuth = np.radians([1.0, 40.0, 90.0, 105.0]), np.radians([10.0, 123.0, 270.0, 359.0])
    back = sun.angles(sun.direction(zenith=jnp.asarray(zenith), azimuth=jnp.asarray(azimuth)))
    np.testing.assert_allclose(back, [zenith, azimuth], atol=3e-6)


def test_a_zenith_angle_in_degrees_is_refused():
    with pytest.raises(sun.SunError, match=r"zenith: got 50\.0, expected radians"):
        sun.direction(zenith=50.0, azimuth=0.0)
    np.testing.assert_allclose(sun.direction(zenith=jnp.float32(np.pi), azimuth=0.0), [0, 0, -1], atol=1e-6)


def test_angles_have_a_derivative_at_the_zenith():
    jacobian = jax.jacfwd(lambda v: jnp.stack(sun.angles(v)))(jnp.array([0.0, 0.0, 1.0]))
    assert np.isfinite(jacobian).all()


def test_limb_darkening_of_the_measured_sun():
    # Neckel & Labs 1994 / Allen's Astrophysical Quantities: I(mu)/I(1) at 550 nm = 0.3 + 0.93 mu - 0.23 mu^2.
    mu = np.linspace(0.3, 1.0, 8)
    law = mu ** float(sun.limb_exponent(jnp.array(550.0)))
    np.testing.assert_allclose(law, 0.3 + 0.93 * mu - 0.23 * mu**2, atol=0.02)


@pytest.mark.parametrize("towards", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, -1.0, 0.0)])
def test_disc_integrates_to_the_irradiance(x64, towards):
    # Gauss-Legendre in sin^2 of the angle to the sun, in which the projected solid angle is uniform; the limb's
    # (1 - u)^0.25 limits 200 nodes to 1e-4.
    nodes, weights = np.polynomial.legendre.leggauss(200)
    u, weights = 0.5 * (nodes + 1), 0.5 * weights
    angle = np.arcsin(np.sqrt(u) * np.sin(RADIUS))
    radiance = sun.disc_radiance(
        view=around(towards, angle, np.full(u.size, 0.7)),
        sun=jnp.array(towards),
        irradiance=IRRADIANCE,
        wavelengths=BANDS,
    )
    flux = np.pi * np.sin(RADIUS) ** 2 * weights @ np.asarray(radiance)
    np.testing.assert_allclose(flux, IRRADIANCE, rtol=1e-4)


def test_disc_in_single_precision_and_outside():
    towards = np.asarray(sun.direction(zenith=1.1, azimuth=0.4))
    angles = np.array([0.0, 0.5 * RADIUS, 0.99 * RADIUS, 1.01 * RADIUS, 0.1, np.pi / 2, np.pi])
    view = around(towards.astype(np.float64), angles, np.full(angles.size, 2.0))
    found = sun.disc_radiance(
        view=jnp.asarray(view, dtype=jnp.float32), sun=jnp.asarray(towards), irradiance=IRRADIANCE, wavelengths=BANDS
    )
    exponent = np.asarray(sun.limb_exponent(BANDS), dtype=np.float64)
    mu = np.sqrt(1 - (np.sin(angles[:3]) / np.sin(RADIUS)) ** 2)
    centre = np.asarray(IRRADIANCE) / (np.pi * np.sin(RADIUS) ** 2) * (1 + exponent / 2)
    # A direction is good to 1e-7 rad = 2e-5 of the disc's radius; near the limb that is amplified by 1 / mu^2 = 50.
    np.testing.assert_allclose(found[:3], centre * mu[:, None] ** exponent, rtol=2e-3)
    np.testing.assert_array_equal(found[3:], 0)


def test_disc_points_carry_the_whole_irradiance_and_the_right_moments():
    towards = sun.direction(zenith=0.9, azimuth=-2.0)
    points, shares = sun.disc_points(towards, wavelengths=BANDS)
    np.testing.assert_allclose(shares.sum(0), 1, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(jnp.einsum("nw,ni->wi", shares, points), np.tile(towards, (3, 1)), atol=3e-5)
    # Mean of sin^2 over a disc darkened as mu^alpha, by beta functions: sin^2(radius) / (2 + alpha / 2).
    squared = jnp.sum((points - towards) ** 2, axis=-1)
    expected = np.sin(RADIUS) ** 2 / (2 + np.asarray(sun.limb_exponent(BANDS)) / 2)
    np.testing.assert_allclose(squared @ shares, expected, rtol=2e-3)


def test_disc_differentiates_in_the_suns_direction(x64, check_jacobian):
    # At points well inside the disc and outside it, with the sun at the zenith and on the horizon too.
    def radiance(direction, view):
        return sun.disc_radiance(view=view, sun=direction, irradiance=IRRADIANCE, wavelengths=BANDS)

    turns = np.linspace(0, 6, 4)
    for towards in ([0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 1.0, 0.0]):
        view = np.concatenate([around(towards, np.full(4, part * RADIUS), turns) for part in (0.3, 0.8, 1.2)])
        check_jacobian(radiance, [towards], jnp.asarray(view), step=1e-8)


def test_no_nan_on_the_limb_at_the_centre_and_behind():
    towards = sun.direction(zenith=0.4, azimuth=0.0)
    view = jnp.asarray(
        np.concatenate([around(towards, np.full(50, a), np.linspace(0, 6, 50)) for a in (0.0, RADIUS, np.pi)]),
        dtype=jnp.float32,
    )

    @jax.jit
    def total(direction):
        return jnp.sum(sun.disc_radiance(view=view, sun=direction, irradiance=IRRADIANCE, wavelengths=BANDS))

    assert np.isfinite(jax.grad(total)(towards)).all()
    points = jax.jit(jax.jacfwd(lambda s: sun.disc_points(s, wavelengths=BANDS, count=16)[0]))
    for direction in (towards, jnp.array([0.0, 0, 1]), jnp.array([0.0, 0, -1]), jnp.array([1.0, 0, 0])):
        assert np.isfinite(points(direction)).all()


def sky_with_sun(camera, towards, width_deg=0.3):
    """A smooth bright sky with a small, very bright spot."""
    directions = np.asarray(camera.directions(), dtype=np.float64)
    angle = np.degrees(np.arccos(np.clip(directions @ np.asarray(towards, dtype=np.float64), -1, 1)))
    light = 1 + 10 * np.exp(-angle / 10) + 1e5 * np.exp(-0.5 * (angle / width_deg) ** 2)
    return light[..., None] * np.ones(3, dtype=np.float32)


@pytest.mark.parametrize(
    "camera",
    [Equirectangular(180, 360), Equirectangular(180, 360, yaw=2.0, pitch=0.3), Fisheye(200, 200), Pinhole(150, 200)],
    ids=["panorama", "tilted panorama", "fisheye", "pinhole"],
)
def test_sun_is_found(camera):
    towards = np.asarray(camera.directions_at(jnp.array(camera.width * 0.37), jnp.array(camera.height * 0.41)))
    spot = max(0.3, 0.6 * np.degrees(float(camera.pixel_angle)))
    found = sun.find(sky_with_sun(camera, towards, spot), camera)
    error = np.linalg.norm(found.direction - towards)
    assert error < 0.15 * float(camera.pixel_angle)
    assert error < found.uncertainty < 1.5 * np.radians(spot)


def test_sun_at_the_zenith_of_a_panorama_and_across_its_seam():
    camera = Equirectangular(180, 360)
    for towards in (sun.direction(zenith=0.001, azimuth=1.0), sun.direction(zenith=1.0, azimuth=0.0)):
        found = sun.find(sky_with_sun(camera, towards, 0.8), camera)
        assert np.linalg.norm(found.direction - np.asarray(towards)) < np.radians(0.2)


def test_overflowed_sun_is_found():
    camera = Equirectangular(180, 360)
    towards = camera.directions()[40, 100]
    picture = sky_with_sun(camera, towards)
    picture[picture > 1e4] = np.inf
    picture[100, 200] = np.nan
    assert np.linalg.norm(sun.find(picture, camera).direction - towards) < np.radians(0.5)


def test_pictures_without_one_sun_are_refused():
    camera = Equirectangular(90, 180)
    one = sky_with_sun(camera, camera.directions()[30, 50], 2.0)
    two = one + sky_with_sun(camera, camera.directions()[40, 120], 2.0)
    with pytest.raises(sun.SunError, match="no single sun found"):
        sun.find(two, camera)
    with pytest.raises(sun.SunError, match=r"no sun found: the brightest pixel is only \d\.\d times"):
        sun.find(np.minimum(one, 5), camera)
    with pytest.raises(sun.SunError, match="no light"):
        sun.find(np.zeros((90, 180, 3)), camera)


@pytest.mark.parametrize(
    ("name", "elevation_deg", "azimuth_deg"),
    [
        ("syferfontein_18d_clear_puresky_1k", 18.46, 215.9),
        ("spruit_sunrise_1k", 8.03, 215.7),
        ("kloofendal_43d_clear_puresky_1k", 42.97, 216.1),
    ],
)
def test_real_suns_are_found(shared, name, elevation_deg, azimuth_deg):
    picture = codecs.radiance((shared / "real_sky" / f"{name}.hdr").read_bytes())
    found = sun.find(picture, Equirectangular(*picture.shape[:2]))
    truth = sun.direction(zenith=np.radians(90 - elevation_deg), azimuth=np.radians(azimuth_deg))
    error = float(np.linalg.norm(found.direction - np.asarray(truth)))
    assert error < np.radians(0.15)
    assert error < 2 * found.uncertainty
