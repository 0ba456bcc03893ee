"""Which views are chosen does not depend on where a scene lies, how it is turned, or its size."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import look_at
from bavs_jax.candidates import dataset_candidates
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid, offset_unit
from bavs_jax.fields.flow_field import FlowField
from bavs_jax.models.base import ModelState
from bavs_jax.pixel_table import make_pixel_table
from bavs_jax.policy_inputs import InputMaker, LookOptions
from bavs_jax.scenes.poses import transform_poses
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policies import POLICIES
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.channel import make_render_chunk_fn
from bavs_jax.uncertainty.images import make_image_fn
from bavs_jax.uncertainty.measures import make_true_error_fn
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE, Acquired
from bavs_jax.uncertainty.models import MODELS
from bavs_jax.uncertainty.streaming import CurvatureOfRays
from experiments.build import Problem
from tests.toy_fields import even_sampler
from tests.toy_rounds import silent
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

KEY = jax.random.key(3)
NUM_VIEWS, INITIAL, BATCH = 16, [0, 5, 9], 4
# Quarter turns keep the box, and with it the grid, along the axes.
TURN = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
SIMILARITIES = {  # scale, rotation, shift
    "as it is": (1.0, np.eye(3), np.zeros(3)),
    "moved, turned and larger": (40.0, TURN, np.array([70.0, -30.0, 110.0])),
    "turned and smaller": (0.02, TURN.T, np.zeros(3)),
}
BLOBS = np.array([[0.4, 0.1, -0.3], [-0.5, 0.3, 0.2], [0.1, -0.5, 0.4], [-0.2, -0.1, -0.6]])


def field_at(similarity, params, positions, directions):
    """Density, colour and a variance of colour of four coloured blobs, in the moved scene."""
    scale, rotation, shift = similarity
    x, d = (positions - shift) @ rotation / scale, directions @ rotation
    phase = params["phase"]
    squared = jnp.square(x[:, None] - BLOBS).sum(-1)
    density = 12.0 * jnp.exp(-(8.0 + phase) * squared).sum(-1)
    waves = jnp.sin(5.0 * x + jnp.roll(3.0 * x, 1, -1) + d + phase)
    beta = 0.02 + jnp.square(x).sum(-1) / (1.0 + jnp.square(x).sum(-1))
    return density / scale, 0.5 + 0.4 * waves, {"beta": beta}


def toy_fields(similarity):
    """By kind, and the distribution over fields; `phase` is their only parameter."""
    at = functools.partial(field_at, similarity)
    common = {"init": lambda key: {}, "density": lambda params, x: at(params, x, x)[0]}
    plain = Field(apply=lambda *args: at(*args)[:2], **common)

    def drawn(params, positions, directions, noise):
        return at({"phase": params["phase"] + 0.3 * noise[0]}, positions, directions)[:2]

    fields = {RECONSTRUCTION: plain, VARIANCE: Field(apply=at, **common), FLOW: plain}
    return fields, FlowField(apply=drawn, **common)


def toy_train(kind, key, acquired):
    """A field of any kind, another one for each key."""
    del kind, acquired
    phase = 0.3 * jax.random.normal(key)
    params = {"field": {"phase": phase}, "sampler": {}}
    return TrainState(jnp.int32(0), ModelState(params, {}), params, None)


def random_scene():
    """Cameras around the origin at uneven places and distances, so that no two scores are tied."""
    rng, scene = np.random.default_rng(2), toy_scene(NUM_VIEWS, num_test=1)
    places = rng.normal(size=(NUM_VIEWS, 3))
    places *= rng.uniform(2.5, 4.0, (NUM_VIEWS, 1)) / np.linalg.norm(places, axis=1, keepdims=True)
    poses = np.stack([look_at(p, rng.uniform(-0.3, 0.3, 3)) for p in places]).astype(np.float32)
    return dataclasses.replace(scene, cameras=scene.cameras.replace(world_from_cam=poses))


def moved_scene(similarity, unbounded):
    scene, (scale, rotation, shift) = random_scene(), similarity
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
    poses = transform_poses(matrix, scene.cameras.world_from_cam).astype(np.float32)
    return dataclasses.replace(
        scene,
        cameras=scene.cameras.replace(world_from_cam=poses),
        box=np.sort(scale * scene.box @ rotation.T + shift, axis=0).astype(np.float32),
        near=scale * scene.near,
        far=scale * scene.far,
        up=tuple(rotation @ np.asarray(scene.up)),
        unbounded=unbounded,
    )


class World:
    """Everything that chooses, on analytic fields that need no training."""

    def __init__(self, name, unbounded):
        similarity = SIMILARITIES[name]
        self.scene = scene = moved_scene(similarity, unbounded)
        setup = Problem(toy_config(), scene, track=silent).setup
        sampler = even_sampler(near=scene.near, far=scene.far, num=32)
        fields, flow = toy_fields(similarity)
        models = {
            kind: dataclasses.replace(setup.models[kind], field=field, sampler=sampler)
            for kind, field in fields.items()
        }
        curvature = CurvatureOfRays(
            models[RECONSTRUCTION],
            setup.grid,
            group_size=setup.curvature.group_size,
            track=silent,
        )
        laplace = setup.laplace
        render_chunk = make_render_chunk_fn(
            models[RECONSTRUCTION],
            setup.grid,
            variant=laplace.variant,
            scale=laplace.scale,
            extent=laplace.extent,
        )
        self.setup = setup = setup._replace(
            models=models,
            flow=flow,
            curvature=curvature,
            render_chunk=render_chunk,
            train=toy_train,
            image_scale=1.0,
            chunk=256,
        )
        render = make_image_fn(setup, RECONSTRUCTION)
        self.inputs = InputMaker(
            setup,
            functools.cache(lambda name: MODELS[name].make_fns(setup)),
            LookOptions(image_scale=1.0, chunk=256),
            track=silent,
            true_error_fn=make_true_error_fn(
                lambda state: functools.partial(render, state), scene, image_scale=1.0, chunk=256
            ),
        )

    def choose(self, policy):
        """The chosen views, and the scores of the first pick, the largest being 1."""
        table, train = make_pixel_table(self.scene), toy_train(None, KEY, None)
        is_training = np.isin(np.arange(NUM_VIEWS), INITIAL)
        candidates = dataset_candidates(self.scene).propose(KEY, table, is_training)
        acquired = Acquired(train, table, is_training, 64 * len(INITIAL), candidates.cameras)
        context = make_context(
            candidates.cameras.positions,
            view_ids=candidates.view_ids,
            mask=candidates.mask,
            training_positions=table.cameras.positions,
            is_training_view=is_training,
            centre=self.scene.centre,
            **self.inputs(policy, KEY, acquired, candidates).fields,
        )
        selected, info = acquire(policy, KEY, context, BATCH)
        scores = info.scores[np.isfinite(info.scores)]
        return candidates.view_ids[selected].tolist(), scores / np.abs(scores).max()


make_world = functools.cache(World)


@pytest.mark.parametrize("name", [n for n, policy in POLICIES.items() if not policy.stochastic])
def test_moving_turning_and_scaling_a_scene_changes_no_choice(name):
    want, want_scores = make_world("as it is", False).choose(POLICIES[name])
    got, scores = make_world("moved, turned and larger", False).choose(POLICIES[name])
    assert got == want
    # float32 positions 100 units away from the origin
    np.testing.assert_allclose(scores, want_scores, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    "name", ["bavs_topk", "d_optimal", "bavs_spread", "target_information_log", "surface_coverage"]
)
def test_the_size_of_an_unbounded_scene_changes_no_choice(name):
    want, want_scores = make_world("as it is", True).choose(POLICIES[name])
    got, scores = make_world("turned and smaller", True).choose(POLICIES[name])
    assert got == want
    np.testing.assert_allclose(scores, want_scores, rtol=2e-3, atol=2e-3)


def test_offsets_are_measured_in_thirds_of_the_box():
    box = np.array([[-1.5] * 3, [1.5] * 3], np.float32)
    assert offset_unit(box) == 1.0 and jax.jit(offset_unit)(box) == 1.0
    assert offset_unit(box[:, [0, 1, 2]] * np.float32([1.0, 2.0, 3.0])) == 2.0
    grid = DeformationGrid(jnp.asarray(box), 2)
    assert offset_unit(grid.box) == 1.0
