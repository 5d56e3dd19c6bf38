"""The Monte Carlo against an independent Monte Carlo, and against what must be exact."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from diffatmo.models.pathtrace import PathTrace


def directions(zenith_deg, azimuth_deg):
    z, a = np.radians(zenith_deg), np.radians(azimuth_deg)
    return jnp.asarray(np.stack([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)], -1), jnp.result_type(float))


def estimate(atmosphere, view, sun, seed=0, samples=8192):
    sky = PathTrace(samples=samples, seed=seed).sky(atmosphere)
    mean, error, _ = sky.radiance_with_error(altitude=jnp.asarray(0.5), view=view, sun=sun)
    return np.asarray(mean), np.asarray(error)


@pytest.mark.slow
@pytest.mark.parametrize("sun_zenith_deg", [60, 92])
def test_scene_s1_within_the_standard_errors(shared, s1, sun_zenith_deg):
    """χ² over all 75 entries with the errors of both. The three channels of a direction share paths: about 25 independent
    numbers, whose χ²/n lies within 0.4 and 1.8 (99 %).
    """
    truth = np.load(shared / "reference" / f"montecarlo_s1_sza{sun_zenith_deg}.npz")
    view = directions(truth["view_zenith_deg"], truth["view_azimuth_deg"])
    mean, error = estimate(s1, view, directions(sun_zenith_deg, 0.0), samples=32768)
    z = (mean - truth["radiance"]) / np.hypot(error, truth["stderr"])
    print(
        f"sun {sun_zenith_deg}: chi2/n {np.mean(z**2):.2f}, mean z {z.mean():+.2f}, error {np.mean(error / mean):.2e}"
    )
    assert 0.4 < np.mean(z**2) < 1.8
    # The errors are themselves estimates from 32 replicates, so single entries stray further than a normal deviate would.
    assert np.mean(np.abs(z) > 3) < 0.05


def test_paths_are_rounded_up_to_replicates_times_a_power_of_two():
    assert [PathTrace(samples=n).paths for n in (1, 32, 33, 64, 65, 4096)] == [32, 32, 64, 64, 128, 4096]


def test_same_seed_same_answer_other_seed_other_sample(s1):
    view, sun = directions([0.0, 60.0], [0.0, 30.0]), directions(40.0, 0.0)
    a, error = estimate(s1, view, sun, seed=1, samples=1024)
    b, _ = estimate(s1, view, sun, seed=1, samples=1024)
    c, _ = estimate(s1, view, sun, seed=2, samples=1024)
    np.testing.assert_array_equal(a, b)
    assert np.all(a != c)
    assert np.all(np.abs(a - c) < 6 * np.hypot(error, error))


def test_another_asymmetry_is_another_sky(s1):
    """g from 0.8 to 0.7 moves the aureole by many standard errors: the test above can fail."""
    # By the program of the test above, for as many directions and paths.
    view, sun = directions([40.0, 60.0], [0.0, 30.0]), directions(50.0, 0.0)
    a, error = estimate(s1, view, sun, samples=1024)
    b, _ = estimate(eqx.tree_at(lambda x: x.mie_g, s1, jnp.float32(0.7)), view, sun, samples=1024)
    assert np.abs(a - b)[0, 0] > 20 * error[0, 0]
