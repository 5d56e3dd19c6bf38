"""What images depend on besides the air: it is recovered, it does not bias the air, and the linear part costs no step."""

import dataclasses
import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import plain_residuals
import pytest
import toy_sky
from few_programs import COMPILE_FAST
from plain_residuals import residuals
from scipy.optimize import least_squares
from toy_sky import Toy

import fitting
from diffatmo import sun
from diffatmo.camera import Equirectangular, Fisheye, Pinhole
from diffatmo.models import RayMarch
from fitting import FitError
from fitting.batch import stack
from fitting.elimination import channel_columns, eliminate, optimum, profile
from fitting.linearisation import linearise
from fitting.nuisances import OFFSETS, displace, gather, rotate, sun_axes
from fitting.observation import sigma
from fitting.parameters import select
from fitting.problem import Problem, expected, planet_shell, predict
from fitting.solve import solve

DEG = math.pi / 180
NM = [680.0, 550.0, 440.0]
FREE = ["mie_scattering", "mie_g", "rayleigh_scattering", "mie_scale_height"]
TIE = {"mie_scattering": "grey"}


@eqx.filter_jit
def seen(camera, towards, axes, turn, off):
    """The toy sky by a camera and under a sun that are not quite where they are said to be."""
    directions, there = rotate(camera.directions(), turn), displace(towards, axes, off)
    return Toy().sky(toy_sky.truth()).view(altitude=0.1, sun=there).radiance(view=directions).radiance


def photo(camera, towards, *, name, turn=(0, 0, 0), off=(0, 0), zoom=1.0, black=0.0, factor=1.0, seed=0, **options):
    """A picture whose camera and sun are not quite where the observation says; black level in units of the median."""
    there = [jnp.asarray(x, float) for x in (towards, sun_axes(towards), turn, off)]
    light = factor * np.asarray(seen(camera.zoomed(zoom) if zoom != 1 else camera, *there))
    random = np.random.default_rng(seed)
    noisy = light * (1 + 0.01 * random.standard_normal(light.shape)) + black * np.median(light)
    settings = {"noise": 0.01, "horizon_exclusion": 10 * DEG, "sun_exclusion": 4 * DEG} | options
    return fitting.observe(noisy, camera=camera, altitude=0.1, sun=towards, name=name, **settings)


FISHEYE = Fisheye(40, 40)
PINHOLE = Pinhole(24, 32, fov_y=60 * DEG, pitch=50 * DEG, yaw=20 * DEG)
TURN = np.array([1.2, -1.0, 1.2]) * DEG  # 2° in all
OFF = np.array([0.4, -0.3]) * DEG  # 0.5°


def skewed(**options):
    """Two fisheyes that hang together, an ordinary lens, each with its own sun; all off by what cameras are off by."""
    common = {"off": OFF, "black": 0.01, "zoom": 1.02} | options
    return [
        photo(FISHEYE, toy_sky.towards_sun(30.0), name="a", seed=1, **{"turn": TURN} | common),
        photo(FISHEYE, toy_sky.towards_sun(65.0), name="b", seed=2, **{"turn": TURN} | common),
        photo(
            PINHOLE,
            toy_sky.towards_sun(55.0),
            name="c",
            seed=3,
            **{"turn": -TURN} | common | {"zoom": 2 - common["zoom"]},
        ),
    ]


def with_free(images, **choices):
    """The same images with other nuisances free, one choice or one for each image."""
    return [
        dataclasses.replace(image, **{k: v if isinstance(v, str) else v[number] for k, v in choices.items()})
        for number, image in enumerate(images)
    ]


ALL_FREE = {
    "pedestal": "free",
    "sun_offset": "free",
    "pose": ("rig", "rig", "free"),
    "focal": ("lens", "lens", "free"),
}


@functools.cache
def recovered():
    """The images, and the fit of all that is free."""
    images = with_free(skewed(), **ALL_FREE, exposure=("fixed", "fixed", "free"))
    return images, fitting.fit(images, init=start(), free=FREE, tie=TIE, model=Toy())


