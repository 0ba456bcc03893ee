"""How close rendered depth is to true depth, measured only where the truth is known."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def depth_mae(depth: jax.Array, true_depth: jax.Array) -> jax.Array:
    """Mean absolute depth error over the pixels whose true depth is known.

    `sum_p known_p |depth_p - true_depth_p| / sum_p known_p` with `known_p = true_depth_p > 0`:
    a scene writes 0 where a ray hits nothing or was not measured.

    Args:
      depth: [..., H, W] rendered distance along the unit ray, scene units.
      true_depth: [..., H, W] true distance along the unit ray, scene units, 0 where unknown.

    Returns:
      [...] scene units; NaN where no pixel of an image has a known depth.

    Raises:
      ValueError: the shapes differ.
    """
    if depth.shape != true_depth.shape:
        raise ValueError(
            f"depth: rendered {depth.shape} and true {true_depth.shape} must have one shape"
        )
    known = true_depth > 0.0
    error = jnp.where(known, jnp.abs(depth - true_depth), 0.0)
    return error.sum(axis=(-2, -1)) / known.sum(axis=(-2, -1))
