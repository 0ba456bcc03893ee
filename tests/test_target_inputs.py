"""Which views are asked about, and in which units: a field with random parameters, no training."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from bavs_jax.cameras import take
from bavs_jax.candidates import Candidates
from bavs_jax.fields.deformation import cell_sides
from bavs_jax.policy_inputs import WEIGHTING
from bavs_jax.scenes import SceneError
from bavs_jax.scenes.poses import user_transforms
from bavs_jax.selection.policies import POLICIES
from bavs_jax.selection.targets import target_variances
from bavs_jax.target_inputs import evenly_spaced_cameras
from bavs_jax.uncertainty.model import Acquired
from bavs_jax.uncertainty.posterior import NOISE_VARIANCE, offset_variance
from bavs_jax.uncertainty.streaming import rays_through_pixels
from experiments.build import Problem, build_targets
from tests.toy_rounds import silent
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

KEY = jax.random.key(0)
TAKEN = [1, 4, 7]


def make_problem(**options):
    return Problem(toy_config(candidates__image_scale=1.0, **options), toy_scene(), track=silent)


def target_field(problem):
    """What a policy is given where three views of the toy are trained on."""
    is_training = np.isin(np.arange(problem.scene.num_views), TAKEN)
    pool = np.asarray(problem.scene.pool)
    cameras = take(problem.table.cameras, pool)
    acquired = Acquired(
        problem.trainer.init(KEY), problem.table, is_training, num_rays=100, candidates=cameras
    )
    candidates = Candidates(cameras, pool.astype(np.int32), ~is_training[pool])
    policy = POLICIES["target_information"]
    return acquired, problem.inputs(policy, KEY, acquired, candidates).fields["targets"]


def test_variances_are_in_units_of_the_noise_before_and_after_a_look():
    """Against `offset_variance`, which is told the raw curvature of whole photos."""
    problem = make_problem(targets__num=100)
    acquired, information = target_field(problem)
    pool, setup = np.asarray(problem.scene.pool), problem.setup
    std = setup.laplace.offset_cells * cell_sides(setup.grid)
    assert len(information.looks) == len(TAKEN) and len(information.num_values) == len(pool)
    spaced = evenly_spaced_cameras(acquired.candidates.positions, 100, view_ids=pool)
    np.testing.assert_array_equal(information.num_values, 3 * 8 * 8)
    for number in (0, 5):
        view = np.full(64, pool[spaced[number]], np.int32)
        rays = rays_through_pixels(problem.table.cameras, view, np.arange(64, dtype=np.int32))
        raw = setup.curvature(acquired.train.model, rays, None, weighting=WEIGHTING)
        raw = np.asarray(raw, np.float64)
        assert raw.max() > 0.0
        # Nothing known: offsets of 0.3 cells. Then the target itself is looked at, from k = 1.
        for looks, variance in (
            ((), np.broadcast_to(std**2, raw.shape)),
            (tuple(information.target_fn([number])), np.asarray(offset_variance(raw, std))),
        ):
            found = target_variances(information._replace(looks=looks), []).variances[number]
            np.testing.assert_allclose(NOISE_VARIANCE * found, (raw * variance).sum(), rtol=1e-3)


def test_the_pool_s_targets_are_spread_and_do_not_depend_on_the_order():
    rng = np.random.default_rng(0)
    # Corners and middles of a lattice, so that there are ties.
    positions, view_ids = rng.integers(0, 3, (30, 3)).astype(np.float32), rng.permutation(30)
    rows = evenly_spaced_cameras(positions, 6, view_ids=view_ids)
    order = rng.permutation(30)
    again = evenly_spaced_cameras(positions[order], 6, view_ids=view_ids[order])
    np.testing.assert_array_equal(order[again], rows)
    apart = np.linalg.norm(positions[rows][:, None] - positions[rows], axis=-1)
    chance = np.linalg.norm(positions[:6][:, None] - positions[:6], axis=-1)
    assert apart[np.triu_indices(6, 1)].min() > chance[np.triu_indices(6, 1)].min()
    assert sorted(evenly_spaced_cameras(positions, 99).tolist()) == list(range(30))


def test_poses_of_a_file_are_in_the_user_s_coordinates(tmp_path):
    user = np.eye(4)
    user[:3, :3], user[:3, 3] = 5.0 * np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [1.0, 2, 3]
    scene = dataclasses.replace(toy_scene(), user_from_scene=user)
    poses = np.asarray(scene.cameras.world_from_cam)[[2, 6]]
    frames = [{"transform_matrix": m.tolist()} for m in user_transforms(scene, poses)]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    config = toy_config(targets__kind="file", targets__poses_file=str(path))
    cameras = build_targets(config, scene)(KEY)
    np.testing.assert_allclose(cameras.world_from_cam, poses, atol=1e-5)
    np.testing.assert_array_equal(cameras.sizes, [[8, 8], [8, 8]])
    path.write_text("{}")
    with pytest.raises(SceneError, match=r"config\.targets\.poses_file: .*frames: missing"):
        Problem(config, scene, track=silent)


@pytest.mark.parametrize("kind", ["pool", "hemisphere"])
def test_as_many_targets_as_asked_for(kind):
    problem = make_problem(targets__kind=kind, targets__num=4)
    _, information = target_field(problem)
    looks = list(information.target_fn(range(4)))
    assert len(information.num_values) == len(looks) == 4
    places = np.stack([look.position for look in looks])
    pool = np.asarray(problem.scene.cameras.positions)
    from_pool = (np.abs(places[:, None] - pool).max(-1) == 0.0).any(-1)
    assert from_pool.all() if kind == "pool" else not from_pool.any()
    found = target_variances(information, [0, 3])
    assert (found.variances > 0.0).all() and (found.drops > 0.0).any()
    assert (found.drops < found.variances).all()
