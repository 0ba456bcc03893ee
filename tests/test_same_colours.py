"""Colour and depth of the curvature and the predictive variance are those of the renderer."""

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.fields.hash_grid import (
    HashGridOptions,
    make_hash_grid_density,
    make_hash_grid_field,
)
from bavs_jax.models.base import ModelState
from bavs_jax.models.ray_field import RayField
from bavs_jax.rendering.proposals import make_proposal_sampler
from bavs_jax.rendering.render import Rendering, basic_images, render_rays
from bavs_jax.rendering.samplers import make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.rendering.slopes import depth_jacobian, field_slopes
from bavs_jax.rendering.spacing import open_intervals
from bavs_jax.uncertainty.predictive import make_predictive_fn
from bavs_jax.uncertainty.streaming import make_curvature_fn
from tests.oracles_curvature import defined_jacobian, split_jacobian
from tests.toy_fields import rays_through

BOX = np.array([[-1.0, -1.2, -0.8], [1.0, 1.1, 0.9]], np.float32)
NUM_RAYS, NUM_VIEWS, CAPACITY = 30, 5, 4096


class Setting(NamedTuple):
    """A model with random parameters, its state, rays, and what the renderer makes of them."""

    model: RayField
    state: ModelState
    rays: Rays
    view_ids: Array
    rendering: Rendering
    grid: DeformationGrid


def make_model(unbounded: bool, codes: int) -> tuple[RayField, ModelState]:
    field = make_hash_grid_field(
        BOX,
        HashGridOptions(num_levels=2, coarsest=4, finest=8, width=8, appearance_features=codes),
        contracted=unbounded,
        num_views=NUM_VIEWS,
    )
    if unbounded:
        density = make_hash_grid_density(
            BOX, HashGridOptions(num_levels=2, coarsest=4, finest=8, width=8), contracted=True
        )
        interval_fn = partial(open_intervals, near=0.1, far=100.0, unit=1.0)
        sampler = make_proposal_sampler([density], interval_fn, num_proposals=(8,), num_samples=12)
    else:
        options = make_march_options(BOX, near=0.1, far=10.0, num_steps=32, num_slots=12)
        sampler = make_occupancy_sampler(BOX, options, resolution=4)
    params = {"field": field.init(jax.random.key(0)), "sampler": sampler.init(jax.random.key(1))}
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(2), len(leaves))
    leaves = [x + 0.5 * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys)]
    params = jax.tree.unflatten(structure, leaves)
    background = None if unbounded else np.float32([1.0, 0.6, 0.2])
    model = RayField(field, sampler, background=background, box=None, capacity=CAPACITY)
    return model, ModelState(params, sampler.init_state())


@pytest.fixture(
    scope="module",
    params=itertools.product([False, True], [0, 3]),
    ids=lambda given: f"unbounded={given[0]},codes={given[1]}",
)
def setting(request) -> Setting:
    unbounded, codes = request.param
    model, state = make_model(unbounded, codes)
    rays = rays_through(jax.random.key(3), NUM_RAYS)
    view_ids = jnp.arange(NUM_RAYS) % NUM_VIEWS

    @jax.jit
    def rendered():
        samples, _ = model.sampler.sample(None, state.params["sampler"], state.carried, rays)
        return render_rays(
            rays,
            samples,
            partial(model.field.apply, state.params["field"]),
            background=model.background,
            capacity=CAPACITY,
            exact=True,
            inputs=model.field.inputs(rays, samples, view_ids),
        )

    grid = DeformationGrid(jnp.asarray(BOX), 2, contracted=unbounded)
    return Setting(model, state, rays, view_ids, rendered(), grid)


# Matrix products of other shapes, in float32.
close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5)


def test_the_jacobians_differentiate_what_is_rendered(setting):
    model, state, rays, view_ids, rendering, _ = setting
    field_fn = partial(model.field.apply, state.params["field"])

    @jax.jit
    def everything():
        samples, _ = model.sampler.sample(None, state.params["sampler"], state.carried, rays)
        inputs = model.field.inputs(rays, samples, view_ids)
        colours = [
            jacobian_fn(field_fn, rays, samples, background=model.background, inputs=inputs)[1]
            for jacobian_fn in (defined_jacobian, split_jacobian)
        ]
        slopes = field_slopes(field_fn, rays, samples, inputs=inputs)
        _, depth, opacity = depth_jacobian(slopes, samples)
        terms = model.ray_terms(state, rays, most_points=model.most_points, view_ids=view_ids)
        return colours, (depth, opacity), terms

    colours, (depth, opacity), terms = everything()
    assert np.std(rendering.rgb) > 0.01 and np.std(rendering.depth) > 0.01
    for colour in (*colours, terms.rgb):
        close(colour, rendering.rgb)
    for found in (depth, terms.depth):
        close(found, rendering.depth)
    for found in (opacity, terms.opacity):
        close(found, rendering.opacity)
    np.testing.assert_array_equal(terms.thinned, rendering.thinned)


def test_the_predictive_images_are_those_of_the_renderer(setting):
    model, state, some, *_, grid = setting
    away = some.replace(directions=-some.directions)  # in a bounded scene they meet nothing
    rays = jax.tree.map(lambda *x: jnp.concatenate(x), some, away)
    predictive = make_predictive_fn(model, grid, chunk_samples=128)
    images = predictive(state, jnp.full((grid.num_vertices, 3), 1e-4), rays)
    want = jax.jit(lambda: basic_images(model.render(state, rays)))()
    assert want.keys() <= images.keys()
    for name, value in want.items():
        close(images[name], value, err_msg=name)


def test_the_residual_of_the_curvature_is_that_of_the_render(setting):
    """Weighted by its residual, a ray whose true colour is the rendered one has no curvature."""
    model, state, rays, view_ids, rendering, grid = setting
    curvature = make_curvature_fn(model, grid, weighting="residual_weighted")
    rgb = np.asarray(rendering.rgb)
    right, wrong = (
        curvature(state, rays, targets=targets, view_ids=view_ids) for targets in (rgb, rgb + 0.01)
    )
    # Squares of residuals of 1e-5 at most, against those of 0.01.
    assert float(wrong.max()) > 0.0 and float(right.max()) < 1e-5 * float(wrong.max())
