"""The linearised predictive variance against whole Jacobians, draws and closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays
from bavs_jax.fields.deformation import DeformationGrid, displace
from bavs_jax.models.base import ModelState
from bavs_jax.rendering.compositing import expected_depth, render_weights
from bavs_jax.rendering.occupancy import init_occupancy
from bavs_jax.rendering.samplers import make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options, march, sample_positions
from bavs_jax.rendering.slopes import colour_jacobian, depth_jacobian, field_slopes
from bavs_jax.uncertainty.posterior import laplace_variance, offset_variance, posterior_precision
from bavs_jax.uncertainty.predictive import make_predictive_fn, predictive_variance
from tests.oracles_curvature import colours_with_offsets, dense_depth_jacobian, dense_jacobian
from tests.toy_fields import ray_model, rays_through, smooth_field, smooth_field_fn

BOX = np.array([[-1.0, -1.2, -0.8], [1.0, 1.1, 0.9]])
BACKGROUND = np.array([1.0, 0.9, 0.8])
OPTIONS = make_march_options(BOX, near=0.0, far=10.0, num_steps=24, num_slots=16)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def setting(num_rays=5):
    """Rays with their samples, a grid and variances of its offsets, in the test's precision."""
    grid = DeformationGrid(jnp.asarray(BOX), 2)
    rays = rays_through(jax.random.key(0), num_rays)
    occupancy = init_occupancy(BOX, resolution=4).replace(box=jnp.asarray(BOX))
    variance = jax.random.uniform(jax.random.key(1), (grid.num_vertices, 3), maxval=0.04)
    return grid, rays, jax.jit(march)(rays, occupancy, OPTIONS), variance


@partial(jax.jit, static_argnames="field_fn")
def predicted(grid, rays, samples, variance, field_fn=smooth_field_fn):
    """Variances of colour (over all channels) and depth, [R] each."""
    slopes = field_slopes(field_fn, rays, samples)
    background = jnp.asarray(BACKGROUND, samples.deltas.dtype)
    by_colour, _ = colour_jacobian(slopes, samples.deltas, background=background)
    by_depth, *_ = depth_jacobian(slopes, samples)
    positions = sample_positions(rays, samples)
    return tuple(predictive_variance(grid, positions, j, variance) for j in (by_colour, by_depth))


def test_it_is_the_whole_jacobian_squared_times_the_variances(x64):
    grid, rays, samples, variance = setting()
    of_colour, of_depth = predicted(grid, rays, samples, variance)
    whole = dense_jacobian(smooth_field_fn, grid, rays, samples, BACKGROUND)
    np.testing.assert_allclose(of_colour, (whole**2 * variance).sum((1, 2, 3)), rtol=1e-9)
    whole = dense_depth_jacobian(smooth_field_fn, grid, rays, samples)
    np.testing.assert_allclose(of_depth, (whole**2 * variance).sum((1, 2)), rtol=1e-9)
    assert of_colour.min() > 0 and of_depth.min() > 0


def test_small_offsets_drawn_from_the_posterior_vary_as_much(x64):
    grid, rays, samples, variance = setting()
    small = 1e-6 * variance  # where the field is linear
    draws = jax.random.normal(jax.random.key(2), (4000, *small.shape)) * jnp.sqrt(small)
    colours = jax.jit(
        jax.vmap(
            lambda theta: colours_with_offsets(
                smooth_field_fn, grid, rays, samples, BACKGROUND, theta
            )
        )
    )(draws)
    of_colour, of_depth = predicted(grid, rays, samples, small)
    # A variance of 4000 draws is known to sqrt(2 / 4000) = 2 %; five of that.
    np.testing.assert_allclose(colours.var(0).sum(-1), of_colour, rtol=0.12)

    def depths(theta):
        positions = sample_positions(rays, samples)
        density, _ = smooth_field_fn(positions + displace(grid, theta, positions), positions)
        return expected_depth(render_weights(density, samples.deltas), samples.t_mids)

    np.testing.assert_allclose(jax.jit(jax.vmap(depths))(draws).var(0), of_depth, rtol=0.12)


def test_nothing_changes_where_the_field_is_the_same_everywhere():
    grid, rays, samples, variance = setting()

    def even(positions, directions):
        return jnp.full(positions.shape[:1], 2.0), jnp.full(positions.shape, 0.3)

    for values in predicted(grid, rays, samples, variance, field_fn=even):
        np.testing.assert_array_equal(values, 0.0)


def test_it_grows_with_the_variances_and_in_proportion():
    grid, rays, samples, variance = setting()
    for once, thrice in zip(
        predicted(grid, rays, samples, variance), predicted(grid, rays, samples, 3.0 * variance)
    ):
        np.testing.assert_allclose(thrice, 3.0 * once, rtol=1e-5)  # float32 sums


def test_buckets_change_nothing_and_empty_rays_are_certain():
    grid, some, _, variance = setting(num_rays=40)
    away = Rays(some.origins, -some.directions)
    rays = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), some, away)
    sampler = make_occupancy_sampler(BOX, OPTIONS, resolution=4)
    occupancy = sampler.init_state()
    occupied = jax.random.uniform(jax.random.key(3), occupancy.occupied.shape) < 0.5
    occupancy = occupancy.replace(occupied=occupied)
    state = ModelState({"field": {}, "sampler": {}}, occupancy)
    model = ray_model(smooth_field(), sampler, BACKGROUND)
    images = make_predictive_fn(model, grid, chunk_samples=64)(state, variance, rays)
    samples, _ = jax.jit(partial(sampler.sample, None, {}))(occupancy, rays)
    of_colour, of_depth = predicted(grid, rays, samples, variance)
    # The same float32 sums with more empty slots.
    np.testing.assert_allclose(images["uncertainty"], np.sqrt(of_colour / 3), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(images["depth_uncertainty"], np.sqrt(of_depth), rtol=1e-4, atol=1e-6)
    is_empty = ~np.asarray(samples.sample_mask).any(-1)
    assert is_empty[40:].all() and not is_empty[:40].all()
    assert not images["uncertainty"][is_empty].any() and not images["opacity"][is_empty].any()
    expected = np.broadcast_to(BACKGROUND.astype(np.float32), (is_empty.sum(), 3))
    np.testing.assert_array_equal(images["rgb"][is_empty], expected)


def test_offset_variance_is_laplace_in_other_units():
    jac_sq_sum = jnp.asarray(np.random.default_rng(0).uniform(0.0, 50.0, (7, 3)), jnp.float32)
    std, noise, num_rays = 0.2, 1e-3, 500
    precision = posterior_precision(
        jac_sq_sum, num_rays=num_rays, prior_weight=noise / (num_rays * std**2)
    )
    want = (2.0 * noise / num_rays) * laplace_variance(precision)
    got = offset_variance(jac_sq_sum, std, noise_variance=noise)
    np.testing.assert_allclose(got, want, rtol=1e-5)
    unseen = offset_variance(jnp.zeros((1, 3)), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(unseen, [[0.01, 0.04, 0.09]], rtol=1e-6)