def start():
    return toy_sky.change(toy_sky.truth(), mie_scattering=6e-3, mie_g=0.7, mie_scale_height=1.6)


# What is known of the truth -----------------------------------------------------------------------------------------


def test_offsets_and_pedestals_are_recovered_and_do_not_bias_the_air():
    images, found = recovered()
    assert found.converged
    assert found.reduced_chi2 == pytest.approx(1, abs=0.05)
    truth = {
        f"sun_offset_{image}_{way}_deg": value / DEG
        for image in "abc"
        for way, value in zip(("zenith", "azimuth"), OFF, strict=True)
    }
    for group, sign in (("rig", 1), ("c", -1)):
        truth |= {
            f"pose_{group}_{axis}_deg": sign * v / DEG for axis, v in zip(("east", "north", "up"), TURN, strict=True)
        }
    truth |= {"focal_lens": 1.02, "focal_c": 0.98, "exposure_c": 1.0}
    for image in images:
        truth[f"pedestal_{image.name}"] = 0.01 * np.median(image.image) / 1.01
    assert {e.name for e in found.nuisances} == set(truth)
    for estimate in found.nuisances:
        kind = estimate.name.split("_")[0]
        assert abs(estimate.value - truth[estimate.name]) < 4 * estimate.standard_error, estimate
        assert estimate.unit == ("deg" if kind in ("sun", "pose") else "")
        # What is known beforehand is 0.5°, 2° and 5 %; a pedestal is 2e-4.
        most = {"sun": 0.5, "pose": 0.6, "focal": 0.002, "pedestal": 1e-5, "exposure": 0.1}
        assert estimate.standard_error < most[kind]
    for estimate in found.with_truth(toy_sky.truth()).parameters:
        assert abs(estimate.pull) < 4, estimate


def test_kept_predicted_and_planned(tmp_path):
    images, found = recovered()
    found.save(tmp_path / "fit.npz")
    back = fitting.FitResult.load(tmp_path / "fit.npz")
    assert back.nuisances == found.nuisances
    assert [o.pose for o in back.observations] == ["rig", "rig", "free"]
    record = fitting.report.record(found)
    assert record["nuisances"]["pose_rig_up_deg"]["unit"] == "deg"
    assert record["images"][2]["focal"] == "free"
    assert fitting.report.scene_of(found, images[0]) is None
    assert "pose_rig_up_deg" in repr(found)

    scene = fitting.prediction.Scene(toy_sky.truth(), toy_sky.CAMERA, 0.1, toy_sky.towards_sun(45.0))
    assert np.isfinite(found.predict(scene, exposure="exposure_c").standard_error).all()
    with pytest.raises(FitError, match="'pose_rig_up_deg' is not a factor"):
        found.predict(scene, exposure="pose_rig_up_deg")

    parameters = select(found.atmosphere, FREE, TIE)
    taken = fitting.planning.of_observations(images, parameters, Toy())
    names = [estimate.name for estimate in found.nuisances]
    assert list(taken.nuisances) == names
    # What a plan promises of images that exist is what their fit found.
    errors = np.sqrt(np.diag(np.linalg.inv(taken.factor.T @ taken.factor)))
    focal = names.index("focal_c")
    wanted = found.nuisances[focal]
    assert errors[focal] * 0.05 * wanted.value == pytest.approx(wanted.standard_error / found.error_scale, rel=0.05)


def test_fixed_they_spoil_the_fit():
    """The same images: their misfit is far beyond the noise, and the air is off by many of its error bars."""
    fixed = fitting.fit(skewed(), init=start(), free=FREE, tie=TIE, model=Toy())
    assert fixed.reduced_chi2 > 5
    pulls = [abs(e.pull) * fixed.error_scale for e in fixed.with_truth(toy_sky.truth()).parameters if e.pull]
    assert max(pulls) > 20


