"""Offsets drawn from the posterior: their spread, what they do to a render, Figure 3 in numbers."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid, cell_sides
from bavs_jax.uncertainty.curvature import add_jac_sq_sum
from bavs_jax.uncertainty.draws import (
    colour_deviation,
    draw_offsets,
    make_displaced_render_fn,
    noise_scale,
)
from bavs_jax.uncertainty.posterior import default_prior_weight, posterior_precision
from experiments.posthoc import farthest_view, spread_measures
from tests.toy_fields import (
    NOTHING_LEARNT,
    even_sampler,
    ray_model,
    rays_through,
    smooth_field,
    smooth_field_fn,
)
from tests.toy_scenes import toy_scene
from tests.traces import count_traces

BOX = jnp.array([[-1.0] * 3, [1.0] * 3])
GRID = DeformationGrid(BOX, 2)
SAMPLER = even_sampler(near=1.5, far=4.5, num=24)
BACKGROUND = np.ones(3, np.float32)
SMOOTH = ray_model(smooth_field(), SAMPLER, BACKGROUND)
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
    return partial(make_displaced_render_fn(SMOOTH, GRID), NOTHING_LEARNT)


def test_no_offset_is_the_plain_render(displaced):
    rays = rays_through(KEY, 12)
    plain = jax.jit(lambda rays: SMOOTH.render(NOTHING_LEARNT, rays))(rays)
    got = displaced(jnp.zeros((GRID.num_vertices, 3)), rays)
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_allclose(got[name], getattr(plain, name), rtol=1e-6, atol=1e-7)


def test_one_offset_everywhere_is_a_shifted_field(displaced):
    rays = rays_through(KEY, 12)
    offset = jnp.array([0.05, -0.1, 0.2])
    shifted = Field(
        init=lambda key: {},
        apply=lambda params, x, d: smooth_field_fn(x + offset, d),
        density=lambda params, x: smooth_field_fn(x + offset, x)[0],
    )
    want = ray_model(shifted, SAMPLER, BACKGROUND).render(NOTHING_LEARNT, rays)
    got = displaced(jnp.tile(offset, (GRID.num_vertices, 1)), rays)
    # Trilinear weights sum to 1 up to float32.
    np.testing.assert_allclose(got["rgb"], want.rgb, atol=1e-5)
    np.testing.assert_allclose(got["depth"], want.depth, atol=1e-4)


def test_draws_compile_once(displaced):
    rays = rays_through(KEY, 13)  # as many as nothing else has
    thetas = draw_offsets(KEY, jnp.ones((GRID.num_vertices, 3)), 3)
    with count_traces() as first_traces:
        displaced(thetas[0], rays)
    assert "render" in first_traces
    with count_traces() as traces:
        for theta in thetas[1:]:
            displaced(theta, rays)
    assert "render" not in traces


def test_colour_spread_by_hand():
    rgb = np.zeros((2, 1, 3))
    rgb[1, 0] = [0.2, 0.0, 0.4]  # unbiased variances 0.02, 0 and 0.08
    np.testing.assert_allclose(colour_deviation(rgb), [np.sqrt(0.1 / 3)], rtol=1e-6)


def test_measures_are_over_covered_pixels():
    """Two pixels with matter, of which the more uncertain one moves more, and an empty one."""
    draws = np.zeros((2, 1, 3, 3))
    draws[1, 0, 0], draws[1, 0, 1] = 0.1, 0.3
    view = {
        "opacity": np.array([[1.0, 0.9, 0.0]]),
        "uncertainty": np.array([[0.3, 0.6, 0.9]]),
        "draws": draws,
    }
    measures = spread_measures([view, view])
    assert measures["num_views"] == 2 and measures["num_covered_pixels"] == 4
    # Of two values 0 and x the unbiased standard deviation is x / sqrt(2).
    np.testing.assert_allclose(measures["spread"], 0.2 / np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(measures["spread_all"], 0.4 / 3 / np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(measures["rank_correlation"], 1.0)
    nothing = spread_measures([view | {"opacity": np.zeros((1, 3))}])
    assert nothing["spread"] is None and nothing["rank_correlation"] is None


# --- Figure 3 in numbers ---


def ball(positions):
    """A ball with a soft edge, 1 / scene unit, and a texture that varies along every axis."""
    density = 40.0 * jax.nn.sigmoid(30.0 * (0.6 - jnp.linalg.norm(positions, axis=-1)))
    return density, 0.5 + 0.4 * jnp.sin(6.0 * positions)


BALL = Field(
    init=lambda key: {},
    apply=lambda params, x, d: ball(x),
    density=lambda params, x: ball(x)[0],
)


def rays_from(side, num=400):
    """Rays onto the ball from one side of it along x."""
    rng = np.random.default_rng(num)
    starts = np.concatenate([np.full((num, 1), 2.5), rng.uniform(-0.6, 0.6, (num, 2))], -1)
    ends = np.concatenate([np.zeros((num, 1)), rng.uniform(-0.4, 0.4, (num, 2))], -1)
    directions = ends - starts
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    flip = np.array([side, 1.0, 1.0])
    return Rays(
        jnp.asarray(flip * starts, jnp.float32), jnp.asarray(flip * directions, jnp.float32)
    )


@pytest.fixture(scope="module")
def spread_of_side():
    """Colour spread over draws [R] of rays from a side, where only +1 was photographed."""
    rays, noise = rays_from(1.0), 0.02
    grid = DeformationGrid(BOX, 3)
    model = ray_model(BALL, SAMPLER, BACKGROUND)

    @jax.jit
    def raw_sum(rays):
        terms = model.ray_terms(NOTHING_LEARNT, rays, most_points=model.most_points)
        return add_jac_sq_sum(jnp.zeros((grid.num_vertices, 3)), terms, grid)

    num_rays = len(rays.origins)
    prior_weight = default_prior_weight(3)
    precision = posterior_precision(raw_sum(rays), num_rays=num_rays, prior_weight=prior_weight)
    scale = noise_scale(noise**2, num_rays)
    thetas = draw_offsets(KEY, precision, 12, scale=scale, limit=0.25)
    render = make_displaced_render_fn(model, grid)

    def spread(side):
        rgb = [render(NOTHING_LEARNT, theta, rays_from(side))["rgb"] for theta in thetas]
        return np.asarray(colour_deviation(jnp.stack(rgb)))

    return spread, noise


def test_what_was_photographed_stays_and_the_far_side_moves(spread_of_side):
    spread, noise = spread_of_side
    seen, unseen = spread(1.0), spread(-1.0)
    # The posterior allows what the noise hides: 400 rays share some 200 vertices of the near side,
    # so that a colour is known about as well as one pixel tells it. A diagonal precision leaves
    # out that neighbours can make up for each other, which widens it a little.
    assert seen.mean() < 1.5 * noise
    assert unseen.mean() > 4.0 * seen.mean()
    assert np.quantile(unseen, 0.1) > np.median(seen)


def test_farthest_view_and_sides_of_a_cell():
    scene = toy_scene()  # 12 views on a ring
    table = SimpleNamespace(cameras=scene.cameras)
    state = SimpleNamespace(table=table, is_training_view=np.arange(scene.num_views) < 4)
    run = SimpleNamespace(state=state)
    assert farthest_view(run, np.arange(4, 12)) in (7, 8)  # opposite to the views 0 .. 3
    # Four cells along a side of 2; in contracted space the box is the middle half of the grid.
    np.testing.assert_allclose(0.5 * cell_sides(GRID), 0.25)
    np.testing.assert_allclose(0.5 * cell_sides(GRID.replace(contracted=True)), 0.5)
