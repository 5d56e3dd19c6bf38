"""Anderson's mixing: on a linear map it finds the fixed point, and never runs away."""

import numpy as np
import pytest

from fitting.mixing import DEPTH, LONGEST, mixed


def linear_map(size):
    """y → A y + b with eigenvalues from -0.9 to 0.9, A skewed a little, and where it stays."""
    random = np.random.default_rng(size)
    basis = np.eye(size) + 0.3 * random.standard_normal((size, size)) / np.sqrt(size)
    matrix = basis @ np.diag(np.linspace(0.9, -0.9, size)) @ np.linalg.inv(basis)
    offset = random.standard_normal(size)
    return (lambda y: matrix @ y + offset), np.linalg.solve(np.eye(size) - matrix, offset)


def iterate(function, start, metric, count):
    places, images = [start], [function(start)]
    for _ in range(count - 1):
        places.append(mixed(places, images, metric))
        images.append(function(places[-1]))
    return mixed(places, images, metric)


@pytest.mark.parametrize("size", range(1, DEPTH + 1))
def test_a_linear_map_is_solved_in_one_more_step_than_it_has_dimensions(size):
    """In as many dimensions as differences are kept; after each plain step there is 0.9 of the way left."""
    function, fixed = linear_map(size)
    start = fixed + np.ones(size)
    there = iterate(function, start, np.eye(size), size + 1)
    assert np.linalg.norm(there - fixed) < 1e-9


def test_it_is_as_good_in_any_units():
    """With the metric changed along with the units, the same places are visited."""
    function, fixed = linear_map(5)
    units = np.array([1.0, 1e3, 1e-4, 7.0, 1e-2])
    start = fixed + np.ones(5)
    plain = iterate(function, start, np.eye(5), 3)
    other = iterate(lambda y: units * function(y / units), units * start, np.diag(1 / units), 3)
    np.testing.assert_allclose(other / units - fixed, plain - fixed, rtol=1e-6)


def test_in_more_dimensions_it_is_faster_than_the_plain_iteration():
    function, fixed = linear_map(12)
    start = fixed + np.ones(12)
    plain = start
    for _ in range(20):
        plain = function(plain)
    there = iterate(function, start, np.eye(12), 20)
    assert np.linalg.norm(there - fixed) < 0.1 * np.linalg.norm(plain - fixed)


def test_one_iteration_alone_is_the_plain_step():
    place, image = np.array([1.0, 2.0]), np.array([0.5, 3.0])
    np.testing.assert_array_equal(mixed([place], [image], np.eye(2)), image)


def test_a_place_that_stays_is_where_it_stays():
    """No move, nothing to add; neither do two equal places divide by zero."""
    place = np.array([1.0, 2.0])
    np.testing.assert_array_equal(mixed([place, place], [place, place], np.eye(2)), place)


def test_what_is_added_is_limited():
    """A map that hardly contracts leads far off: as far as ten of its moves, in the direction that it leads to."""
    function = lambda y: 0.999 * y
    places = [np.array([1000.0, 0.0]), np.array([999.0, 0.0])]
    images = [function(place) for place in places]
    # In the units of the metric a move is half as long.
    there = mixed(places, images, 0.5 * np.eye(2))
    moved = np.linalg.norm(images[-1] - places[-1])
    np.testing.assert_allclose(there - images[-1], [-LONGEST * moved, 0], rtol=1e-6)


def test_only_the_last_places_count():
    """Whatever came before the last four."""
    function, fixed = linear_map(3)
    places = [fixed + np.random.default_rng(n).standard_normal(3) for n in range(4)]
    images = [function(place) for place in places]
    wild = [np.full(3, 1e6)] * 3
    np.testing.assert_array_equal(
        mixed(wild + places, wild + images, np.eye(3)), mixed(places, images, np.eye(3))
    )  # fmt: skip
