"""Whole pictures: the path tracer and the default model, which share next to no code, within the standard errors.

Every pixel is a z-test; together they are judged by the mean of z, by its scatter, and by the largest, corrected for how many
were looked at (Subr & Arvo 2007; the image tests of Mitsuba). A standard error from R replicates makes z a Student deviate
of R - 1 degrees of freedom, whose moments are the yardstick. What ``moments`` itself is off by, relative to the light, widens
each of the three.
"""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import diffatmo
from diffatmo import render, sun
from diffatmo.cli.main import main
from diffatmo.models import Moments, PathTrace

ALTITUDE = jnp.asarray(0.5)
REPLICATES = 32
FREEDOM = REPLICATES - 1
LEAST = 1e-3
"""Probability below which chance is no excuse, for each of the three figures of a picture."""

CAMERA = diffatmo.Equirectangular(12, 24)
"""288 pixels, half of them below the horizon; none on it."""

CASES = [  # aerosol × S1's, sun zenith in degrees, RMS relative error of the default model there
    (1, 60, 1e-3),
    (1, 92, 2e-3),
    (5, 60, 1e-3),
    (5, 85, 2e-3),
]


def haze(atmosphere, factor, g=0.8):
    return eqx.tree_at(
        lambda a: (a.mie_scattering, a.mie_absorption, a.mie_g), atmosphere,
        (factor * atmosphere.mie_scattering, factor * atmosphere.mie_absorption, jnp.asarray(g)),
    )  # fmt: skip


def towards(zenith_deg):
    return sun.direction(zenith=jnp.radians(zenith_deg), azimuth=jnp.pi)


@partial(jax.jit, compiler_options=diffatmo.compiler_options())
def expected(atmosphere, at):
    return Moments().sky(atmosphere).view(altitude=ALTITUDE, sun=at).radiance(view=CAMERA.directions()).radiance


@pytest.fixture(scope="module")
def traced():
    """Pictures of the path tracer by name, each traced once."""
    done = {}

    def picture(name, atmosphere, at):
        if name not in done:
            sky = PathTrace(samples=2048, replicates=REPLICATES, seed=1).sky(atmosphere)
            view = CAMERA.directions()
            done[name] = jax.device_get(sky.radiance_with_error(altitude=ALTITUDE, view=view, sun=at))
        return done[name]

    return picture


class Verdict(NamedTuple):
    """The three figures of a picture, and how large each may be."""

    mean: float
    mean_limit: float
    scatter: float
    scatter_limits: tuple[float, float]
    largest: float
    """|z|, less what the model may be off by."""
    largest_limit: float

    @property
    def agrees(self):
        low, high = self.scatter_limits
        return abs(self.mean) < self.mean_limit and low < self.scatter < high and self.largest < self.largest_limit


def judge(estimate, radiance, model_error):
    """``model_error`` is the RMS relative error of ``radiance``, which is smooth over the sky: it may all be one way, and in
    one pixel three times as large. The channels of a pixel share their paths, so that only pixels count as independent.
    """
    z = (estimate.radiance - radiance) / estimate.stderr
    pixels = z.shape[0] * z.shape[1]
    # Moments of Student's t: E t² = ν / (ν - 2), E t⁴ = 3 ν² / ((ν - 2) (ν - 4)).
    variance = FREEDOM / (FREEDOM - 2)
    fourth = 3 * FREEDOM**2 / ((FREEDOM - 2) * (FREEDOM - 4))
    off = model_error * estimate.radiance / estimate.stderr
    chance = stats.norm.isf(LEAST / 2)
    width = chance * math.sqrt((fourth - variance**2) / pixels)
    # Šidák: the chance that not one of n exceeds the limit is 1 - LEAST.
    single = -math.expm1(math.log1p(-LEAST) / z.size)
    return Verdict(
        float(np.mean(z)),
        chance * math.sqrt(variance / pixels) + float(np.mean(off)),
        float(np.mean(z**2)),
        (variance - width, variance + width + float(np.mean(off**2))),
        float(np.max(np.abs(z) - 3 * off)),
        float(stats.t.isf(single / 2, FREEDOM)),
    )


@pytest.mark.parametrize(("factor", "zenith_deg", "model_error"), CASES)
def test_pictures_agree_within_their_standard_errors(s1, traced, factor, zenith_deg, model_error):
    atmosphere, at = haze(s1, factor), towards(zenith_deg)
    estimate = traced((factor, zenith_deg), atmosphere, at)
    verdict = judge(estimate, np.asarray(expected(atmosphere, at)), model_error)
    error = np.median(estimate.stderr / estimate.radiance)
    low, high = verdict.scatter_limits
    print(
        f"aerosol × {factor}, sun {zenith_deg}°: standard error {100 * error:.2f} %; mean z {verdict.mean:+.3f} "
        f"(within {verdict.mean_limit:.3f}), χ²/n {verdict.scatter:.3f} (from {low:.3f} to {high:.3f}), "
        f"largest |z|, less the model's share, {verdict.largest:.2f} (below {verdict.largest_limit:.2f})"
    )
    assert verdict.agrees


@pytest.mark.parametrize("g", [0.75, 0.85])
def test_another_asymmetry_does_not_pass(s1, traced, g):
    """Each of scatter and maximum sees g off by 0.05, even in S1's thin aerosol."""
    at = towards(60)
    verdict = judge(traced((1, 60), s1, at), np.asarray(expected(haze(s1, 1, g), at)), 1e-3)
    print(f"g = {g} for 0.8: mean z {verdict.mean:+.2f}, χ²/n {verdict.scatter:.1f}, largest |z| {verdict.largest:.1f}")
    assert verdict.scatter > 2 * verdict.scatter_limits[1]
    assert verdict.largest > 2 * verdict.largest_limit


def test_a_picture_comes_with_its_standard_error(s1):
    """The same picture as without; both in the exposure; light of the sun's disc, which is not sampled, adds no error."""
    shot = diffatmo.Scene(s1, CAMERA, 0.5, towards(60), 3.0)
    model = PathTrace(samples=32)
    picture, error = render.render_with_error(shot, model)
    np.testing.assert_allclose(picture, render.render(shot, model), rtol=1e-6)
    dimmer = eqx.tree_at(lambda s: s.exposure, shot, jnp.asarray(1.0))
    np.testing.assert_allclose(error, 3 * render.render_with_error(dimmer, model)[1], rtol=1e-6)
    disc, same = render.render_with_error(shot, model, sun_disc=True)
    np.testing.assert_array_equal(same, error)
    np.testing.assert_allclose(disc, render.render(shot, model, sun_disc=True), rtol=1e-6)
    assert float(disc.sum()) > 2 * float(picture.sum())


def test_the_header_of_a_picture_tells_a_fit_its_noise(tmp_path):
    """It is what another seed differs by, over √2: 1536 numbers in whose squares the noise differs by some ten."""
    found = []
    for seed in ("1", "2"):
        command = ["render", "mars", "--model", "pathtrace", "--samples", "64", "--width", "32", "--seed", seed]
        assert main([*command, "-o", str(tmp_path / f"{seed}.exr")]) == 0
        found.append(diffatmo.scene.load(tmp_path / f"{seed}.exr"))
    one, other = found
    assert (one.notes["samples"], one.notes["seed"]) == (64, 1)
    apart = 2 * (one.pixels - other.pixels) / (one.pixels + other.pixels)
    assert one.notes["noise"] == pytest.approx(np.sqrt(np.mean(apart**2) / 2), rel=0.15)
