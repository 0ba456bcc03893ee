"""Directional information against its float64 oracle, at its limits, and its memory."""

import numpy as np
import pytest

from bavs_jax.fields.contraction import scene_positions, unit_coordinates
from bavs_jax.fields.deformation import DeformationGrid, grid_coordinates, vertex_positions
from bavs_jax.selection import directional
from bavs_jax.selection.directional import (
    DirectionalInformation,
    Look,
    add_look,
    directional_gains,
    make_precision_fn,
    same_side,
)
from bavs_jax.selection.information import MIN_ROWS, sparse_curvature
from tests import oracles_information as oracles

NUM, NUM_VERTICES, PRIOR = 6, 12, 0.05


def toy(seed):
    """Vertices [12, 3], curvatures [6, 12, 3] of views that see some of them, places [6, 3]."""
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1.0, 1.0, (NUM_VERTICES, 3)).astype(np.float32)
    sees = rng.uniform(size=(NUM, NUM_VERTICES, 1)) < 0.6
    h = (rng.exponential(size=(NUM, NUM_VERTICES, 3)) * sees).astype(np.float32)
    places = 4.0 * rng.normal(size=(NUM, 3)).astype(np.float32)
    return vertices, h, places


def information_of(vertices, h, places, *, num_looks=2, sharpness=8.0, **options):
    looks = [Look(*sparse_curvature(a), place) for a, place in zip(h, places)]

    def look_fn(indices):
        for index in indices:
            yield looks[index]

    fn = make_precision_fn(look_fn, vertices, prior=PRIOR, sharpness=sharpness, **options)
    return DirectionalInformation(tuple(looks[:num_looks]), look_fn, fn)


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 8.0])
def test_gains_equal_the_oracle_along_a_batch(sharpness):
    for seed in range(3):
        vertices, h, places = toy(seed)
        information = information_of(vertices, h, places, sharpness=sharpness)
        taken = [0, 1]
        for pick in (4, 3, 4):
            expected = [
                oracles.directional_gain(
                    PRIOR,
                    vertices,
                    [(h[s], places[s]) for s in taken],
                    (h[c], places[c]),
                    sharpness,
                )
                for c in range(NUM)
            ]
            np.testing.assert_allclose(
                directional_gains(information, range(NUM)), expected, rtol=1e-4
            )
            information = add_look(information, pick)
            taken.append(pick)


def test_the_oracle_by_hand():
    # One vertex; looks at a right angle and from the same side: cos 0 and 1.
    vertices, h = np.zeros((1, 3)), np.array([[[2.0, 0.0, 0.0]]])
    looks = [(h[0], [1.0, 0.0, 0.0]), (h[0], [0.0, 5.0, 0.0])]
    gain = oracles.directional_gain(1.0, vertices, looks, (h[0], [0.0, 1.0, 0.0]), 2.0)
    np.testing.assert_allclose(gain, np.log(1.0 + 2.0 / (1.0 + 2.0 + 0.25 * 2.0)))


def test_without_sharpness_it_is_the_plain_posterior():
    vertices, h, places = toy(3)
    gains = directional_gains(information_of(vertices, h, places, sharpness=0.0), range(NUM))
    precision = PRIOR + h[:2].sum(0)
    expected = [oracles.log_det_of_set(precision, h, [c]) for c in range(NUM)]
    np.testing.assert_allclose(gains, expected, rtol=1e-4)


def test_the_same_look_from_elsewhere_tells_more():
    vertices, h, _ = toy(4)
    h = np.repeat(h[:1], NUM, axis=0)
    angles = np.radians([0.0, 0.0, 5.0, 30.0, 90.0, 180.0])
    places = 50.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(NUM)], -1)
    gains = directional_gains(information_of(vertices, h, places, num_looks=1), range(NUM))
    assert (np.diff(gains[1:]) > 0).all()
    # From the opposite side it is as if nothing had been looked at.
    fresh = oracles.log_det_of_set(np.full((NUM_VERTICES, 3), PRIOR), h, [0])
    np.testing.assert_allclose(gains[-1], fresh, rtol=1e-3)


def test_gains_fall_as_looks_are_added_and_a_view_of_nothing_gains_0():
    vertices, h, places = toy(5)
    h[5] = 0.0
    information = information_of(vertices, h, places)
    before = directional_gains(information, range(NUM))
    after = directional_gains(add_look(information, 3), range(NUM))
    assert (after <= before).all() and after[3] < before[3]
    assert before[5] == after[5] == 0.0


@pytest.mark.parametrize("max_bytes", [0, 2**14 + 2**13, 2**20])
def test_memory_changes_nothing_and_looks_may_be_taken_back(max_bytes):
    vertices, h, places = toy(6)
    start = information_of(vertices, h, places, max_bytes=max_bytes)
    fresh = information_of(vertices, h, places, max_bytes=0)
    other = add_look(add_look(start, 5), 2)
    for information in (start, add_look(start, 4), other, start):
        np.testing.assert_array_equal(
            directional_gains(information, [3, 1, 4]),
            directional_gains(fresh._replace(looks=information.looks), [3, 1, 4]),
        )


@pytest.mark.parametrize("kept, max_bytes", [(0, 0), (1, 12 * MIN_ROWS), (3, 2**20)])
def test_memory_is_bounded_and_spares_looks(kept, max_bytes, monkeypatch):
    """Two looks are added to each of three candidates, but to those that are remembered once."""
    added = []

    def add(precision, *args):
        added.append(precision.nbytes)
        return add_look_once(precision, *args)

    add_look_once = directional._add_look
    monkeypatch.setattr(directional, "_add_look", add)
    information = information_of(*toy(6), max_bytes=max_bytes)
    directional_gains(information, [3, 1, 4])
    assert len(added) == 6 and kept == min(max_bytes // added[0], 3)
    directional_gains(information, [3, 1, 4])
    assert len(added) == 6 + 2 * (3 - kept)


def test_same_side_at_its_limits():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    camera = np.array([0.0, 0.0, 1.0], np.float32)  # stands on the second point
    np.testing.assert_allclose(same_side(points, camera, camera), [1.0, 0.5**8.0])
    np.testing.assert_allclose(same_side(points, camera, -camera), [0.0, 0.5**8.0])
    np.testing.assert_array_equal(same_side(points, camera, -camera, sharpness=0.0), 1.0)


@pytest.mark.parametrize("contracted", [False, True])
def test_vertices_are_where_the_grid_reads_them(contracted):
    box = np.array([[-1.0, 0.0, 2.0], [1.0, 4.0, 3.0]], np.float32)
    grid = DeformationGrid(box, 3, contracted=contracted)
    positions = vertex_positions(grid)
    assert np.isfinite(positions).all() and positions.shape == (9**3, 3)
    wanted = np.indices((9, 9, 9)).reshape(3, -1).T
    np.testing.assert_allclose(grid_coordinates(grid, positions), wanted, atol=2e-3)
    unit = np.random.default_rng(0).uniform(0.02, 0.98, (50, 3))
    again = unit_coordinates(
        box, scene_positions(box, unit, contracted=contracted), contracted=contracted
    )
    np.testing.assert_allclose(again, unit, atol=1e-5)
