"""The paper's own: a Laplace approximation on the deformation grid (Eqs 6-13, Fig 4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.training.batches import training_pixels
from bavs_jax.uncertainty.channel import vertex_variance
from bavs_jax.uncertainty.model import (
    LaplaceOptions,
    ModelFns,
    Situation,
    Toolbox,
    UncertaintyModel,
)
from bavs_jax.uncertainty.scoring import make_render_chunk_fn
from bavs_jax.uncertainty.streaming import table_rays


def training_curvature(key, toolbox: Toolbox, situation: Situation, weighting: str) -> jax.Array:
    """`jac_sq_sum` [G, 3] over all training rays, or over a uniform subset that stands for them."""
    view_ids, pixel_ids = training_pixels(situation.table, situation.is_training_view)
    most, scale = toolbox.laplace.max_rays, 1.0
    if most is not None and len(view_ids) > most:
        seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
        rows = np.sort(np.random.default_rng(seed).permutation(len(view_ids))[:most])
        scale = len(view_ids) / most
        view_ids, pixel_ids = view_ids[rows], pixel_ids[rows]
    return scale * toolbox.curvature(
        situation.train,
        label=f"{situation.label}: curvature",
        weighting=weighting,
        **table_rays(situation.table, view_ids, pixel_ids, weighting),
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


def make_fns(toolbox: Toolbox) -> ModelFns:
    """The variance of each vertex is what is fitted; it is rendered as a channel."""
    field, sampler = toolbox.fields[toolbox.kind]
    options = toolbox.laplace
    render_chunk = make_render_chunk_fn(
        field,
        sampler,
        toolbox.grid,
        background=toolbox.background,
        capacity=toolbox.capacity,
        variant=options.variant,
        scale=options.scale,
        extent=options.extent,
        mesh=toolbox.mesh,
    )

    def fit(key, situation):
        jac_sq_sum = training_curvature(key, toolbox, situation, options.weighting)
        variance = laplace_variance(jac_sq_sum, situation.num_rays, options)
        return jax.block_until_ready(jnp.asarray(variance))

    def render(fitted, train, rays):
        return render_chunk(train.params, train.sampler_state, fitted, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="laplace",
        summary="Laplace approximation on the deformation grid: how far a point may be displaced.",
        make_fns=make_fns,
    ),
)
