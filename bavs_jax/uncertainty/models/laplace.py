"""The paper's own: a Laplace approximation on the deformation grid (Eqs 6-13, Fig 4)."""

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.fields.deformation import cell_sides, vertices_in_box
from bavs_jax.pixel_table import training_pixels
from bavs_jax.uncertainty.channel import vertex_variance
from bavs_jax.uncertainty.model import (
    Acquired,
    LaplaceOptions,
    ModelFns,
    SceneSetup,
    UncertaintyModel,
)
from bavs_jax.uncertainty.posterior import offset_variance
from bavs_jax.uncertainty.predictive import make_predictive_fn
from bavs_jax.uncertainty.streaming import table_rays


def training_curvature(key, setup: SceneSetup, acquired: Acquired, weighting: str) -> jax.Array:
    """`jac_sq_sum` [G, 3] over all training rays, or over a uniform subset that stands for them."""
    view_ids, pixel_ids = training_pixels(acquired.table, acquired.is_training_view)
    most, scale = setup.laplace.max_rays, 1.0
    if most is not None and len(view_ids) > most:
        seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
        rows = np.sort(np.random.default_rng(seed).permutation(len(view_ids))[:most])
        scale = len(view_ids) / most
        view_ids, pixel_ids = view_ids[rows], pixel_ids[rows]
    return scale * setup.curvature(
        acquired.train.model,
        label=f"{acquired.label}: curvature",
        weighting=weighting,
        **table_rays(acquired.table, view_ids, pixel_ids, weighting),
    )


def laplace_variance(jac_sq_sum: jax.Array, num_rays, options: LaplaceOptions) -> jax.Array:
    """`vertex_variance` [G] under a scene's options, scene unit^2."""
    return vertex_variance(
        jac_sq_sum,
        num_rays=num_rays,
        prior_weight=options.prior_weight,
        weighting=options.weighting,
        variant=options.variant,
    )


def make_fns(setup: SceneSetup) -> ModelFns:
    """The variance of each vertex is what is fitted; it is rendered as a channel."""
    options = setup.laplace

    def fit(key, acquired):
        jac_sq_sum = training_curvature(key, setup, acquired, options.weighting)
        variance = laplace_variance(jac_sq_sum, acquired.num_rays, options)
        return jax.block_until_ready(jnp.asarray(variance))

    def render(fitted, train, rays):
        return setup.render_chunk(train.model, fitted, rays)

    return ModelFns(fit, render)


def make_predictive_fns(setup: SceneSetup) -> ModelFns:
    """Ours: what the offsets' posterior means for colour and depth (`predictive.py`).

    The variances [G, 3] of the offsets are what is fitted.
    """
    render_rays = make_predictive_fn(setup.model, setup.grid, mesh=setup.mesh)
    offset_std = setup.laplace.offset_cells * cell_sides(setup.grid)

    def fit(key, acquired):
        jac_sq_sum = training_curvature(key, setup, acquired, "gauss_newton")
        variance = offset_variance(jac_sq_sum, offset_std)
        if setup.laplace.extent == "box":
            variance = variance * vertices_in_box(setup.grid)[:, None]
        return jax.block_until_ready(jnp.asarray(variance, jnp.float32))

    def render(fitted, train, rays):
        return render_rays(train.model, fitted, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="laplace",
        summary="Laplace approximation on the deformation grid: how far a point may be displaced.",
        make_fns=make_fns,
    ),
    UncertaintyModel(
        name="laplace_predictive",
        summary="Deviation of colour and depth under the Laplace posterior, to first order.",
        make_fns=make_predictive_fns,
    ),
)
