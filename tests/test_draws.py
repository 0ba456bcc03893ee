"""Offsets drawn from the posterior: their spread, what they do to a render, Figure 3 in numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.active import init_active_state
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.pixels import render_pixels
from bavs_jax.uncertainty.draws import (
    colour_spread,
    draw_offsets,
    make_displaced_render_fn,
    noise_scale,
)
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments.build import build_problem
from experiments.posthoc.draws import (
    ViewDraws,
    draw_views,
    farthest_view,
    largest_offset,
    spread_measures,
)
from experiments.posthoc.trained_run import TrainedRun
from experiments.progress import track
from tests.toy_fields import even_sampler, rays_through, smooth_field, smooth_field_fn
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene
from tests.traces import count_traces

pytestmark = pytest.mark.usefixtures("quick_compilation")

GRID = DeformationGrid(jnp.array([[-1.0] * 3, [1.0] * 3]), 2)
SAMPLER = even_sampler(near=1.5, far=4.5, num=24)
PARAMS = {"field": {}, "sampler": {}}
OPTIONS = {"background": np.ones(3, np.float32), "capacity": 10_000}
KEY = jax.random.key(3)


# --- the draws ---


def test_each_vertex_has_the_variance_of_its_posterior():
    precision = 10.0 ** jax.random.uniform(jax.random.key(0), (20, 3), minval=-3.0, maxval=5.0)
    num, scale = 4000, 0.3
    theta = draw_offsets(KEY, precision, num, scale=scale)
    assert theta.shape == (num, 20, 3)
    want = scale**2 / np.asarray(precision)
    # The relative standard error of a variance is sqrt(2 / num) = 2.2 %; five of them.
    np.testing.assert_allclose(theta.var(0), want, rtol=5 * np.sqrt(2 / num))
    # And that of a mean is sd / sqrt(num).
    assert (np.abs(theta.mean(0)) < 5 * np.sqrt(want / num)).all()
    # Vertices and axes are drawn by themselves: correlations have a standard error of num^-0.5.
    correlation = np.corrcoef(np.asarray(theta).reshape(num, -1).T) - np.eye(60)
    assert np.abs(correlation).max() < 5 / np.sqrt(num)


def test_offsets_are_clipped_along_each_axis():
    precision = jnp.full((1000, 3), 1e-6)
    limit = jnp.array([0.1, 0.2, 0.3])
    theta = draw_offsets(KEY, precision, 1, limit=limit)
    np.testing.assert_allclose(np.abs(theta[0]).max(0), limit)
    tight = draw_offsets(KEY, 1e6 * jnp.ones((1000, 3)), 1, limit=limit)
    np.testing.assert_array_equal(tight, draw_offsets(KEY, 1e6 * jnp.ones((1000, 3)), 1))


def test_noise_scale_gives_the_posterior_of_noisy_pixels():
    """For a colour linear in theta, the likelihood's curvature is `sum_rc g^2 / s^2` exactly."""
    g = jax.random.normal(jax.random.key(1), (7, 3, 5))  # rays, channels, offsets
    y = jax.random.normal(jax.random.key(2), (7, 3))
    noise = 0.2

    def negative_log_likelihood(theta):
        residual = jnp.einsum("rcp,p->rc", g, theta) - y
        return 0.5 * jnp.square(residual / noise).sum()

    curvature = jnp.diag(jax.hessian(negative_log_likelihood)(jnp.zeros(5)))
    # The prior is negligible here.
    precision = posterior_precision(jnp.square(g).sum((0, 1)), num_rays=7, prior_weight=1e-12)
    variance = noise_scale(noise**2, 7) ** 2 / precision
    np.testing.assert_allclose(variance, 1.0 / curvature, rtol=1e-5)


# --- the render ---


@pytest.fixture(scope="module")
def displaced():
    render = make_displaced_render_fn(smooth_field(), SAMPLER, GRID, **OPTIONS)
    return partial(render, PARAMS, {})


def test_no_offset_is_the_plain_render_to_the_last_bit(displaced):
    rays = rays_through(KEY, 12)
    plain = jax.jit(
        lambda rays: render_pixels(smooth_field(), SAMPLER, PARAMS, {}, rays, **OPTIONS)[0]
    )(rays)
    got = displaced(jnp.zeros((GRID.num_vertices, 3)), rays)
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(got[name], getattr(plain, name))


