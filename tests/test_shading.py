"""What a camera makes of the light: channels that are bands, vignetting, a tone curve and other primaries, in the fit."""

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
from toy_sky import Toy

import fitting
from diffatmo import bands, color
from diffatmo.atmosphere import Atmosphere
from diffatmo.camera import Pinhole
from fitting import FitError
from fitting.batch import stack
from fitting.least_squares import reduce_images
from fitting.linearisation import linearise
from fitting.nuisances import assumed, gather, shading
from fitting.observation import sigma, unstack
from fitting.parameters import select
from fitting.problem import Problem

DEG = math.pi / 180
NM = [680.0, 550.0, 440.0]
NODES = (680.0, 600.0, 520.0, 440.0)
SUN = toy_sky.towards_sun(40.0)
LENS = Pinhole(15, 20, fov_y=60 * DEG, pitch=50 * DEG, yaw=80 * DEG)
SHADED = {"vignetting": "free", "tone": "free", "chroma": "free"}


def air(sun_irradiance=(1.0,) * 4) -> Atmosphere:
    """The toy's atmosphere at four wavelengths."""
    own = toy_sky.truth()
    spread = lambda values: jnp.interp(jnp.array(NODES), own.wavelengths[::-1], values[::-1])
    names = ("rayleigh_scattering", "mie_scattering", "mie_absorption", "ozone_absorption", "ground_albedo")
    return dataclasses.replace(
        own,
        wavelengths=jnp.array(NODES),
        solar_irradiance=jnp.array(sun_irradiance),
        **{name: spread(getattr(own, name)) for name in names},
    )


MIXING = bands.Bands(
    ("red", "green", "blue"),
    np.array([630.0, 550.0, 460.0]),
    np.array([[0.6, 0.5, 0.1, -0.1], [0.1, 0.4, 0.5, 0.05], [0.0, -0.05, 0.3, 0.7]]),
    NODES,
)
"""As a matrixed camera's, with negative parts."""


@eqx.filter_jit
def spectrum(atmosphere):
    return Toy().sky(atmosphere).view(altitude=0.1, sun=SUN).radiance(view=LENS.directions()).radiance


@functools.cache
def light(response=None, sun_irradiance=(1.0,) * 4):
    """What the lens sees of three wavelengths, or of four, or of these through ``MIXING``."""
    with jax.enable_x64(False):
        seen = spectrum(toy_sky.truth() if response is None else air(sun_irradiance))
    return np.asarray(seen, dtype=float) @ (MIXING.response.T if response == "mixing" else np.eye(seen.shape[-1]))


def picture(pixels, noise=0.005, seed=0, **options):
    """An observation of ``pixels`` with relative noise."""
    noisy = pixels * (1 + noise * np.random.default_rng(seed).standard_normal(pixels.shape))
    said = {"camera": LENS, "altitude": 0.1, "sun": SUN, "noise": noise, "name": "photo"}
    return fitting.observe(noisy, **said | options)


def problem(images, atmosphere, free):
    batch = stack(images, list(np.asarray(atmosphere.wavelengths)))
    weight = jnp.where(batch.used[..., None], 1 / sigma(batch, batch.measured), 0)
    return Problem(Toy(), select(atmosphere, free), batch, weight)


# Derivatives --------------------------------------------------------------------------------------------------------


def test_derivatives_against_differences(x64):
    """In the coefficients of the shading, the air, a turn and an aerosol, of channels that are bands.

    Of channels that are wavelengths, see test_nuisances.py.
    """
    offsets = {"exposure": "free", "pedestal": "free", "aerosol": "free", "bands": MIXING}
    images = [
        picture(light("mixing"), name="a", pose="free", **SHADED, **offsets),
        picture(light("mixing"), name="b", seed=1, vignetting="free", **offsets),
    ]
    ours = problem(images, air(), ["mie_g", "mie_scattering", "mie_scale_height"])
    plain = eqx.filter_jit(plain_residuals.residuals, compiler_options=COMPILE_FAST)
    around = jnp.concatenate([ours.start, jnp.zeros(ours.batch.nuisances.linear)])
    # With everything moved, by tenths of what is known of it.
    y = around + 0.1 * jnp.sin(jnp.arange(1.0, around.size + 1))
    slope = plain_residuals.jacobian(y, ours)
    odd = lambda step: np.asarray(plain(y + step, ours) - plain(y - step, ours))
    steps = 1e-4 * np.eye(y.size)
    numeric = np.stack([8 * odd(step) - odd(2 * step) for step in steps], axis=-1) / 12e-4
    scale = np.abs(numeric).max(axis=0)
    assert np.all(scale > 0)
    np.testing.assert_allclose(slope / scale, numeric / scale, atol=1e-6)


