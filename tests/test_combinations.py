"""What is known together though not alone."""

import numpy as np
import pytest
import toy_sky

from fitting.combinations import combinations
from fitting.findings import Estimate


def estimates(values, errors, fields=("a", "b", "c")):
    return [
        Estimate(f"{field}_x", field, None, "", value, error, None)
        for field, value, error in zip(fields, values, errors, strict=False)
    ]


def spread(product, ratio):
    """Relative covariance of a and b of which a b is known to ``product`` and a / b to ``ratio``."""
    turn = np.array([[1, 1], [1, -1]])
    return np.linalg.inv(turn) @ np.diag([product**2, ratio**2]) @ np.linalg.inv(turn).T


def test_a_product_known_to_half_a_percent():
    relative = spread(0.006, 0.22)
    values = np.array([2.0, 8.0])
    given = estimates(values, np.sqrt(np.diag(relative)) * values)
    (found,) = combinations(relative * np.outer(values, values), given)
    assert {found.first, found.second} == {"a_x", "b_x"}
    assert found.power == 1
    assert found.error == pytest.approx(0.006, rel=1e-6)
    assert found.text == "a_x × b_x to 0.6 % (alone to 11 % and 11 %)"


def test_a_ratio_has_a_negative_power():
    relative = spread(0.2, 0.004)
    (found,) = combinations(relative, estimates([1.0, 1.0], np.sqrt(np.diag(relative))))
    assert found.power == -1
    assert found.error == pytest.approx(0.004, rel=1e-6)


def test_other_powers_are_found():
    """a b^½ known to 0.3 %: the power belongs to the number that is known less well."""
    turn = np.array([[1, 0.5], [0, 1]])
    relative = np.linalg.inv(turn) @ np.diag([0.003**2, 0.3**2]) @ np.linalg.inv(turn).T
    (found,) = combinations(relative, estimates([1.0, 1.0], np.sqrt(np.diag(relative))))
    assert (found.first, found.second, found.power) == ("a_x", "b_x", 0.5)
    swapped = relative[::-1, ::-1]
    (found,) = combinations(swapped, estimates([1.0, 1.0], np.sqrt(np.diag(swapped))))
    assert (found.first, found.second, found.power) == ("b_x", "a_x", 0.5)


def test_what_is_known_alone_or_not_at_all_is_not_worth_a_word():
    assert not combinations(np.eye(2) * 0.1, estimates([1.0, 1.0], [0.3, 0.3]))
    sharp = spread(1e-5, 1e-3)
    assert not combinations(sharp, estimates([1.0, 1.0], np.sqrt(np.diag(sharp))))
    unknown = np.full((2, 2), np.nan)
    assert not combinations(unknown, estimates([1.0, 1.0], [None, None]))


def test_a_fit_says_that_optical_depths_are_what_it_knows():
    """One image: coefficient and scale height apart are loose, their product is not."""
    import fitting

    free = ["rayleigh_scattering", "rayleigh_scale_height", "mie_scattering"]
    images = toy_sky.observations(noise=0.1, zeniths=(30.0,))
    found = fitting.fit(images, init=toy_sky.truth(), free=free, model=toy_sky.Toy())
    told = combinations(found.covariance, found.estimates)
    assert any({"rayleigh_scale_height", "rayleigh_scattering_440"} == {c.first, c.second} for c in told)


def test_numbers_that_are_one_are_told_once():
    """A tie makes two wavelengths of a field one number: the first stands for both."""
    relative = spread(0.006, 0.22)[np.ix_([0, 0, 1], [0, 0, 1])]
    given = [
        Estimate(name, field, None, "", 1.0, error, None)
        for name, field, error in zip(("a_680", "a_550", "b"), ("a", "a", "b"), np.sqrt(np.diag(relative)), strict=True)
    ]
    (found,) = combinations(relative, given)
    assert {found.first, found.second} == {"a_680", "b"}
