"""The curvature of whole views: which code a field is read with, and which pixels count."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import take
from bavs_jax.pixel_table import num_training_pixels, training_pixels
from bavs_jax.policy_inputs import WEIGHTING, make_candidate_curvature_fn, training_looks
from bavs_jax.uncertainty.model import Acquired
from bavs_jax.uncertainty.models.laplace import training_curvature
from experiments.build import Problem, load_config_scene
from tests.toy_rounds import silent
from tests.toy_runs import toy_config

KEY = jax.random.key(0)
TAKEN = [1, 4, 7]
SCALE = 0.5


def make_problem(mask=None):
    config = toy_config(hash_grid__appearance_features=3)
    scene = load_config_scene(config, cache_dir=None)
    return Problem(config, dataclasses.replace(scene, pixel_mask=mask), track=silent)


def with_codes(train, codes):
    params = train.model.params
    field = params["field"] | {"appearance": jnp.asarray(codes, jnp.float32)}
    return with_params(train, params | {"field": field})


def with_params(train, params):
    return train.replace(model=train.model.replace(params=params))


def acquired_of(problem, train):
    is_training = np.zeros(len(problem.table.cameras), bool)
    is_training[TAKEN] = True
    num_rays = int(num_training_pixels(problem.scene, TAKEN).sum())
    candidates = take(problem.table.cameras, np.asarray(problem.scene.pool))
    return Acquired(train, problem.table, is_training, num_rays, candidates)


@pytest.fixture(scope="module")
def whole():
    """A problem whose field has random parameters, and the acquired with a code for each view."""
    problem = make_problem()
    train = problem.trainer.init(KEY)
    leaves, structure = jax.tree.flatten(train.model.params)
    keys = jax.random.split(KEY, len(leaves))
    leaves = [x + 0.3 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys)]
    train = with_params(train, jax.tree.unflatten(structure, leaves))
    codes = 3.0 * np.random.default_rng(0).normal(size=(len(problem.table.cameras), 3))
    return problem, acquired_of(problem, with_codes(train, codes)), codes


def candidate_fn(problem, acquired):
    setup = problem.setup
    return make_candidate_curvature_fn(setup, acquired, acquired.candidates, SCALE)


def assert_equal_sums(got, want):
    """Of float32 terms in another order; the code of another view changes them by far more."""
    want = np.asarray(want)
    assert want.max() > 0.0
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-5 * want.max())


def test_a_candidate_s_curvature_does_not_depend_on_its_place_in_the_group(whole):
    problem, acquired, _ = whole
    curvature = candidate_fn(problem, acquired)
    group = np.array([5, 2, 11, 8])
    together, turned = curvature(group), curvature(group[::-1])[::-1]
    assert_equal_sums(turned, together)
    for place, index in enumerate(group):
        assert_equal_sums(curvature(np.array([index]))[0], together[place])


def test_candidates_are_read_with_the_mean_code(whole):
    problem, acquired, codes = whole
    mean = np.broadcast_to(codes.mean(axis=0), codes.shape)
    plain = acquired._replace(train=with_codes(acquired.train, mean))
    group = np.array([5, 2])
    got = candidate_fn(problem, acquired)(group)
    assert_equal_sums(got, candidate_fn(problem, plain)(group))
    other = with_codes(acquired.train, mean + 1.0)
    other = candidate_fn(problem, acquired._replace(train=other))(group)
    assert np.abs(np.asarray(other) - got).max() > 0.05 * np.abs(got).max(), "codes must matter"


def total_of(setup, looks):
    total = np.zeros((setup.grid.num_vertices, 3))
    for look in looks:
        np.add.at(total, np.asarray(look.rows), np.asarray(look.h))
    return total


def assert_looks_are_the_training_curvature(problem, acquired):
    setup = problem.setup
    jac_sq_sum = training_curvature(KEY, setup, acquired, WEIGHTING)
    want = 2.0 / acquired.num_rays * np.asarray(jac_sq_sum)
    assert_equal_sums(total_of(setup, training_looks(setup, acquired, 1.0)), want)


def test_training_views_are_looked_at_with_their_own_codes(whole):
    problem, acquired, _ = whole
    assert_looks_are_the_training_curvature(problem, acquired)


# --- masks -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def masked(whole):
    """The same with a random half of the pixels masked, and all of one training view but one."""
    problem, acquired, _ = whole
    scene = problem.scene
    mask = np.random.default_rng(1).random(len(scene.pixels)) < 0.5
    rows = scene.view_slice(TAKEN[1])
    mask[rows] = False
    mask[rows.start] = True
    problem = make_problem(mask)
    return problem, acquired_of(problem, acquired.train)


def test_masked_pixels_are_not_counted(masked):
    problem, acquired = masked
    mask, offsets = problem.scene.pixel_mask, problem.scene.offsets
    by_hand = [int(mask[offsets[v] : offsets[v + 1]].sum()) for v in TAKEN]
    for scene in (problem.scene, problem.table):
        np.testing.assert_array_equal(num_training_pixels(scene, TAKEN), by_hand)
    assert sum(by_hand) == len(training_pixels(problem.table, acquired.is_training_view)[0])
    assert problem.acquisition("bavs", TAKEN, "").num_rays == sum(by_hand)


def test_looks_leave_masked_pixels_out(masked):
    assert_looks_are_the_training_curvature(*masked)


def test_reduced_looks_count_by_the_share_that_is_not_masked(whole, masked):
    """Where every view is masked alike in blocks that one reduced pixel covers."""
    problem, acquired, _ = whole
    width, height = (int(n) for n in problem.scene.cameras.sizes[0])
    checks = np.indices((height // 2, width // 2)).sum(axis=0) % 2
    views = []
    for keep in (checks == 0, checks == 1):
        image = np.repeat(np.repeat(keep, 2, axis=0), 2, axis=1)
        views.append(jnp.asarray(np.tile(image.ravel(), len(problem.table.cameras))))
    setup = problem.setup
    parts = [
        total_of(
            setup,
            training_looks(
                setup,
                acquired._replace(table=acquired.table.replace(pixel_mask=mask)),
                SCALE,
            ),
        )
        for mask in views
    ]
    assert parts[0].max() > 0.0 and parts[1].max() > 0.0
    assert_equal_sums(sum(parts), total_of(setup, training_looks(setup, acquired, SCALE)))
    looks = training_looks(problem.setup, masked[1], SCALE)
    assert looks[1].h.sum() < 0.1 * looks[0].h.sum(), "one pixel of that view is left"
