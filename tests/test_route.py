"""The shortest route, against all orders."""

import itertools

import numpy as np
import pytest

from bavs_jax.selection.route import (
    held_karp,
    improve,
    nearest_neighbour,
    route_length,
    shortest_route,
)


def brute_force(start, places):
    orders = itertools.permutations(range(len(places)))
    return min(route_length(start, places, list(order)) for order in orders)


def distances(start, places):
    points = np.concatenate([start[None], places])
    return np.linalg.norm(points[:, None] - points, axis=-1)


@pytest.mark.parametrize("num", [1, 2, 3, 5, 7])
def test_up_to_twelve_places_are_exact(num):
    rng = np.random.default_rng(num)
    for _ in range(5):
        start, places = rng.normal(size=3), rng.normal(size=(num, 3))
        order = shortest_route(start, places)
        assert sorted(order) == list(range(num))
        np.testing.assert_allclose(route_length(start, places, order), brute_force(start, places))


def test_beyond_twelve_places_a_line_is_walked_from_end_to_end():
    along = np.random.default_rng(0).permutation(20).astype(float)
    places = along[:, None] * np.array([1.0, 2.0, -1.0])
    order = shortest_route(np.zeros(3), places)
    np.testing.assert_array_equal(along[order], np.arange(20))


def test_local_search_beats_its_start_and_is_near_the_best():
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(12):
        start, places = rng.normal(size=3), rng.normal(size=(9, 3))
        cost = distances(start, places)
        best = route_length(start, places, held_karp(cost))
        first = route_length(start, places, nearest_neighbour(cost))
        order = improve(cost, nearest_neighbour(cost))
        assert sorted(order) == list(range(9))
        got = route_length(start, places, order)
        assert best - 1e-9 <= got <= first + 1e-9
        ratios.append(got / best)
    # 2-opt and or-opt end within some 5 % of the optimum on average (Johnson and McGeoch 1997).
    assert np.mean(ratios) < 1.05


def test_no_reversal_shortens_the_long_route():
    rng = np.random.default_rng(4)
    start, places = rng.normal(size=3), rng.normal(size=(15, 3))
    order = shortest_route(start, places)
    length = route_length(start, places, order)
    for i, j in itertools.combinations(range(15), 2):
        turned = np.concatenate([order[:i], order[i : j + 1][::-1], order[j + 1 :]])
        assert route_length(start, places, turned) >= length - 1e-9


def test_empty_and_equal_places():
    assert shortest_route(np.zeros(3), np.zeros((0, 3))).shape == (0,)
    assert sorted(shortest_route(np.zeros(3), np.ones((14, 3)))) == list(range(14))
