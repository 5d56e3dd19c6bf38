"""Error bars: propagation, what is not determined, and their calibration."""

import numpy as np
import pytest
import toy_sky
from toy_sky import FREE, Toy

from fitting import FitError, fit
from fitting.findings import correlation
from fitting.uncertainty import propagate


def test_propagation_is_the_delta_method():
    random = np.random.default_rng(0)
    slope, gradient = random.standard_normal((40, 4)), random.standard_normal((2, 4))
    covariance, determined = propagate(np.linalg.qr(slope, mode="r"), gradient)
    np.testing.assert_allclose(covariance, gradient @ np.linalg.inv(slope.T @ slope) @ gradient.T, rtol=1e-10)
    assert determined.all()


def test_badly_scaled_coordinates_are_determined_all_the_same():
    random = np.random.default_rng(0)
    slope = random.standard_normal((40, 3)) * np.array([1e-6, 1.0, 1e6])
    covariance, determined = propagate(np.linalg.qr(slope, mode="r"), np.eye(3))
    assert determined.all()
    np.testing.assert_allclose(covariance @ (slope.T @ slope), np.eye(3), atol=1e-3)


def test_only_the_determined_combination_has_an_error():
    # The data know a + b and c, neither a nor b, and nothing of d.
    slope = np.array([[10.0, 10.0, 0.0, 0.0], [0.0, 0.0, 5.0, 0.0], [10.0, 10.0, 0.0, 0.0], [0.0, 0.0, 5.0, 0.0]])
    gradient = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], float)
    covariance, determined = propagate(np.linalg.qr(slope, mode="r"), gradient)
    assert determined.tolist() == [False, False, True, True, False]
    assert covariance[2, 2] == pytest.approx(1 / 200)
    assert covariance[3, 3] == pytest.approx(1 / 50)
    assert np.isnan(covariance[0]).all()
    assert np.isnan(correlation(covariance)[:, 4]).all()


def test_exposure_and_sun_cannot_be_told_apart():
    images = toy_sky.observations(exposure=("camera",) * 3)
    free = ["solar_irradiance", "mie_g"]
    found = fit(images, init=toy_sky.truth(), free=free, tie={"solar_irradiance": "start"}, model=Toy())
    assert found.converged
    assert found.undetermined == [*(f"solar_irradiance_{nm}" for nm in (680, 550, 440)), "exposure_camera"]
    assert found.estimate("mie_g").standard_error < 1e-3
    assert found.estimate("exposure_camera").standard_error is None


def test_error_bars_are_calibrated():
    runs = 16
    squares, pulls = [], []
    for seed in range(runs):
        found = fit(toy_sky.observations(seed), init=toy_sky.start(1.2, 0.75), free=FREE, model=Toy())
        found = found.with_truth(toy_sky.truth())
        assert found.converged
        error = np.array([e.value - e.truth for e in found.parameters if not e.derived])
        # The derived numbers come after all the fitted ones.
        squares.append(error @ np.linalg.solve(found.covariance[: error.size, : error.size], error))
        pulls.append([e.pull for e in found.parameters])
    # χ² with 18 degrees of freedom in each run: the mean of 16 has a standard deviation of 1.5.
    assert np.mean(squares) == pytest.approx(18, abs=6)
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4 / np.sqrt(runs))
    deviation = np.std(pulls, axis=0)
    assert np.all((deviation > 0.3) & (deviation < 1.7))


def test_understated_noise_widens_the_errors():
    honest, bold = (
        fit(toy_sky.observations(noise=0.03, **said), init=toy_sky.truth(), free=FREE, model=Toy())
        for said in ({}, {"stated": 0.01})
    )
    assert bold.reduced_chi2 == pytest.approx(9 * honest.reduced_chi2, rel=0.01)
    assert bold.error_scale == pytest.approx(3, rel=0.05)
    # The errors are what the scatter of the residuals says, whatever was stated.
    expected = honest.estimate("mie_g").standard_error / honest.error_scale * np.sqrt(honest.reduced_chi2)
    assert bold.estimate("mie_g").standard_error == pytest.approx(expected, rel=0.01)


def test_errors_of_derived_quantities():
    found = toy_sky.result()
    names = found.covariance_names
    i, j = names.index("rayleigh_scattering_550"), names.index("rayleigh_scale_height")
    beta, height = found.estimate("rayleigh_scattering_550").value, found.estimate("rayleigh_scale_height").value
    c = found.covariance
    variance = height**2 * c[i, i] + beta**2 * c[j, j] + 2 * beta * height * c[i, j]
    depth, k = found.estimate("rayleigh_optical_depth_550"), names.index("rayleigh_optical_depth_550")
    assert c[k, k] == pytest.approx(variance, rel=1e-3)
    assert c[k, j] == pytest.approx(height * c[i, j] + beta * c[j, j], rel=1e-3)
    assert depth.derived
    assert depth.value == pytest.approx(beta * height, rel=1e-6)
    assert depth.standard_error == pytest.approx(np.sqrt(variance), rel=1e-3)
    # The product is known better than its factors.
    assert depth.standard_error / depth.value < found.estimate("rayleigh_scattering_550").standard_error / beta


def test_correlation_matrix():
    matrix = toy_sky.result().correlation
    np.testing.assert_allclose(np.diag(matrix), 1, rtol=1e-9)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
    assert np.all(np.abs(matrix) < 1 + 1e-9)
    # Optical depths follow from the other numbers, so the matrix is only just not negative.
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_truth_and_pulls():
    found = toy_sky.result()
    assert found.estimate("mie_g").pull is None
    with_truth = found.with_truth(toy_sky.truth())
    g = with_truth.estimate("mie_g")
    assert g.truth == pytest.approx(0.8)
    assert g.pull == pytest.approx((g.value - 0.8) / g.standard_error, rel=1e-4)
    assert with_truth.estimate("mie_optical_depth_680").truth == pytest.approx(4.44e-3 * 1.2, rel=1e-5)
    with pytest.raises(FitError, match="truth: has wavelengths"):
        found.with_truth(toy_sky.change(toy_sky.truth(), wavelengths=[600.0, 500.0, 400.0]))
    with pytest.raises(KeyError, match="nothing"):
        found.estimate("nothing")


def test_fitted_images_and_residuals():
    found = toy_sky.result()
    for observation, fitted, residual, whitened in zip(
        found.observations, found.fitted, found.residuals, found.whitened, strict=True
    ):
        np.testing.assert_array_equal(np.isfinite(fitted).all(-1), observation.shown)
        np.testing.assert_array_equal(np.isfinite(residual).all(-1), observation.used)
        used = observation.used
        np.testing.assert_allclose(observation.image[used] / fitted[used] - 1, residual[used], atol=1e-6)
        assert np.std(whitened[used]) == pytest.approx(1, abs=0.06)


def test_images_without_a_name_are_numbered():
    images = toy_sky.observations(name="image", exposure=("fixed", "free", "fixed"))
    found = fit([*images[:2], *toy_sky.observations(name="third")[2:]], init=toy_sky.start(), free=FREE, model=Toy())
    assert [o.name for o in found.observations] == ["image_1", "image_2", "third"]
    assert [e.name for e in found.nuisances] == ["exposure_image_2"]