# Derivatives --------------------------------------------------------------------------------------------------------


def problem(images, model, free=("mie_g",)):
    batch = stack(images, NM)
    parameters = select(toy_sky.truth(), list(free))
    weight = jnp.where(batch.used[..., None], 1 / sigma(batch, batch.measured), 0)
    return Problem(model, parameters, batch, weight, planet_shell(model, parameters))


LENSES = (Fisheye(8, 8), Pinhole(6, 8, fov_y=1.0, pitch=0.9), Equirectangular(6, 24, upper=True))


@pytest.mark.parametrize(
    ("model", "zenith", "parts", "lenses"),
    [
        (Toy(), 0.0, 1, LENSES),
        (Toy(), 40.0, 4, LENSES),
        pytest.param(RayMarch(steps=3), 0.0, 1, LENSES[:1], marks=pytest.mark.slow),
    ],
)
def test_jacobian_against_differences(x64, model, zenith, parts, lenses):
    """Also with the sun at the zenith, and at no rotation, where angles have no derivative; and of averaged pixels."""
    choices = {
        "pedestal": "lens-per-channel",
        "sun_offset": "free",
        "pose": "free",
        "exposure": "free",
        "aerosol": "free",
        "vignetting": "free",
        "tone": "free",
        "chroma": "free",
    }
    size = 400 if parts == 1 else 16
    images = [photo(lens, toy_sky.towards_sun(zenith), name=f"i{n}", max_pixels=size) for n, lens in enumerate(lenses)]
    images = with_free(images, focal=("free", "free", "fixed"), **choices)
    ours = problem(images, model)
    assert ours.batch.directions.shape[2] == parts

    # Of fourth order, as its steps have to be long: angles near a lens's axis are rounded to 1e-11.
    @functools.partial(eqx.filter_jit, compiler_options=COMPILE_FAST)
    def differences(y, ours):
        steps = 1e-5 * jnp.eye(y.size)
        there = [factor * steps for factor in (1, -1, 2, -2)]
        one, back, two, far_back = jax.lax.map(
            lambda step: residuals(y + step, ours), jnp.stack(there).reshape(-1, y.size)
        ).reshape(4, y.size, -1)
        return (8 * (one - back) - (two - far_back)).T / 12e-5

    rest = jnp.zeros(ours.batch.nuisances.size)
    # With nothing moved, and with everything.
    for y in (
        jnp.concatenate([ours.start[:1], rest + n * 0.1 * jnp.sin(jnp.arange(1.0, rest.size + 1))]) for n in (0, 1)
    ):
        slope = plain_residuals.jacobian(y, ours)
        numeric = np.asarray(differences(y, ours))
        scale = np.abs(numeric).max(0)
        # Unmoved, a turn about the zenith changes nothing if the sun is there.
        assert np.all(scale > 0) or (zenith == 0 and not y[1:].any())
        scale = np.where(scale > 0, scale, 1)
        np.testing.assert_allclose(slope / scale, numeric / scale, atol=1e-5)


def test_one_tangent_for_each_component_whatever_the_number_of_images():
    def colours(count, **choices):
        images = [photo(Fisheye(4, 4), toy_sky.towards_sun(20.0 + n), name=f"i{n}", **choices) for n in range(count)]
        ours = problem(images, Toy())
        return (
            eqx.filter_eval_shape(linearise, ours.start, jnp.zeros(ours.batch.nuisances.linear), ours).rows.shape[-1]
            - 3
        )

    kinds = ("pedestal", "exposure", "sun_offset", "pose", "focal", "vignetting", "tone", "chroma", "aerosol")
    everything = dict.fromkeys(kinds, "free")
    assert colours(3, pedestal="free", exposure="free") == 1
    assert colours(2, **everything) == colours(7, **everything) == 1 + len(OFFSETS)
    assert colours(2, pose="rig") == 1 + 3