def test_one_offset_everywhere_is_a_shifted_field(displaced):
    rays = rays_through(KEY, 12)
    offset = jnp.array([0.05, -0.1, 0.2])
    shifted = Field(
        init=lambda key: {},
        apply=lambda params, x, d: smooth_field_fn(x + offset, d),
        density=lambda params, x: smooth_field_fn(x + offset, x)[0],
    )
    want = render_pixels(shifted, SAMPLER, PARAMS, {}, rays, **OPTIONS)[0]
    got = displaced(jnp.tile(offset, (GRID.num_vertices, 1)), rays)
    # Trilinear weights sum to 1 up to float32.
    np.testing.assert_allclose(got["rgb"], want.rgb, atol=1e-5)
    np.testing.assert_allclose(got["depth"], want.depth, atol=1e-4)


def test_draws_compile_once(displaced):
    rays = rays_through(KEY, 12)
    thetas = draw_offsets(KEY, jnp.ones((GRID.num_vertices, 3)), 3)
    displaced(thetas[0], rays)
    with count_traces() as traces:
        for theta in thetas[1:]:
            displaced(theta, rays)
    assert "render" not in traces


def test_colour_spread_by_hand():
    rgb = np.zeros((2, 1, 3))
    rgb[1, 0] = [0.2, 0.0, 0.4]  # unbiased variances 0.02, 0 and 0.08
    np.testing.assert_allclose(colour_spread(rgb), [np.sqrt(0.1 / 3)], rtol=1e-6)


def test_measures_are_over_covered_pixels():
    """Two pixels with matter, of which the more uncertain one moves more, and an empty one."""
    draws = np.zeros((2, 1, 3, 3))
    draws[1, 0, 0], draws[1, 0, 1] = 0.1, 0.3
    view = ViewDraws(
        0,
        rgb=np.zeros((1, 3, 3)),
        opacity=np.array([[1.0, 0.9, 0.0]]),
        uncertainty=np.array([[0.3, 0.6, 0.9]]),
        draws=draws,
    )
    measures = spread_measures([view, view])
    assert measures["num_views"] == 2 and measures["num_covered_pixels"] == 4
    # Of two values 0 and x the unbiased standard deviation is x / sqrt(2).
    np.testing.assert_allclose(measures["spread"], 0.2 / np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(measures["spread_all"], 0.4 / 3 / np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(measures["rank_correlation"], 1.0)
    nothing = spread_measures([view._replace(opacity=np.zeros((1, 3)))])
    assert nothing["spread"] is None and nothing["rank_correlation"] is None


# --- Figure 3 in numbers ---


@pytest.fixture(scope="module")
def one_sided(tmp_path_factory):
    """A field trained on 4 of 12 views around a ball, all from one side."""
    config = toy_config(train__num_steps=240, num_initial=4)
    problem = build_problem(config, toy_scene(size=16))
    initial = np.arange(4)
    state = init_active_state(problem.init_train(KEY), problem.table, initial)
    step = problem.make_step("random", initial, track, "toy")
    state, _ = step(KEY, state)
    folder = tmp_path_factory.mktemp("one_sided")
    return TrainedRun(config, problem, problem.make_toolbox(track), state, folder, "random", 0)


def test_training_views_stay_and_what_no_view_shows_moves(one_sided):
    run = one_sided
    assert farthest_view(run, np.arange(4, 12)) in (7, 8)  # opposite to the views 0 .. 3
    seen, unseen = [0, 1, 2, 3], [6, 7, 8, 9]
    limit = largest_offset(run, 0.1)
    np.testing.assert_allclose(limit, 0.2)
    views, scale = draw_views(run, np.array(seen + unseen), num_draws=6, scale=None, limit=limit)
    assert 0.0 < scale < 1.0 and [view.view_id for view in views] == seen + unseen
    at_training, elsewhere = spread_measures(views[:4]), spread_measures(views[4:])
    assert at_training["spread"] < elsewhere["spread"]
    assert at_training["spread_all"] < elsewhere["spread_all"]
