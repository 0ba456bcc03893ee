"""Spread: the view that brings all candidates nearest to a chosen one (k-means, facility location).

Where farthest-view asks for the one place that is farthest from all views, and so goes to the rim,
this asks what a view does for all places at once.
"""

import jax.numpy as jnp

from bavs_jax.selection.distances import pairwise_distances
from bavs_jax.selection.policies.farthest import nearest_chosen
from bavs_jax.selection.policy import Policy


def score(key, ctx):
    """Mean over all candidates j of how much `min_s |x_j - x_s|^2` falls, scene unit^2.

    Over all of `ctx.positions`, `ctx.mask` left aside: what a filter takes away may not be picked,
    but it is still to be looked at.
    """
    del key
    squared = pairwise_distances(ctx.positions, ctx.positions) ** 2  # [j, candidate]
    nearest = jnp.minimum(nearest_chosen(ctx) ** 2, squared.max())  # none chosen: all equally far
    return jnp.maximum(nearest[:, None] - squared, 0.0).mean(axis=0)


POLICY = Policy(
    name="spread",
    summary="Greedily the view that brings all candidates nearest to a chosen view, in the square.",
    score_fn=score,
    update_fn=lambda ctx, index: ctx,  # distances need no more than `ctx.picked`
    mode="greedy",
)
