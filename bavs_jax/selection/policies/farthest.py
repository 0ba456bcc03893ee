"""Farthest-view sampling (NeRF Director): the view whose nearest chosen view is farthest."""

import jax.numpy as jnp

from bavs_jax.selection.distances import masked_nearest, pairwise_distances
from bavs_jax.selection.policy import Policy


def euclidean(a, b, centre):
    """Straight distances [N, M] between camera centres [N, 3] and [M, 3], scene units."""
    del centre
    return pairwise_distances(a, b)


def nearest_chosen(ctx, distance=euclidean):
    """Distance of each candidate to the nearest training view or pick, [C]."""
    chosen = jnp.concatenate([ctx.training_positions, ctx.positions])
    is_chosen = jnp.concatenate([ctx.is_training_view, ctx.picked])
    return masked_nearest(distance(ctx.positions, chosen, ctx.centre), is_chosen)


def make_farthest(*, name="farthest", summary, distance=euclidean) -> Policy:
    """Greedy farthest-view policy under `distance(a [N, 3], b [M, 3], centre [3]) -> [N, M]`."""

    def score(key, ctx):
        del key
        return nearest_chosen(ctx, distance)

    return Policy(
        name=name,
        summary=summary,
        score_fn=score,
        update_fn=lambda ctx, index: ctx,  # distances need no more than `ctx.picked`
        mode="greedy",
    )


POLICY = make_farthest(
    summary="Greedily the view whose nearest training or already picked view is farthest."
)
