"""Losses of the radiance field."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.numerics import safe_divide


def colour_loss(rgb: jax.Array, target: jax.Array, ray_weight: jax.Array) -> jax.Array:
    """Mean squared colour error over rays and channels (Eq 5).

    Args:
      rgb, target: [R, 3] in [0, 1].
      ray_weight: [R] >= 0; 0 leaves a ray out of the mean.

    Returns:
      [] mean; 0 if every weight is 0.

    Differs from the paper: a mean over channels, not a sum, so that PSNR is `-10 log10` of it.
    """
    return weighted_mean(jnp.square(rgb - target).mean(-1), ray_weight)


def gaussian_nll(rgb: jax.Array, target: jax.Array, variance: jax.Array, ray_weight: jax.Array):
    """Negative log-likelihood of colours under a variance of their own, up to a constant, [].

    `mean_rc (C - C*)^2 / (2 U) + mean_r log(U) / 2`, the mean over rays and channels.

    Args:
      rgb, target: [R, 3] in [0, 1].
      variance: U [R] > 0, of one channel.
      ray_weight: [R] >= 0; 0 leaves a ray out of the mean.
    """
    squared = jnp.square(rgb - target).mean(-1)
    return weighted_mean(0.5 * (squared / variance + jnp.log(variance)), ray_weight)


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
    """`sum w v / sum w` over all entries; 0 if every weight is 0."""
    return safe_divide((values * weights).sum(), weights.sum())
