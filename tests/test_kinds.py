"""The whole loop on every kind of field and sampler, bounded and unbounded."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.fields.hash_grid import HashGridOptions, make_hash_grid_field
from bavs_jax.pixel_table import make_pixel_table
from bavs_jax.rendering.samplers import dense_samples
from experiments.build import Problem
from experiments.build_model import (
    KINDS,
    SPARE,
    YOUNG,
    build_flow,
    build_model,
    build_trainer,
    fitting_capacity,
)
from experiments.runtime import ConfigError
from tests.toy_fields import rays_through
from tests.toy_rounds import run_round, silent, start
from tests.toy_runs import SMALL_NETWORKS, toy_config
from tests.toy_scenes import toy_scene
from tests.traces import count_traces

KEY = jax.random.key(0)
TINY = {
    **SMALL_NETWORKS,
    "hash_grid__num_levels": 1,
    "train__num_rays": 128,
    "train__num_steps": 160,
    "train__steps_per_call": 16,
    "train__learning_rate": 5e-3,
}


def tiny_problem(unbounded, **overrides):
    scene = dataclasses.replace(toy_scene(), unbounded=unbounded)
    config = toy_config(loader="blender", **TINY, **overrides)
    return Problem(config, scene, track=silent)


@pytest.mark.parametrize(
    "unbounded, field_kind, options",
    [
        pytest.param(False, "nerf_mlp", {}, marks=pytest.mark.slow),
        pytest.param(False, "mip_mlp", {}, marks=pytest.mark.slow),
        (True, "hash_grid", {"hash_grid__appearance_features": 2}),
    ],
)
def test_rounds_run_and_trace_nothing_new(unbounded, field_kind, options):
    problem = tiny_problem(unbounded, field_kind=field_kind, **options)
    state, acquisition = start(problem, "bavs")
    key, losses = jax.random.key(1), []

    def on_call(state, info):
        losses.append(float(info.loss))

    with count_traces() as first_traces:
        state, *_ = run_round(problem, acquisition, key, state, on_call)
        assert losses[-1] < 0.7 * losses[0]
        state, *_ = run_round(problem, acquisition, key, state)
    with count_traces() as traces:
        state, choice, view_ids = run_round(problem, acquisition, key, state)
    assert int(state.round) == 2 and len(set(view_ids.tolist())) == 2
    fixed_shapes = {"train", "render_chunk", "add_chunk"}
    assert fixed_shapes <= set(first_traces), "the listener must see these names once"
    assert not set(traces) & fixed_shapes
    assert int(state.is_training_view.sum()) == 6
    scores = np.asarray(choice.selection.scores)[choice.selected]
    assert np.isfinite(scores).all() and (scores > 0).all()


def test_every_kind_learns_a_sampler_beside_the_field():
    problem = tiny_problem(True, field_kind="nerf_mlp", sampler_kind="proposal")
    params = problem.trainer.init(jax.random.key(0)).model.params
    assert set(params) == {"field", "sampler"} and len(params["sampler"]) == 2


@pytest.mark.parametrize(
    "unbounded, options, message",
    [
        (True, {"sampler_kind": "occupancy"}, "'occupancy' does not go with"),
        (False, {"sampler_kind": "coarse_to_fine"}, "does not go with field_kind 'hash_grid'"),
        (True, {"field_kind": "mip_mlp"}, "'mip_mlp' is for bounded scenes"),
        (False, {"sampler_kind": "proposal", "proposal__finest": (64,)}, "config.proposal.finest"),
    ],
)
def test_kinds_that_do_not_go_together_are_errors(unbounded, options, message):
    with pytest.raises(ConfigError, match=message):
        tiny_problem(unbounded, **options)


def test_views_without_training_are_read_with_the_mean_code():
    field = make_hash_grid_field(
        np.array([[-1.0] * 3, [1.0] * 3]),
        HashGridOptions(num_levels=1, finest=8, width=8, appearance_features=3),
        num_views=4,
    )
    params = field.init(jax.random.key(0))
    assert not np.any(params["appearance"])
    codes = jnp.array([[1.0, 0, 0], [0, 0, 0], [3.0, 2.0, 0], [0, 0, 0]])  # 0 and 2 were trained
    params = params | {"appearance": codes}
    mean = params | {"appearance": codes.at[1].set(jnp.array([2.0, 1.0, 0.0]))}
    x, rays = jnp.zeros((2, 3)), rays_through(jax.random.key(1), 2)
    _, unseen = field.apply(params, x, rays.directions)
    _, want = field.apply(mean, x, rays.directions, view_ids=jnp.array([1, 1]))
    _, first = field.apply(params, x, rays.directions, view_ids=jnp.array([0, 0]))
    np.testing.assert_allclose(unseen, want, atol=1e-6)
    assert float(jnp.abs(first - want).max()) > 1e-4
    samples = dense_samples(jnp.ones((2, 5)), jnp.ones((2, 5)), jnp.zeros(2, bool))
    assert field.inputs(rays, samples) == {}
    given = field.inputs(rays, samples, jnp.array([3, 1]))["view_ids"]
    np.testing.assert_array_equal(given, [[3] * 5, [1] * 5])


@pytest.mark.parametrize("field_kind", ["nerf_mlp", "mip_mlp"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_training_fits_every_network(field_kind, kind):
    """Shapes alone: a step of training is traced, not compiled."""
    scene = toy_scene()
    config = toy_config(loader="blender", **TINY, field_kind=field_kind)
    model = build_model(config, scene, scene.num_views, kind, build_flow(config, scene))
    trainer = build_trainer(config, model)
    state = jax.eval_shape(trainer.init, KEY)
    table = make_pixel_table(scene)
    mask = np.ones(scene.num_views, bool)

    def first_call(state):  # whose step is known while it is traced
        return trainer.call(KEY, state.replace(step=np.int32(0)), table, mask)

    after, info = jax.eval_shape(first_call, state)
    assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)
    assert info.loss.shape == ()


@pytest.mark.parametrize(
    "needed, size",
    [(0, 400), (1, 400), (363, 400), (364, 800), (800, 800), (999, 800)],
)
def test_a_buffer_is_the_smallest_share_with_room_to_spare(needed, size):
    assert fitting_capacity(needed, 800, most_points=24) == size
    assert fitting_capacity(needed, 800, most_points=500) == 800


def test_a_field_with_few_samples_trains_the_same_in_a_smaller_buffer():
    """And once it is older only: a young one changes too fast."""
    scene, table = toy_scene(), make_pixel_table(toy_scene())
    mask, ends, programs = np.ones(scene.num_views, bool), [], []

    def problem_with(capacity):
        config = toy_config(loader="blender", train__num_rays=32, train__capacity=capacity)
        return Problem(config, scene)

    whole = problem_with(4096)
    state = whole.trainer.init(KEY)
    needed = int(jax.jit(whole.model.places_needed)(KEY, state.model, table, mask))
    just_enough = int(np.ceil(SPARE * needed))
    for capacity in (just_enough, 2 * just_enough):
        trainer = problem_with(capacity).trainer
        with count_traces() as young:
            trainer.call(KEY, jax.tree.map(jnp.copy, state), table, mask)
        old_state = jax.tree.map(jnp.copy, state.replace(step=jnp.int32(YOUNG)))
        with count_traces() as old:
            ends.append(trainer.call(KEY, old_state, table, mask))
        programs.append((young.count("train"), old.count("train")))
    assert programs == [(1, 0), (1, 1)]
    assert ends[0][1].rays == 32
    jax.tree.map(np.testing.assert_array_equal, *ends)


def test_one_ray_a_pixel_comes_first_and_several_later():
    """Each call does what a trainer of that number of rays alone does from the same state."""
    scene, table = toy_scene(), make_pixel_table(toy_scene())
    mask, ends = np.ones(scene.num_views, bool), {}
    for name, options in {
        "one": {"rays_per_pixel": 1},
        "four": {"rays_per_pixel": 4, "train__one_ray_share": 0.0},
        "both": {"rays_per_pixel": 4, "train__one_ray_share": 0.5},
    }.items():
        config = toy_config(
            loader="blender", train__num_steps=8, train__steps_per_call=4, **options
        )
        trainer = Problem(config, scene).trainer
        state, _ = trainer.call(KEY, trainer.init(KEY), table, mask)
        ends[name] = jax.tree.map(np.asarray, state), trainer
    jax.tree.map(np.testing.assert_array_equal, ends["both"][0], ends["one"][0])
    assert any(
        (a != b).any() for a, b in zip(*map(jax.tree.leaves, (ends["one"][0], ends["four"][0])))
    )
    later = [
        ends[name][1].call(KEY, jax.tree.map(jnp.asarray, ends["one"][0]), table, mask)[0]
        for name in ("both", "four")
    ]
    jax.tree.map(np.testing.assert_array_equal, *later)