# Time series --------------------------------------------------------------------------------------------------------


HOURS = (9.0, 10.0, 10.5, 15.0)


def drifting(logs, **options):
    """Images of one day, the aerosol of each more by its logarithm."""
    images = []
    for number, (hour, log) in enumerate(zip(HOURS, logs, strict=True)):
        more = math.exp(log)
        own = toy_sky.truth()
        air = toy_sky.change(own, mie_scattering=more * own.mie_scattering, mie_absorption=more * own.mie_absorption)
        images += toy_sky.observations(
            zeniths=(30.0 + 10 * number,), atmosphere=air, seed=number, aerosol="free", time_h=hour, **options
        )
    return images


def test_what_is_known_of_a_time_series_is_its_covariance(x64):
    """Of an Ornstein-Uhlenbeck process: σ² exp(-|Δt| / T), in whatever order the images come."""
    images = drifting((0, 0, 0, 0), aerosol_memory_h=4.0)
    images = [images[2], photo(FISHEYE, toy_sky.towards_sun(30.0), name="other", pose="free"), *images[:2], images[3]]
    labels, nuisances = gather(images, NM)
    numbers = [n for n, label in enumerate(labels) if label.name.startswith("aerosol_")]
    hours = np.array([float(HOURS[int((float(labels[n].name.split()[-1]) - 30) / 10)]) for n in numbers])
    covariance = np.linalg.inv(nuisances.innovation.T @ nuisances.innovation)
    wanted = np.eye(len(covariance))
    wanted[np.ix_(numbers, numbers)] = np.exp(-np.abs(hours[:, None] - hours) / 4.0)
    np.testing.assert_allclose(covariance, wanted, atol=1e-12)
    np.testing.assert_allclose(nuisances.unit[np.array(numbers)], 0.3)


def test_a_drifting_aerosol_is_followed_and_does_not_bias_the_air():
    logs = (0.3, 0.1, 0.0, -0.4)
    found = fitting.fit(drifting(logs), init=start(), free=FREE, tie=TIE, model=Toy())
    assert found.converged
    assert found.reduced_chi2 == pytest.approx(1, abs=0.05)
    factors = {e.name: e for e in found.nuisances}
    assert set(factors) == {f"aerosol_sun {30 + 10 * n}" for n in range(4)}
    # Only their ratios are the images'; the level is shared with the atmosphere, and known beforehand to 30 %.
    depth = next(e for e in found.with_truth(toy_sky.truth()).parameters if e.name == "mie_optical_depth_550")
    for n, log in enumerate(logs):
        own = factors[f"aerosol_sun {30 + 10 * n}"]
        assert own.value * depth.value == pytest.approx(math.exp(log) * depth.truth, rel=0.03)
        assert abs(math.log(own.value) - log) < 4 * own.standard_error / own.value
        assert 0.05 < own.standard_error / own.value < 0.3
    for estimate in found.with_truth(toy_sky.truth()).parameters:
        assert abs(estimate.pull) < 4, estimate
    steady = fitting.fit(with_free(drifting(logs), aerosol="fixed"), init=start(), free=FREE, tie=TIE, model=Toy())
    assert steady.reduced_chi2 > 5


def test_a_long_memory_steadies_what_an_image_alone_leaves_open():
    """The last image is all but noise: its aerosol is known as well as memory carries over from the one before."""
    images = drifting((0.2, 0.2, 0.2, 0.2))
    images[-1] = dataclasses.replace(images[-1], noise=1000 * images[-1].noise)
    errors = []
    for memory in (0.1, 1000.0):
        own = [dataclasses.replace(image, aerosol_memory_h=memory) for image in images]
        found = fitting.fit(own, init=start(), free=["mie_g"], model=Toy())
        assert found.converged
        errors.append([e.standard_error / e.value for e in found.nuisances])
    assert errors[0][-1] > 0.2
    # √(2 Δt / T) σ for a short Δt.
    assert errors[1][-1] == pytest.approx(0.3 * math.sqrt(2 * 4.5 / 1000), rel=0.1)


