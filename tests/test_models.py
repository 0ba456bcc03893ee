"""Every uncertainty model on one trained field, through the one renderer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import reduced_cameras, take
from bavs_jax.models.losses import gaussian_nll
from bavs_jax.pixel_table import view_pixel_rays
from bavs_jax.policy_inputs import WEIGHTING, make_candidate_curvature_fn, training_looks
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.measures import make_true_error_fn
from bavs_jax.uncertainty.model import RECONSTRUCTION, Acquired
from bavs_jax.uncertainty.models import MODELS, get_model
from bavs_jax.uncertainty.models.laplace import training_curvature
from experiments.build import Problem, initial_views, load_config_scene
from experiments.build_model import RENDER_CHUNK
from tests.toy_rounds import silent
from tests.toy_runs import toy_config

KEY = jax.random.key(5)
every_model = pytest.mark.parametrize("name", MODELS)


@pytest.fixture(scope="module")
def trained():
    """A problem, and the acquired after a short training on its initial views."""
    config = toy_config(train__num_steps=64, candidates__image_scale=0.5)
    problem = Problem(config, load_config_scene(config, cache_dir=None), track=silent)
    initial = initial_views(problem.scene, 0, 4)
    mask = np.zeros(problem.scene.num_views, bool)
    mask[initial] = True
    acquired = Acquired(
        train=None,
        table=problem.table,
        is_training_view=jnp.asarray(mask),
        num_rays=int(np.diff(problem.scene.offsets)[initial].sum()),
        candidates=take(problem.table.cameras, np.asarray(problem.scene.pool)),
        label="toy",
    )
    train = problem.setup.train(RECONSTRUCTION, KEY, acquired)
    return problem, acquired._replace(train=train)


@pytest.fixture(scope="module")
def fitted_models(trained):
    problem, acquired = trained
    models = {name: problem.model_fns(name) for name in MODELS}
    return {name: (fns, fns.fit(KEY, acquired)) for name, fns in models.items()}


def rays_of_view(problem, view=0):
    num = int(problem.scene.offsets[1])
    views = np.full(num, view, np.int32)
    return view_pixel_rays(problem.table.cameras, views, np.arange(num, dtype=np.int32))


@every_model
def test_images_are_whole_finite_and_not_negative(trained, fitted_models, name):
    problem, acquired = trained
    fns, fitted = fitted_models[name]
    rays = rays_of_view(problem)
    images = fns.render(fitted, acquired.train, rays)
    assert {"rgb", "depth", "opacity", "thinned", "uncertainty"} <= images.keys()
    assert images["rgb"].shape == (len(rays.origins), 3)
    for value in images.values():
        assert np.isfinite(value).all() and (np.asarray(value) >= 0).all()
    assert np.asarray(images["uncertainty"]).std() > 0, "it must tell pixels apart"


@every_model
def test_a_ray_that_meets_nothing_is_certain(trained, fitted_models, name):
    problem, acquired = trained
    fns, fitted = fitted_models[name]
    rays = rays_of_view(problem)
    away = rays.replace(directions=-rays.directions)  # away from the scene's box
    images = fns.render(fitted, acquired.train, away)
    np.testing.assert_array_equal(images["opacity"], 0.0)
    for measure in images.keys() - {"rgb"}:
        np.testing.assert_allclose(images[measure], 0.0, atol=1e-7, err_msg=measure)


def test_only_coverage_can_be_conditioned_on_picks(fitted_models):
    conditioned = [n for n, (fns, _) in fitted_models.items() if fns.condition]
    assert conditioned == ["coverage", "surface_coverage"]


@pytest.mark.parametrize("name, share", [("coverage", 0.9), ("surface_coverage", 1.0)])
def test_coverage_falls_with_picks(trained, fitted_models, name, share):
    problem, acquired = trained
    fns, fitted = fitted_models[name]
    num = len(problem.scene.pool)
    picked = np.zeros(num, bool)
    unseen = int(np.flatnonzero(~np.asarray(acquired.is_training_view)[problem.scene.pool])[0])

    def score(state):
        small = reduced_cameras(take(acquired.candidates, np.array([unseen])), 0.5)
        return mean_uncertainty(
            lambda rays: fns.render(state, acquired.train, rays), small, chunk=RENDER_CHUNK
        )[0]

    before = score(fns.condition(fitted, acquired.train, picked))
    picked[unseen] = True
    after = score(fns.condition(fitted, acquired.train, picked))
    # A field of so few steps is fog, and in fog a view sees only what is not behind its surface.
    # It has hardly a cell that counts as surface.
    assert 0.0 < after < share * before


def test_candidates_add_what_their_photos_would(trained):
    problem, acquired = trained
    setup = problem.setup
    curvature = make_candidate_curvature_fn(setup, acquired, acquired.candidates, 1.0)
    num_rays = int(problem.scene.offsets[1])
    pixel_ids = np.arange(num_rays, dtype=np.int32)
    for index, added in zip((3, 1), curvature(np.array([3, 1]))):
        views = np.full(num_rays, problem.scene.pool[index], np.int32)
        rays = view_pixel_rays(acquired.table.cameras, views, pixel_ids)
        jac_sq_sum = setup.curvature(acquired.train.model, rays, None, weighting=WEIGHTING)
        expected = 2.0 / acquired.num_rays * np.asarray(jac_sq_sum)
        assert expected.max() > 0
        # Sums of float32 in another order of rays.
        np.testing.assert_allclose(added, expected, rtol=1e-4, atol=1e-6 * expected.max())


def test_looks_of_the_training_views_add_up_to_their_curvature(trained):
    problem, acquired = trained
    setup = problem.setup
    looks = training_looks(setup, acquired, 1.0)
    taken = np.flatnonzero(acquired.is_training_view)
    positions = np.asarray(acquired.table.cameras.positions)[taken]
    np.testing.assert_array_equal([look.position for look in looks], positions)
    total = np.zeros((setup.grid.num_vertices, 3))
    for look in looks:
        np.add.at(total, np.asarray(look.rows), np.asarray(look.h))
    jac_sq_sum = training_curvature(jax.random.key(0), setup, acquired, WEIGHTING)
    expected = 2.0 / acquired.num_rays * np.asarray(jac_sq_sum)
    # Sums of float32 in another order of rays.
    np.testing.assert_allclose(total, expected, rtol=1e-4, atol=1e-6 * expected.max())


def test_true_error_of_a_constant_render(trained):
    problem, _ = trained
    scene = problem.scene

    def grey(state):
        return lambda rays: {"rgb": jnp.full((len(rays.origins), 3), state)}

    error_fn = make_true_error_fn(grey, scene, image_scale=1.0, chunk=64)
    photos = [scene.image(v) / 255.0 for v in (2, 5)]
    expected = [np.square(photo - 0.25).mean() for photo in photos]
    np.testing.assert_allclose(error_fn(0.25, [2, 5]), expected, rtol=1e-5)  # float32 renders


def test_gaussian_nll_by_hand():
    rgb, target = jnp.array([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0]]), jnp.zeros((2, 3))
    variance, weight = jnp.array([0.25, 0.04]), jnp.array([1.0, 3.0])
    by_hand = (1.0 * 0.5 * (0.25 / 0.25 + np.log(0.25)) + 3.0 * 0.5 * np.log(0.04)) / 4.0
    np.testing.assert_allclose(gaussian_nll(rgb, target, variance, weight), by_hand, rtol=1e-6)
    # Of all variances the error's own square is likeliest.
    slope = jax.grad(lambda v: gaussian_nll(rgb, target, v, jnp.array([1.0, 0.0])))
    np.testing.assert_allclose(slope(variance)[0], 0.0, atol=1e-6)


def test_unknown_model_is_an_error_with_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown name 'lapace'; known: .*laplace"):
        get_model("lapace")
