"""Uncertainty as one more volume-rendered channel (Fig 4)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.fields.deformation import DeformationGrid, interpolate
from bavs_jax.rendering.render import Channel
from bavs_jax.uncertainty.posterior import (
    bayesrays_vertex_variance,
    laplace_variance,
    posterior_precision,
)

VARIANTS = ("posterior", "bayesrays")
SCALES = ("log", "sigma")
LOG10_MIN, LOG10_MAX = -3.0, 6.0


def vertex_variance(
    jac_sq_sum: jax.Array, *, num_rays, prior_weight, weighting: str, variant: str
) -> jax.Array:
    """One variance per vertex [G], scene unit^2: what `make_uncertainty_channel` interpolates.

    `posterior`: `sum_d 1 / H_d`. `bayesrays`: `1 / (sum_d jac_sq_sum_d / R + lambda)`.

    Raises:
      ValueError: unknown variant.
    """
    if variant == "posterior":
        precision = posterior_precision(
            jac_sq_sum, num_rays=num_rays, prior_weight=prior_weight, weighting=weighting
        )
        return laplace_variance(precision).sum(-1)
    if variant == "bayesrays":
        return bayesrays_vertex_variance(jac_sq_sum, num_rays=num_rays, prior_weight=prior_weight)
    raise ValueError(f"variant: {variant!r} is unknown; use one of {', '.join(VARIANTS)}")


def uncertainty_at(
    grid: DeformationGrid, variance: jax.Array, positions: jax.Array, *, variant: str
) -> jax.Array:
    """Standard deviation of the offset at points [..., 3], scene units.

    `posterior`: `sigma^2 = sum_k b_k^2 s_k`, the variance of `sum_k b_k theta_k`.
    `bayesrays`: the same weights normalised, `bhat_k = b_k^2 / sum_k b_k^2`.
    """
    summed = interpolate(grid, variance, positions, power=2)
    if variant == "bayesrays":
        summed = summed / interpolate(grid, jnp.ones_like(variance), positions, power=2)
    return jnp.sqrt(summed)


def make_uncertainty_channel(
    grid: DeformationGrid, variance: jax.Array, *, variant: str, scale: str
) -> Channel:
    """The channel to hand to the renderer.

    Args:
      grid: the deformation grid.
      variance: [G] from `vertex_variance`.
      variant: one of `VARIANTS`.
      scale: `sigma` renders sigma over a floor of 0; `log` renders log10(sigma) over a floor
        of -3. Finish either with `finish_uncertainty`.

    Raises:
      ValueError: unknown scale.
    """
    if scale == "sigma":
        return Channel(lambda x, _: uncertainty_at(grid, variance, x, variant=variant), 0.0)
    if scale == "log":
        return Channel(
            lambda x, _: jnp.log10(uncertainty_at(grid, variance, x, variant=variant)), LOG10_MIN
        )
    raise ValueError(f"scale: {scale!r} is unknown; use one of {', '.join(SCALES)}")


def finish_uncertainty(rendered: jax.Array, *, scale: str) -> jax.Array:
    """What is shown and scored: sigma as it is, log10 sigma clipped to [-3, 6] and put on [0, 1].

    A ray that meets nothing is 0 in both scales, so an empty background never counts.
    """
    if scale == "sigma":
        return rendered
    return (jnp.clip(rendered, LOG10_MIN, LOG10_MAX) - LOG10_MIN) / (LOG10_MAX - LOG10_MIN)
