"""The loop of the paper: rounds, masks, resumption inside a round, captured candidates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.candidates import (
    captured_candidates,
    dataset_candidates,
    scene_hemisphere,
    with_empty_views,
)
from bavs_jax.pixel_table import make_pixel_table
from bavs_jax.training.checkpoints import Checkpoints
from experiments.build import Problem, initial_views, load_config_scene
from experiments.runner import Run, saved_part, whole_state
from tests.toy_rounds import run_round, silent, start
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene
from tests.traces import count_traces

# What each kind of source compiles once: no shape in it changes while views grow.
FIXED_SHAPES = {
    "random": {"train", "top_k", "farthest_ranks", "nearest_distances"},
    "bavs": {"train", "count_points", "render_chunk", "pixel_rays", "max_min_filter", "top_k"},
    "d_optimal": {"train", "count_points", "top_k"},
    "oracle": {"train", "render_chunk", "pixel_rays", "top_k"},
}


@pytest.fixture(scope="module")
def all_traces():
    """Names of all that is traced in this module, as if nothing had been before."""
    jax.clear_caches()
    with count_traces() as traces:
        yield traces


@pytest.fixture(scope="module")
def problem(all_traces):
    return make_problem(toy_config())


def make_problem(config):
    return Problem(config, load_config_scene(config, cache_dir=None), track=silent)


# One policy for each kind of source; all others differ from one of these by what is rendered.
@pytest.mark.parametrize("policy", FIXED_SHAPES)
def test_rounds_add_batches_of_pool_views_and_trace_nothing_new(problem, policy, all_traces):
    state, acquisition = start(problem, policy)
    key = jax.random.key(1)
    seen = set(np.flatnonzero(state.is_training_view).tolist())
    state, choice, _ = run_round(problem, acquisition, key, state)
    assert int(state.round) == 0 and choice is None
    assert len(seen) == 2 and set(np.flatnonzero(state.is_training_view).tolist()) == seen
    for number in (1, 2, 3):
        with count_traces() as traces:
            state, _, view_ids = run_round(problem, acquisition, key, state)
        picked = set(view_ids.tolist())
        assert int(state.round) == number and len(picked) == 2
        assert not picked & seen and picked <= set(problem.scene.pool.tolist())
        seen |= picked
        assert set(np.flatnonzero(state.is_training_view).tolist()) == seen
    # `traces` is of the last round: nothing of fixed shape is traced again while views grow. Only a
    # bucket of the curvature may be filled for the first time so late, once each.
    assert FIXED_SHAPES[policy] <= set(all_traces), "the listener must see these names once"
    assert not set(traces) & FIXED_SHAPES[policy]
    assert traces.count("add_chunk") <= 3


def test_a_round_picked_up_half_way_ends_in_the_same_place(problem):
    key = jax.random.key(2)
    state, acquisition = start(problem, "bavs")
    state, *_ = run_round(problem, acquisition, key, state)
    saved = []

    def on_call(state, info):
        saved.append(jax.tree.map(np.asarray, state))

    copied = jax.tree.map(jnp.copy, state)
    whole, choice, _ = run_round(problem, acquisition, key, copied, on_call)
    assert choice is not None
    half = jax.tree.map(jnp.asarray, saved[2])
    assert int(half.calls) == 3
    resumed, choice, _ = run_round(problem, acquisition, key, half)
    assert choice is None
    jax.tree.map(np.testing.assert_array_equal, resumed.train, whole.train)
    np.testing.assert_array_equal(resumed.is_training_view, whole.is_training_view)


def test_round_zero_does_not_depend_on_the_policy(problem):
    params = []
    for policy in ("random", "bavs"):
        state, acquisition = start(problem, policy)
        state, *_ = run_round(problem, acquisition, jax.random.key(3), state)
        params.append(state.train.model.params)
    jax.tree.map(np.testing.assert_array_equal, *params)


def test_initial_views_depend_on_the_seed_alone_and_too_many_are_an_error():
    scene = toy_scene()
    np.testing.assert_array_equal(initial_views(scene, 3, 4), initial_views(scene, 3, 4))
    assert set(initial_views(scene, 3, 4)) != set(initial_views(scene, 4, 4))
    assert set(initial_views(scene, 0, 9)) == set(scene.pool.tolist())
    with pytest.raises(ValueError, match="num_initial is 10, but the pool has 9"):
        initial_views(scene, 0, 10)


def test_with_a_view_seed_all_seeds_begin_with_its_views(problem, tmp_path):
    views = {}
    for view_seed in (None, 1):
        config = toy_config(view_seed=view_seed)
        views[view_seed] = [
            Run(config, problem, tmp_path, None, s).initial.tolist() for s in (0, 1)
        ]
    assert views[1] == [views[None][1]] * 2 and views[None][0] != views[None][1]


def test_hemisphere_draws_snap_to_the_nearest_unused_views():
    scene = toy_scene()
    source = dataset_candidates(scene, hemisphere_draws=3)
    used = jnp.zeros(12, bool).at[jnp.array([0, 1])].set(True)
    offered = source.propose(jax.random.key(0), None, used)
    poses = scene_hemisphere(jax.random.key(0), scene, 3)
    unused = scene.pool[2:]
    positions = np.asarray(scene.cameras.positions)[unused]
    apart = np.linalg.norm(poses[:, None, :, 3] - positions, axis=-1)
    assert set(offered.view_ids[offered.mask]) == set(unused[apart.argmin(1)])
    everything = dataset_candidates(scene).propose(jax.random.key(0), None, used)
    assert everything.mask.sum() == 7


def test_captured_pictures_go_into_empty_views_until_these_are_full():
    scene = toy_scene()
    scene = dataclasses.replace(scene, alpha=np.full(len(scene.pixels), 7, np.uint8))
    table = with_empty_views(make_pixel_table(scene), 2)
    taken = []

    def capture(cameras):
        taken.append(np.asarray(cameras.world_from_cam))
        num = len(cameras) * 64
        return np.full((num, 3), 50 + len(taken), np.uint8), np.full(num, 9, np.uint8)

    source = captured_candidates(scene, capture, num_candidates=5, first_slot=12)
    used = jnp.zeros(14, bool).at[0].set(True)
    offered = source.propose(jax.random.key(0), table, used)
    assert len(offered.cameras) == 5 and offered.mask.all()
    table, view_ids = source.acquire(table, used, offered, np.array([3, 1]))
    assert view_ids.tolist() == [12, 13]
    np.testing.assert_allclose(table.cameras.world_from_cam[12:], taken[0])
    np.testing.assert_allclose(taken[0][0], offered.cameras.world_from_cam[3])
    assert (np.asarray(table.pixels[12 * 64 :]) == 51).all()
    np.testing.assert_array_equal(table.pixels[: 12 * 64], scene.pixels)
    assert (table.alpha[: 12 * 64] == 7).all() and (table.alpha[12 * 64 :] == 9).all()
    with pytest.raises(ValueError, match="0 empty views left for 1 pictures"):
        source.acquire(table, used.at[view_ids].set(True), offered, np.array([0]))


def test_a_loss_that_is_not_finite_stops_the_run(problem):
    state, acquisition = start(problem, "random")
    broken = jax.tree.map(lambda x: x * jnp.nan, state.train.last_params)
    state = state.replace(train=state.train.replace(last_params=broken))
    with pytest.raises(FloatingPointError, match="round 0, training call 0: the loss is nan"):
        run_round(problem, acquisition, jax.random.key(0), state)


def test_hemisphere_pictures_are_taken_trained_on_and_survive_a_checkpoint(tmp_path):
    config = toy_config(candidates__source="hemisphere", candidates__hemisphere_draws=9)
    problem = make_problem(config)
    state, acquisition = start(problem, "bavs")
    for _ in range(2):
        state, _, view_ids = run_round(problem, acquisition, jax.random.key(0), state)
    first = problem.scene.num_views
    assert view_ids.tolist() == [first, first + 1]
    pictures = np.asarray(state.table.pixels[len(problem.scene.pixels) :]).reshape(4, -1)
    assert pictures[:2].any(axis=1).all() and not pictures[2:].any()

    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, saved_part(problem, state), {})
    saved, _ = checkpoints.restore(saved_part(problem, start(problem, "bavs")[0]))
    restored = whole_state(problem, saved)
    jax.tree.map(np.testing.assert_array_equal, restored.table, state.table)
    np.testing.assert_array_equal(restored.is_training_view, state.is_training_view)


def test_training_on_keeps_the_field_and_training_anew_does_not(problem, monkeypatch):
    losses = {}
    for from_scratch in (True, False):
        # What a round begins with is no part of what is compiled.
        monkeypatch.setattr(problem, "config", toy_config(from_scratch=from_scratch))
        state, acquisition = start(problem, "random")
        first = []
        for _ in range(2):
            calls = []
            state, *_ = run_round(
                problem, acquisition, jax.random.key(0), state, lambda s, i, c=calls: c.append(i)
            )
            first.append(float(calls[0].loss))
        losses[from_scratch] = first
    assert losses[True][0] == losses[False][0]
    assert losses[False][1] < 0.7 * losses[True][1]
