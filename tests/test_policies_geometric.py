"""Policies that look at camera positions alone: uniform, and farthest on the great circle."""

import jax
import numpy as np
import pytest

from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.distances import uniform_ranks
from bavs_jax.selection.policies import POLICIES
from bavs_jax.selection.policies.distance import great_circle
from tests import oracles_selection as oracles

KEY = jax.random.key(0)
NUM = 24
ranks_fn = jax.jit(uniform_ranks)


def pool(seed):
    """Positions [24, 3] and shuffled view ids of a pool."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(NUM, 3)).astype(np.float32), rng.permutation(100)[:NUM]


def context(positions, view_ids, is_training):
    return make_context(
        positions,
        training_positions=positions,
        is_training_view=is_training,
        centre=np.zeros(3),
        view_ids=view_ids,
        mask=~is_training,
    )


# --- uniform ---------------------------------------------------------------------------------


def test_uniform_ranks_against_the_slow_reference():
    for seed in range(5):
        positions, view_ids = pool(seed)
        mean = positions.astype(np.float64).mean(axis=0)
        first = min(range(NUM), key=lambda i: oracles.distance(positions[i], mean))
        order = oracles.farthest_order(
            positions,
            [positions[first]],
            np.arange(NUM) != first,
            NUM,
            view_ids=view_ids,
        )
        ranks = np.asarray(ranks_fn(positions, view_ids))
        np.testing.assert_array_equal(np.argsort(ranks), [first, *order])


def test_uniform_is_fixed_in_advance():
    """Whatever is trained on, and in whatever batches: the next free views of one order."""
    positions, view_ids = pool(0)
    order = np.argsort(np.asarray(ranks_fn(positions, view_ids)))
    for seed in range(4):
        is_training = np.zeros(NUM, bool)
        is_training[np.random.default_rng(seed).permutation(NUM)[:4]] = True
        expected = [i for i in order if not is_training[i]]
        picked = []
        for _ in range(4):
            selected, _ = acquire(
                POLICIES["uniform"], KEY, context(positions, view_ids, is_training), 4
            )
            picked += selected.tolist()
            is_training[selected] = True
        assert picked == expected[:16]


def test_uniform_leaves_out_views_that_are_no_candidates():
    """Views that are only tested on lie in the table of training positions, but take no place."""
    positions, view_ids = pool(1)
    ctx = context(positions, view_ids, np.arange(NUM) < 4)
    more = ctx.replace(
        training_positions=np.concatenate([positions, 3.0 + positions]),
        is_training_view=np.arange(2 * NUM) < 4,
    )
    first, _ = acquire(POLICIES["uniform"], KEY, ctx, 6)
    second, _ = acquire(POLICIES["uniform"], KEY, more, 6)
    np.testing.assert_array_equal(first, second)


def test_uniform_on_a_line_halves_the_gaps():
    positions = np.linspace(0.0, 8.0, 9)[:, None] * np.array([1.0, 0.0, 0.0], np.float32)
    ranks = np.asarray(ranks_fn(positions, np.arange(9)))
    # The middle, both ends, the quarters, then what lies between; smaller ids first.
    np.testing.assert_array_equal(np.argsort(ranks), [4, 0, 8, 2, 6, 1, 3, 5, 7])


def test_uniform_with_a_single_camera():
    np.testing.assert_array_equal(ranks_fn(np.ones((1, 3), np.float32), np.array([7])), [0])


# --- farthest on the great circle ------------------------------------------------------------


def test_great_circle_closed_forms():
    centre = np.array([1.0, 2.0, 3.0], np.float32)
    a = centre + np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]], np.float32)
    b = centre + np.array(
        [[5.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.1, 0.0, 0.0], [3.0, 3.0, 0.0]], np.float32
    )
    angles = great_circle(a, b, centre)
    # Float32 of a subtracted centre; the camera at the centre is at the angle 0 from all.
    np.testing.assert_allclose(angles[0], [0.0, np.pi / 2, np.pi, np.pi / 4], atol=1e-6)
    np.testing.assert_array_equal(angles[1], 0.0)


@pytest.mark.parametrize("angle", [1e-4, np.pi - 1e-3])
def test_great_circle_is_exact_for_near_and_opposite_views(angle):
    a = np.array([[1.0, 0.0, 0.0]], np.float32)
    b = np.array([[np.cos(angle), np.sin(angle), 0.0]], np.float32)
    # An arccos in float32 would be wrong by 3e-4 rad here.
    np.testing.assert_allclose(great_circle(a, b, np.zeros(3)), [[angle]], atol=3e-7)


def test_farthest_arc_is_farthest_of_the_directions():
    for seed in range(5):
        positions, view_ids = pool(seed)
        directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
        is_training = np.arange(NUM) < 4
        by_arc, info = acquire(
            POLICIES["farthest_arc"], KEY, context(positions, view_ids, is_training), 6
        )
        # Chords grow with angles, so both orders agree on the unit sphere.
        by_chord, _ = acquire(
            POLICIES["farthest"], KEY, context(directions, view_ids, is_training), 6
        )
        np.testing.assert_array_equal(by_arc, by_chord)
        assert np.nanmax(info.scores) <= np.pi