# Geometry -----------------------------------------------------------------------------------------------------------


def test_rotation_of_known_vectors():
    """A quarter turn about up takes east to north; a small one is the cross product."""
    east, north, up = jnp.eye(3)
    np.testing.assert_allclose(rotate(east, up * math.pi / 2), north, atol=1e-6)
    np.testing.assert_allclose(rotate(north, jnp.array([math.pi, 0, 0])), -north, atol=1e-6)
    slope = jax.jacfwd(lambda by: rotate(up, by))(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.stack([np.cross(axis, up) for axis in np.eye(3)], axis=-1), atol=1e-7)


def test_a_sun_is_displaced_along_zenith_angle_and_azimuth():
    before = np.asarray(sun.direction(zenith=1.0, azimuth=2.0))
    lower, aside = (displace(jnp.asarray(before), jnp.asarray(sun_axes(before)), 0.01 * jnp.eye(2)[n]) for n in (0, 1))
    np.testing.assert_allclose(np.array(sun.angles(lower)), [1.01, 2.0], atol=1e-6)
    # To second order on the great circle.
    np.testing.assert_allclose(np.array(sun.angles(aside)), [1.0, 2.0 + 0.01 / math.sin(1.0)], atol=5e-5)
    zenith = jnp.array([0.0, 0.0, 1.0])
    slope = jax.jacfwd(lambda by: displace(zenith, jnp.asarray(sun_axes(np.asarray(zenith))), by))(jnp.zeros(2))
    np.testing.assert_allclose(slope.T @ slope, np.eye(2), atol=1e-7)


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE])
def test_a_longer_lens_magnifies(camera):
    """By its factor, at the centre; a pinhole's tangents, a fisheye's angles everywhere."""
    ahead = np.asarray(camera.rotation()[:, 1])
    near, far = (np.arccos(np.asarray(c.directions()) @ ahead) for c in (camera.zoomed(2.0), camera))
    if isinstance(camera, Pinhole):
        near, far = np.tan(near), np.tan(far)
    np.testing.assert_allclose(far, 2 * near, atol=2e-5)


# Elimination --------------------------------------------------------------------------------------------------------


COUPLED = {
    "exposure": ("free", "free", "free"),
    "white_balance": "lens",
    "pedestal": ("body-per-channel",) * 2 + ("free",),
}