def test_nothing_moved_is_nothing_changed():
    """To the bit: exp(0) = 1; and what is fixed has no columns at all."""
    plain, shaded = (stack([picture(light(), **more)], NM) for more in ({}, SHADED))
    assert plain.shading.shape[-1] == 0
    assert shaded.shading.shape[-1] == 6
    for batch in (plain, shaded):
        moved = batch.nuisances.moved(jnp.zeros(batch.nuisances.offsets))
        np.testing.assert_array_equal(batch.modulation(moved), np.ones(batch.measured.shape))


# What is known of the truth -----------------------------------------------------------------------------------------

TRUTH = {
    "vignetting_photo_2": -0.5,
    "vignetting_photo_4": -0.2,
    "tone_photo_1": 0.1,
    "tone_photo_2": -0.08,
    "tone_photo_3": 0.05,
    "chroma_photo_saturation": 0.15,
}


def made(pixels, white, coefficients):
    """What a camera with these coefficients makes of the light: the picture whose own values say how it was changed."""
    v2, v4, t1, t2, t3, s = coefficients
    y, x = (np.arange(n) - (n - 1) / 2 for n in pixels.shape[:2])
    corner = math.hypot(pixels.shape[0] / 2, pixels.shape[1] / 2)
    rho = np.hypot(*np.meshgrid(y, x, indexing="ij"))[..., None] / corner
    result = pixels
    for _ in range(100):
        u = np.log(result / white)
        grey = (result @ color.LUMINANCE)[..., None]
        change = v2 * rho**2 + v4 * rho**4 + t1 * u + t2 * u**2 / 3 + 2 * t3 * result / white + s * (1 - grey / result)
        result = pixels * np.exp(change)
    return result


@pytest.fixture(scope="module")
def photo():
    pixels = light("mixing")
    # What a sky has of its own, before a camera makes a picture of it.
    uneven = pixels * (1 + 0.005 * np.random.default_rng(2).standard_normal(pixels.shape))
    white = 1.2 * pixels.max()
    seen = made(uneven, white, list(TRUTH.values()))
    assert seen.max() < white
    return fitting.observe(
        seen, camera=LENS, altitude=0.1, sun=SUN, noise=0.005, saturation=white, bands=MIXING, name="photo",
        exposure="free", exposure_value=0.5, **SHADED,
    )  # fmt: skip


FREE = ["mie_scattering", "mie_g"]
INIT = {"mie_scattering": 5e-3, "mie_g": 0.75}


@pytest.fixture(scope="module")
def found(photo):
    init = toy_sky.change(air(), **INIT)
    return fitting.fit([photo], init=init, free=FREE, tie={"mie_scattering": "grey"}, model=Toy())


def test_shading_is_recovered_and_does_not_bias_the_air(found):
    assert found.converged
    assert found.reduced_chi2 == pytest.approx(1, abs=0.1)
    assert [e.name for e in found.nuisances] == [*TRUTH, "exposure_photo"]
    for estimate in found.nuisances[:-1]:
        assert estimate.unit == ""
        assert abs(estimate.value - TRUTH[estimate.name]) < 4 * estimate.standard_error, estimate
        # The picture says it: as sharply as this, and, of most of them, that they are not zero.
        assert estimate.standard_error < {"vignetting": 0.25, "tone": 0.15, "chroma": 0.05}[estimate.name.split("_")[0]]
    factor = found.nuisances[-1]
    assert abs(factor.value - 2) < 4 * factor.standard_error
    for estimate in found.with_truth(air()).parameters:
        assert abs(estimate.pull) < 4, estimate


def test_bands_and_shading_are_kept(found, tmp_path):
    found.save(tmp_path / "fit.npz")
    back = fitting.FitResult.load(tmp_path / "fit.npz")
    assert back.nuisances == found.nuisances
    ours, theirs = found.observations[0], back.observations[0]
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(one, other)
    assert list(theirs.bands.names) == ["red", "green", "blue"]
    for name in (
        "vignetting",
        "tone",
        "chroma",
        "heading_error",
        "vignetting_error",
        "tone_error",
        "chroma_error",
        "white",
    ):
        assert getattr(theirs, name) == getattr(ours, name)
    # They still go together: what was loaded can be fitted again.
    gather([theirs], NODES)
    stack([theirs], NODES)


# The forms ----------------------------------------------------------------------------------------------------------


