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
    squared = jnp.square(rgb - target).mean(-1)
    return safe_divide((squared * ray_weight).sum(), ray_weight.sum())
