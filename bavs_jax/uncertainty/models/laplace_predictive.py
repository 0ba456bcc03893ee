"""What the offsets' posterior means for colour and depth: ours (`predictive.py`)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.fields.deformation import cell_sides, vertices_in_box
from bavs_jax.uncertainty.model import ModelFns, Toolbox, UncertaintyModel
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import offset_variance
from bavs_jax.uncertainty.predictive import make_predictive_fn


def make_fns(toolbox: Toolbox) -> ModelFns:
    """The variances [G, 3] of the offsets are what is fitted."""
    field, sampler = toolbox.fields[toolbox.kind]
    render_rays = make_predictive_fn(
        field, sampler, toolbox.grid, background=toolbox.background, mesh=toolbox.mesh
    )
    offset_std = toolbox.laplace.offset_cells * cell_sides(toolbox.grid)

    def fit(key, situation):
        jac_sq_sum = training_curvature(key, toolbox, situation, "eq13")
        variance = offset_variance(jac_sq_sum, offset_std)
        if toolbox.laplace.extent == "box":
            variance = variance * vertices_in_box(toolbox.grid)[:, None]
        return jax.block_until_ready(jnp.asarray(variance, jnp.float32))

    def render(fitted, train, rays):
        return render_rays(train.params, train.sampler_state, fitted, rays)

    return ModelFns(fit, render)


UNCERTAINTY_MODELS = (
    UncertaintyModel(
        name="laplace_predictive",
        summary="Deviation of colour and depth under the Laplace posterior, to first order.",
        make_fns=make_fns,
    ),
)