def test_columns_are_what_they_say():
    """Zero in the middle and 1 in the corners, the logarithm of the pixel, the saturation of its colour."""
    pixels = np.full((15, 21, 3), 0.5)
    pixels[2, 3] = [0.2, 0.4, 0.8]
    camera = Pinhole(15, 21, fov_y=1.0, pitch=0.9)
    image = picture(pixels, noise=1e-6, camera=camera, saturation=1.0, **SHADED)
    column = {
        name: shading(image, *name) for name in (("vignetting", "2"), ("vignetting", "4"), ("chroma", "saturation"))
    }
    square, fourth, chroma = column.values()
    assert square[7, 10] == pytest.approx(0)
    # From the centre of a corner's pixel to the corner itself is half a pixel.
    assert square[0, 0] == pytest.approx((14**2 + 20**2) / (15**2 + 21**2))
    np.testing.assert_allclose(fourth, square**2, rtol=1e-6)
    # A grey pixel has no colour to make purer; of the others the luminance is that of sRGB.
    np.testing.assert_allclose(chroma[5], 0, atol=1e-5)
    grey = color.LUMINANCE @ [0.2, 0.4, 0.8]
    np.testing.assert_allclose(chroma[2, 3], 1 - grey / np.array([0.2, 0.4, 0.8]), atol=1e-5)
    u = np.log([0.2, 0.4, 0.8])
    tones = [shading(image, "tone", n)[2, 3] for n in "123"]
    np.testing.assert_allclose(tones, [u, u**2 / 3, [0.4, 0.8, 1.6]], atol=1e-5)
    assert not np.any(shading(dataclasses.replace(image, tone="fixed"), "tone", "1"))


def test_a_tone_of_the_first_kind_is_another_gamma(x64):
    """Light times (p/w)^t is a power of the light: what a coefficient t makes of it is an exponent of 1/(1 - t)."""
    pixels, white, t = light(), 0.5, 0.2
    np.testing.assert_allclose(
        made(pixels, white, [0, 0, t, 0, 0, 0]), white * (pixels / white) ** (1 / (1 - t)), rtol=1e-12
    )
    image = picture(pixels, noise=1e-9, saturation=white, tone="free")
    ours = problem([dataclasses.replace(image, image=(white * (pixels / white) ** 1.25))], toy_sky.truth(), ["mie_g"])
    factor = unstack(image, np.asarray(ours.batch.modulation(jnp.array([[t, 0.0, 0.0]])))[0])
    np.testing.assert_allclose(light() * factor, white * (pixels / white) ** 1.25, rtol=1e-6)


# Names and choices --------------------------------------------------------------------------------------------------


def test_groups_share():
    images = [picture(light(), name=name) for name in "abc"]
    choices = {
        "vignetting": ("lens", "lens", "fixed"),
        "tone": ("fixed", "free", "fixed"),
        "chroma": ("x", "fixed", "x"),
    }
    images = [
        dataclasses.replace(image, **{kind: groups[number] for kind, groups in choices.items()})
        for number, image in enumerate(images)
    ]
    labels, nuisances = gather(images, NM)
    assert labels == [
        *(("vignetting_lens_2", ""), ("vignetting_lens_4", ""), ("chroma_x_saturation", "")),
        *(("tone_b_1", ""), ("tone_b_2", ""), ("tone_b_3", "")),
    ]
    assert nuisances.moving == (6, 7, 8, 9, 10, 11)
    assert nuisances.offset_index.tolist() == [[0, 1, -1, -1, -1, 2], [0, 1, 3, 4, 5, -1], [-1, -1, -1, -1, -1, 2]]
    # A coordinate of 1 is what is known beforehand, and reported as it is.
    np.testing.assert_allclose(nuisances.values(jnp.ones(6)), [0.5, 0.5, 0.2, 0.15, 0.15, 0.15])
    batch = stack(images, NM)
    moved = nuisances.moved(jnp.ones(6))
    modulation = np.asarray(batch.modulation(moved))
    rho = images[0].radius[..., None]
    lens = np.exp(0.5 * (rho**2 + rho**4))
    third, colour = unstack(images[2], modulation[2]), np.exp(0.2 * shading(images[0], "chroma", "saturation"))
    np.testing.assert_allclose(third, np.exp(0.2 * shading(images[2], "chroma", "saturation")), rtol=1e-5)
    np.testing.assert_allclose(unstack(images[0], modulation[0]), lens * colour, rtol=1e-5)


