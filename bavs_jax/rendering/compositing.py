"""Volume rendering (Eqs 2-3): densities along rays to weights, and weights to pixels."""

import jax
import jax.numpy as jnp

from bavs_jax.numerics import safe_divide


def exclusive_cumsum(x: jax.Array) -> jax.Array:
    """Sum of all earlier entries along the last axis, [..., S].

    Written as a product with a triangular matrix: on a CPU it runs several times faster than a
    scan for the few samples of a ray, and sums positive terms without any subtraction.
    """
    size = x.shape[-1]
    earlier = jnp.triu(jnp.ones((size, size), x.dtype), k=1)
    return jnp.matmul(x, earlier, precision=jax.lax.Precision.HIGHEST)


def transmittance(density: jax.Array, deltas: jax.Array) -> jax.Array:
    """Light that reaches each sample (Eq 3): `T_i = exp(-sum_{j<i} sigma_j delta_j)`, [..., S].

    Arguments as of `render_weights`.
    """
    return jnp.exp(-exclusive_cumsum(density * deltas))


def render_weights(density: jax.Array, deltas: jax.Array) -> jax.Array:
    """Share of the pixel that each sample makes up (Eq 3): `w_i = T_i (1 - exp(-sigma_i delta_i))`.

    T is the `transmittance`.

    Args:
      density: [..., S] >= 0, 1 / scene unit.
      deltas: [..., S] >= 0, scene units; 0 makes a slot empty.

    Returns:
      weights [..., S] in [0, 1], summing to at most 1 (the opacity).

    Numerics: `-expm1(-x)` keeps small opacities exact.
    """
    return transmittance(density, deltas) * -jnp.expm1(-density * deltas)


def composite(weights: jax.Array, values: jax.Array, background) -> jax.Array:
    """Weighted sum over samples, over a background: `sum_i w_i v_i + (1 - sum_i w_i) background`.

    Args:
      weights: [..., S].
      values: [..., S, C].
      background: broadcastable to the result [..., C].
    """
    opacity = weights.sum(-1)
    return (weights[..., None] * values).sum(-2) + (1.0 - opacity)[..., None] * background


def composite_colour(weights: jax.Array, rgb: jax.Array, background) -> jax.Array:
    """Colours of rays (Eq 2), [..., 3].

    Args:
      weights: [..., S].
      rgb: [..., S, 3].
      background: [3] or [..., 3] colour behind everything. None lets the last sample of a ray
        stand for all that lies behind it, as in nerfacto: for unbounded scenes, where a ray
        always ends somewhere. Needs samples that fill their slots.
    """
    return composite(weights, rgb, rgb[..., -1, :] if background is None else background)


def rendered_variance(weights: jax.Array, variance: jax.Array) -> jax.Array:
    """Variance of a ray's colour from independent ones of its samples: `sum_i w_i^2 beta_i`, [...].

    0 on a ray that meets nothing.
    """
    return (jnp.square(weights) * variance).sum(-1)


def expected_depth(weights: jax.Array, t_mids: jax.Array) -> jax.Array:
    """Mean distance of what is seen, `sum_i w_i t_i / sum_i w_i`, scene units; 0 on empty rays."""
    return safe_divide((weights * t_mids).sum(-1), weights.sum(-1))
