"""Histograms along rays: samples where the weight is, and the losses of Mip-NeRF 360 (Eqs 13-15).

A histogram is `edges` [..., N + 1], rising, and `weights` [..., N] >= 0 of the intervals between.
"""

import jax
import jax.numpy as jnp

from bavs_jax.rendering.compositing import exclusive_cumsum

PADDING = 0.01  # weight that each interval gets on top, so that none is never looked at again
TINY = 1e-7  # of a weight; keeps the division in the interlevel loss finite


def stratified_quantiles(key: jax.Array | None, num_rays: int, num: int) -> jax.Array:
    """`(i + jitter) / num` for i = 0 .. num - 1, [R, num] in [0, 1).

    One jitter a ray keeps the places evenly spaced; it is 1/2 where `key` is None.
    """
    jitter = 0.5 if key is None else jax.random.uniform(key, (num_rays, 1))
    return jnp.broadcast_to((jnp.arange(num) + jitter) / num, (num_rays, num))


def sample_histogram(edges: jax.Array, weights: jax.Array, places: jax.Array) -> jax.Array:
    """Inverse CDF: where a share `places` of the weight lies before.

    The CDF rises linearly within an interval.

    Args:
      edges: [..., N + 1] rising.
      weights: [..., N] >= 0, any sum above 0.
      places: [..., M] rising, in [0, 1].

    Returns:
      [..., M] rising, within the edges.

    Numerics: an interval without weight is jumped over, its division guarded.
    """
    share = weights / weights.sum(-1, keepdims=True)
    before = exclusive_cumsum(share)
    # Every place belongs to the last interval that begins at or before it.
    index = (before[..., None, :] <= places[..., :, None]).sum(-1) - 1

    def pick(values):
        return jnp.take_along_axis(values, index, axis=-1)

    width = pick(share)
    along = (places - pick(before)) / jnp.where(width > 0, width, 1.0)
    lower, upper = pick(edges[..., :-1]), pick(edges[..., 1:])
    return lower + jnp.clip(along, 0.0, 1.0) * (upper - lower)


def overlapping_weight(edges: jax.Array, weights: jax.Array, lower, upper) -> jax.Array:
    """Weight of all intervals that overlap [lower, upper], all [..., M] (Mip-NeRF 360, Eq 12)."""
    starts, ends = edges[..., None, :-1], edges[..., None, 1:]
    overlaps = (starts < upper[..., None]) & (ends > lower[..., None])
    return jnp.where(overlaps, weights[..., None, :], 0.0).sum(-1)


def interlevel_loss(proposal_edges, proposal_weights, edges, weights) -> jax.Array:
    """How far a proposal fails to bound the field's histogram (Mip-NeRF 360, Eq 13), [...].

    `mean_i max(0, w_i - bound_i)^2 / w_i`. It teaches the proposal alone: the field's histogram
    counts as given.

    Differs from the paper: a mean over samples, as in the code of Mip-NeRF 360 and of nerfacto,
    whose weights then mean the same; a sum weighs 32 times as much against the proposals' penalty.
    """
    edges, weights = jax.lax.stop_gradient((edges, weights))
    bound = overlapping_weight(proposal_edges, proposal_weights, edges[..., :-1], edges[..., 1:])
    excess = jnp.maximum(weights - bound, 0.0)
    return (jnp.square(excess) / (weights + TINY)).mean(-1)


def distortion_loss(edges: jax.Array, weights: jax.Array) -> jax.Array:
    """Mean distance of two draws from a ray's histogram (Mip-NeRF 360, Eq 15), [...].

    `sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 (s_{i+1} - s_i)`, `m` the middles: low where a
    ray's weight sits in one place, so that it draws in floaters.
    """
    middles = 0.5 * (edges[..., :-1] + edges[..., 1:])
    distance = jnp.abs(middles[..., :, None] - middles[..., None, :])
    between = (weights[..., None] * weights[..., None, :] * distance).sum((-1, -2))
    pixel_ids = (jnp.square(weights) * jnp.diff(edges, axis=-1)).sum(-1)
    return between + pixel_ids / 3.0