def test_a_compass_has_an_error_of_its_own():
    image = picture(light(), pose="free", pose_error=2 * DEG, heading_error=15 * DEG)
    labels, nuisances = gather([image], NM)
    assert [label.name for label in labels] == [f"pose_photo_{axis}_deg" for axis in ("east", "north", "up")]
    np.testing.assert_allclose(nuisances.unit, np.array([2, 2, 15]) * DEG, rtol=1e-6)
    np.testing.assert_allclose(nuisances.values(jnp.ones(3)), [2, 2, 15], rtol=1e-6)
    known = {name: error for name, _, error, _, _ in assumed([image])}
    assert known == {"pose_deg": pytest.approx(2), "pose_up_deg": pytest.approx(15)}
    # Without one it is as well known as the rest.
    assert [name for name, *_ in assumed([dataclasses.replace(image, heading_error=None)])] == ["pose_deg"]
    other = dataclasses.replace(image, name="other", pose="rig", heading_error=0.1)
    with pytest.raises(FitError, match=r"^other: heading_error: got 0.1, another image of 'rig' has another$"):
        gather([dataclasses.replace(image, pose="rig"), other], NM)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vignetting": ""}, "photo: vignetting: got '', expected"),
        ({"tone_error": 0.0}, "photo: tone_error: got 0.0, expected more than 0 and at most 1$"),
        ({"chroma_error": math.nan}, "photo: chroma_error: got nan, expected more than 0 and at most 1$"),
        ({"heading_error": 2.0}, "photo: heading_error: got 2.0, expected more than 0 and at most 1 rad"),
        (
            {"bands": MIXING._replace(names=("red", "green"))},
            r"photo: bands: 2 of them \(red, green\), but the image has 3 channels",
        ),
    ],
)
def test_refuses(options, message):
    with pytest.raises(FitError, match=f"^{message}"):
        picture(light(), **options)


# Channels that are bands --------------------------------------------------------------------------------------------


def test_bands_as_narrow_as_the_wavelengths_are_the_wavelengths():
    """A spectrometer at the nodes under the sun's own spectrum, with bands and a sun of 1: to least squares it is the same.

    The triangular factor holds everything that a fit knows of the images.
    """
    sun_there = (1.4, 1.7, 1.9, 1.8)
    pixels = light("wavelengths", sun_there)
    narrow = bands.narrow(np.array(NODES), np.array(sun_there), nodes=NODES)
    run, factors = eqx.filter_jit(linearise, compiler_options=COMPILE_FAST), []
    for seen_by, irradiance in ((None, sun_there), (narrow, (1.0,) * 4)):
        start = toy_sky.change(air(irradiance), **INIT)
        ours = problem([picture(pixels, bands=seen_by)], start, ["mie_scattering", "mie_g", "ozone_absorption"])
        factors.append(reduce_images(ours.start, run(ours.start, jnp.zeros(0), ours), ours))
    plain, seen = (factor.T @ factor for factor in factors)
    scale = np.sqrt(np.diag(plain))
    np.testing.assert_allclose(seen / np.outer(scale, scale), plain / np.outer(scale, scale), atol=2e-5)


def test_channels_are_called_by_their_bands():
    """In the names of exposures and pedestals; the white balance is relative to the middle one by wavelength."""
    pixels = light("mixing")
    options = {"bands": MIXING, "white_balance": "free", "pedestal": "free-per-channel"}
    labels, nuisances = gather([picture(pixels, **options)], NODES)
    assert [label.name for label in labels] == [
        *("white_balance_photo_red", "white_balance_photo_blue"),
        *(f"pedestal_photo_{name}" for name in ("red", "green", "blue")),
    ]
    assert nuisances.factor(jnp.ones(5)).ravel().tolist() == [pytest.approx(math.e), 1, pytest.approx(math.e)]


def test_images_that_do_not_go_together_are_refused():
    pixels = light("mixing")
    photo = picture(pixels, bands=MIXING)
    grey = bands.Bands(("grey",), np.array([550.0]), np.full((1, 4), 0.25), NODES)
    cases = [
        ([photo, picture(light("wavelengths"), name="spectral")], NODES, "spectral: bands: expected all images to have them"),
        ([picture(pixels), picture(pixels, name="b", bands=MIXING)], NM, "b: bands: expected all images to have them"),
        ([photo], (680.0, 600.0, 520.0, 450.0), "photo: bands: they are of 680, 600, 520, 440 nm, the atmosphere has 680"),
        ([photo], NM, "photo: bands: they are of 680, 600, 520, 440 nm, the atmosphere has 680, 550, 440 nm"),
        (
            [photo, picture(pixels[..., :1], bands=grey, name="grey")],
            NODES,
            "grey: the image has 1 channels, photo 3",
        ),
    ]  # fmt: skip
    for images, nodes, message in cases:
        with pytest.raises(FitError) as caught:
            stack(images, nodes)
        assert str(caught.value).startswith(message)
        assert "\n" not in str(caught.value)
