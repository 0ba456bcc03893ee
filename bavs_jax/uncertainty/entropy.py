"""Ray entropy (Lee et al. 2022): how unsure a field is of where a ray ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.numerics import opacity_or_empty, safe_divide, x_log_x


def ray_entropy(weights: jax.Array, *, by_opacity: bool = True) -> jax.Array:
    """Entropy of where a ray ends, `-sum_i what_i log what_i` with `what = w / sum_i w_i`.

    Times the ray's opacity o (`by_opacity`): what is not there cannot be uncertain in its place.
    A ray that ends surely has the authors' value, and thin fog over an empty background, whose
    depth is anybody's guess, fades out with its opacity instead of deciding the score.

    Args:
      weights: [..., S] rendering weights >= 0, summing to at most 1.
      by_opacity: False leaves the factor out, as published.

    Returns:
      [...] in [0, log S], nats; 0 on a ray that meets nothing.

    Numerics: computed as `o log o - sum_i w_i log w_i`, whose gradient is finite and 0 at empty
    samples; rounding below 0 is clipped. Without `by_opacity` the gradient grows as 1 / o, and a
    ray of an opacity below 1e-6 counts as empty.
    """
    entropy = jnp.maximum(x_log_x(weights.sum(-1)) - x_log_x(weights).sum(-1), 0.0)
    return entropy if by_opacity else safe_divide(entropy, opacity_or_empty(weights))