def test_the_optimum_is_that_of_all_pixels(x64):
    """Exposures, a shared white balance and pedestals: against scipy with every pixel, from a start a thousand times off."""
    images = with_free(toy_sky.observations(), **COUPLED)
    ours = problem(images, Toy())
    linearisation = linearise(ours.start, jnp.full(9, 0.1), ours)
    far = jnp.concatenate([ours.start, jnp.full(3, 2.5), jnp.zeros(2 + 4)])
    y = eliminate(far, linearisation, ours)

    def rest(linear):
        off = (
            expected(jnp.concatenate([ours.start, jnp.asarray(linear)]), linearisation.radiance, ours)
            - ours.batch.measured
        )
        return np.asarray(jnp.where(ours.batch.used[..., None], off * ours.weight, 0)).ravel()

    wanted = least_squares(
        rest, np.zeros(9), x_scale=np.array([1.0] * 5 + [1e-3] * 4), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert np.sum(rest(y[1:]) ** 2) == pytest.approx(2 * wanted.cost, rel=1e-10)
    np.testing.assert_allclose(y[1:], wanted.x, atol=1e-6)


def test_profile_is_the_minimum_over_the_linear_coordinates(x64):
    random = np.random.default_rng(0)
    factor = np.linalg.qr(random.standard_normal((50, 6)), mode="r")
    jacobian, residual = factor[:, :-1], factor[:, -1]
    small = profile(factor, 2)
    step = random.standard_normal(3)
    there = np.linalg.lstsq(jacobian[:, 3:], -(residual + jacobian[:, :3] @ step), rcond=None)[0]
    change = np.sum((residual + jacobian @ np.concatenate([step, there])) ** 2)
    # The part of the residual along the linear columns is no part of the plane: at an optimum there is none.
    along = np.linalg.qr(jacobian[:, 3:])[0].T @ residual
    assert np.sum((small[:, -1] + small[:, :-1] @ step) ** 2) == pytest.approx(change + along @ along)
    np.testing.assert_allclose(np.sum(small[:, -1] ** 2), np.sum(residual**2))


def test_the_fit_is_the_joint_one(x64):
    """Optimum and covariance are those of a search in all coordinates at once, by another solver."""
    images = with_free(toy_sky.observations(factors=(2.0, 0.5, 1.0)), **COUPLED)
    free = ["mie_scattering", "mie_g"]
    found = solve(images, init=start(), free=free, tie=TIE, model=Toy(), tolerance=1e-7)
    assert found.converged
    parameters = select(start(), free, TIE)
    batch = stack(images, NM)
    own = Problem(Toy(), parameters, batch, jnp.ones(()))
    # Weights are those of the fit's last pass: sigma of its expected light, before that pass.
    lit = batch.exposure(found.y[own.size :]) * predict(
        own.sky, parameters.atmosphere(found.y[: own.size]), batch.views(jnp.zeros((3, 0)))
    )
    own = dataclasses.replace(own, weight=jnp.where(batch.used[..., None], 1 / sigma(batch, lit), 0))
    whitened, slope = eqx.filter_jit(residuals), eqx.filter_jit(jax.jacfwd(residuals))
    joint = least_squares(
        lambda y: np.asarray(whitened(jnp.asarray(y), own)),
        np.asarray(found.y) + 0.05 * np.array([1] * 7 + [1e-2] * 4),
        jac=lambda y: np.asarray(slope(jnp.asarray(y), own)),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    covariance = np.linalg.inv(joint.jac.T @ joint.jac)
    error = np.sqrt(np.diag(covariance))
    # The weights come from the light of the pass before, a tenth of a standard error away or less.
    np.testing.assert_allclose(np.asarray(found.y) / error, joint.x / error, atol=0.02)
    inverse = np.linalg.inv(found.triangle[:-1, :-1].T @ found.triangle[:-1, :-1])
    np.testing.assert_allclose(inverse / np.outer(error, error), covariance / np.outer(error, error), atol=1e-3)


@pytest.mark.parametrize("loss", [None, "tukey"])
def test_a_wrong_exposure_costs_no_step(loss):
    """A thousand times too bright, and known or not: as many steps; the air is the same but for the exposures' own errors."""
    found = {
        (factor, choice): fitting.fit(
            toy_sky.observations(factors=(factor,) * 3, exposure=(choice,) * 3),
            init=start(), free=FREE, tie=TIE, model=Toy(), loss=loss,
        )
        for factor, choice in ((1, "fixed"), (1, "free"), (1000, "free"))
    }  # fmt: skip
    assert all(one.converged for one in found.values())
    assert found[1000, "free"].iterations == found[1, "free"].iterations <= found[1, "fixed"].iterations + 1
    for one, other in zip(found[1, "free"].parameters, found[1000, "free"].parameters, strict=True):
        assert one.value == pytest.approx(other.value, abs=0.05 * one.standard_error)
        assert one.standard_error == pytest.approx(other.standard_error, rel=1e-3)


def test_a_model_that_is_the_negative_of_the_image_is_not_followed():
    """With a pedestal the best factor would be negative: its logarithm stays within reach, and numbers finite."""
    images = with_free(toy_sky.observations(zeniths=(30.0,)), exposure="free", pedestal="free")
    ours = problem(images, Toy())
    columns = channel_columns(linearise(ours.start, jnp.zeros(2), ours), ours)
    # 2 mean - radiance
    columns[..., 0] = 2 * np.mean(images[0].image) * columns[..., 1] - columns[..., 0]
    linear, fall = optimum(np.zeros(2), columns, ours.batch.nuisances)
    assert np.all(np.isfinite(linear))
    assert fall >= 0
    assert abs(linear[0]) <= 3


def test_noise_is_of_the_light_alone():
    """A black level of ten times the light is no signal that shot noise comes with."""
    images = with_free(
        [photo(FISHEYE, toy_sky.towards_sun(40.0), name="a", black=10.0)], exposure="free", pedestal="free"
    )
    found = fitting.fit(images, init=toy_sky.truth(), free=["mie_g"], model=Toy())
    assert found.converged
    assert found.reduced_chi2 == pytest.approx(1, abs=0.1)
    assert np.nanstd(found.whitened[0]) == pytest.approx(1, abs=0.05)


def test_a_black_level_of_any_size_costs_no_step():
    """Half of the pixels negative, or none: the fit is the same."""
    raised = []
    for level in (0.0, -1.0, 3.0):
        random = np.random.default_rng(0)
        light = toy_sky.image(toy_sky.truth(), 50.0)
        pixels = light * (1 + 0.01 * random.standard_normal(light.shape)) + level * np.median(light)
        options = {"camera": toy_sky.CAMERA, "altitude": 0.1, "sun": toy_sky.towards_sun(50.0), "pedestal": "free"}
        raised.append(fitting.observe(pixels, **options))
    init = toy_sky.change(toy_sky.truth(), mie_scattering=5e-3, mie_g=0.7)
    found = [
        fitting.fit([image], init=init, free=["mie_scattering", "mie_g"], tie=TIE, model=Toy()) for image in raised
    ]
    for other in found:
        assert other.message.startswith("converged:")
        assert "other starts" not in other.message
        assert other.reduced_chi2 == pytest.approx(1, abs=0.06)
        assert other.iterations == found[0].iterations
        for mine, first in zip(other.parameters, found[0].parameters, strict=True):
            assert abs(mine.value - first.value) < 0.05 * first.standard_error


# Names and choices --------------------------------------------------------------------------------------------------


def test_groups_share_their_offsets():
    images = [photo(FISHEYE, toy_sky.towards_sun(30.0), name=name) for name in "abc"]
    images = with_free(
        images, pose=("rig", "rig", "fixed"), focal=("fixed", "free", "fixed"), pedestal="dark-per-channel"
    )
    labels, nuisances = gather(images, NM)
    assert [label.name for label in labels] == [
        *("pose_rig_east_deg", "pose_rig_north_deg", "pose_rig_up_deg", "focal_b"),
        *("pedestal_dark_680", "pedestal_dark_550", "pedestal_dark_440"),
    ]
    assert nuisances.moving == (2, 3, 4, 5)
    assert nuisances.offset_index.tolist() == [[0, 1, 2, -1], [0, 1, 2, 3], [-1, -1, -1, -1]]
    moved = nuisances.moved(jnp.ones(4))
    np.testing.assert_allclose(moved, np.array([[2, 2, 2, 0], [2, 2, 2, 0.05 / DEG], [0, 0, 0, 0]]) * DEG, rtol=1e-6)
    np.testing.assert_allclose(nuisances.values(jnp.ones(7)), [2, 2, 2, math.exp(0.05), 1, 1, 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("camera", "options", "message"),
    [
        (toy_sky.CAMERA, {"focal": "free"}, "sky: focal: an equirectangular picture has no focal length"),
        (FISHEYE, {"pose": ""}, "sky: pose: got '', expected"),
        (FISHEYE, {"pedestal": "fixed-per-channel"}, "sky: pedestal: got"),
        (FISHEYE, {"pose": "free", "pose_error": 0.0}, "sky: pose_error: got 0.0, expected more than 0 and at most 1 rad"),
        (FISHEYE, {"focal": "free", "focal_error": math.nan}, "sky: focal_error: got nan"),
    ],
)  # fmt: skip
def test_refuses(camera, options, message):
    with pytest.raises(FitError, match=message):
        photo(camera, toy_sky.towards_sun(30.0), name="sky", **options)


def test_refuses_a_group_of_two_minds():
    images = [
        photo(FISHEYE, toy_sky.towards_sun(30.0), name=n, pose="rig", pose_error=e) for n, e in (("a", 0.1), ("b", 0.2))
    ]
    with pytest.raises(FitError, match=r"b: pose_error: got 0.2, another image of 'rig' has another"):
        gather(images, NM)


def test_images_of_a_group_say_together_when_it_was():
    """In whatever order they come; and a series has one memory."""
    images = [
        toy_sky.observations(zeniths=(zenith,), aerosol=group, time_h=hour)[0]
        for zenith, group, hour in ((30.0, "morning", 7.0), (40.0, "morning", 9.0), (50.0, "noon", 12.0))
    ]
    for order in ((0, 1, 2), (1, 0, 2), (2, 1, 0)):
        _, nuisances = gather([images[n] for n in order], NM)
        covariance = np.linalg.inv(nuisances.innovation.T @ nuisances.innovation)
        assert covariance[0, 1] == pytest.approx(math.exp(-4 / 6), rel=1e-5)
    images[2] = dataclasses.replace(images[2], aerosol_memory_h=1.0)
    with pytest.raises(FitError, match="sun 50: aerosol_memory_h: got 1, another image of the series has 6"):
        gather(images, NM)


def test_what_the_images_do_not_tell_comes_from_what_is_known():
    """A turn about the zenith and the sun's azimuth are one to a sky; each keeps its own share of the error."""
    images = with_free(skewed(zoom=1.0)[:1], pose="free", sun_offset="free", pedestal="free")
    found = fitting.fit(images, init=toy_sky.truth(), free=["mie_g"], model=Toy())
    assert found.converged
    up, azimuth = found.estimate("pose_a_up_deg"), found.estimate("sun_offset_a_azimuth_deg")
    # 0.5° along a circle at 30° from the zenith is 1° of azimuth: with 2° ± and 1° ±, the turn is known to 0.9°.
    assert up.standard_error == pytest.approx(2 / math.sqrt(5), rel=0.1)
    assert azimuth.data_share is not None
    assert azimuth.data_share < 0.5
    assert [prior.name for prior in found.priors] == ["sun_offset_deg", "pose_deg"]


# Elsewhere ----------------------------------------------------------------------------------------------------------


def test_a_plan_knows_what_the_images_leave_in_doubt():
    """With the camera and the sun in doubt the same images tell less, and another shot still tells of the air alone."""
    shots = fitting.planning.candidates([60 * DEG])[:1]
    tight, loose = (
        fitting.planning.plan(images, atmosphere=toy_sky.truth(), free=["mie_g"], shots=shots, count=1, model=Toy())
        for images in (skewed(), with_free(skewed(), **ALL_FREE))
    )
    assert loose.standard_errors[0] > tight.standard_errors[0]
    assert loose.ranking[0].gain > tight.ranking[0].gain > 1


def test_a_checkpoint_belongs_to_one_choice(tmp_path):
    images = with_free(skewed(), pose="rig")
    file = tmp_path / "checkpoint.npz"
    options = {"init": start(), "free": ["mie_g"], "model": Toy(), "checkpoint": file}
    whole = fitting.fit(images, **options)
    again = fitting.fit(images, **options)
    assert again.estimate("pose_rig_up_deg").value == pytest.approx(whole.estimate("pose_rig_up_deg").value, abs=1e-3)
    for other in (with_free(images, pose="free"), [dataclasses.replace(i, pose_error=0.1) for i in images]):
        with pytest.raises(FitError, match="belongs to a fit of other images or options"):
            fitting.fit(other, **options)
