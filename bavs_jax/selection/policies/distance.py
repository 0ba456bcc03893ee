"""Policies that look at where cameras are, and at no picture."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array
from bavs_jax.selection.distances import masked_nearest, pairwise_distances
from bavs_jax.selection.policy import Policy, ScoreFn

# Between camera centres [N, 3] and [M, 3], [N, M]; the third, [3], is the scene centre.
Distance = Callable[[Array, Array, Array], jax.Array]


def euclidean(a, b, centre):
    """Straight distances [N, M] between camera centres [N, 3] and [M, 3], scene units."""
    del centre
    return pairwise_distances(a, b)


def great_circle(a, b, centre):
    """Angles [N, M] at the scene centre [3] between camera centres [N, 3] and [M, 3], radians.

    `atan2(|a x b|, a . b)`, which is as exact for neighbours as for opposite views; a camera at
    the centre itself, which has no direction, is at the angle 0 from all.
    """
    a, b = (a - centre)[:, None], (b - centre)[None]
    sine = jnp.linalg.norm(jnp.cross(a, b), axis=-1)
    return jnp.arctan2(sine, (a * b).sum(-1))


def nearest_to_chosen(ctx, points, distance: Distance = euclidean):
    """Distance of each point [P, 3] to the nearest training view or pick, [P]."""
    chosen = jnp.concatenate([ctx.training_positions, ctx.positions])
    is_chosen = jnp.concatenate([ctx.is_training_view, ctx.picked])
    return masked_nearest(distance(points, chosen, ctx.centre), is_chosen)


def nearest_chosen(ctx, distance: Distance = euclidean):
    """Distance of each candidate to the nearest training view or pick, [C]."""
    return nearest_to_chosen(ctx, ctx.positions, distance)


def farthest_score(key, ctx, distance: Distance = euclidean):
    """`nearest_chosen`: the next view is the one that is farthest from all (NeRF Director)."""
    del key
    return nearest_chosen(ctx, distance)


def spread_score(key, ctx):
    """Mean over all places j of how much `min_s |x_j - x_s|^2` falls, scene unit^2.

    As in k-means and facility location. Where farthest-view asks for the one place that is
    farthest from all views, and so goes to the rim, this asks what a view does for all places.

    Places are all candidates, `ctx.mask` left aside: what a filter takes away may not be picked,
    but it is still to be looked at.
    """
    del key
    squared = pairwise_distances(ctx.places, ctx.positions) ** 2  # [j, candidate]
    nearest = nearest_to_chosen(ctx, ctx.places)
    nearest = jnp.minimum(nearest**2, squared.max())  # none chosen: all equally far
    return jnp.maximum(nearest[:, None] - squared, 0.0).mean(axis=0)


def _greedy(name: str, summary: str, score_fn: ScoreFn) -> Policy:
    # Distances need no more than `ctx.picked`, so a pick changes nothing else.
    return Policy(name, summary, score_fn, update_fn=lambda ctx, index: ctx, mode="greedy")


POLICIES = (
    _greedy(
        "farthest",
        "Greedily the view whose nearest training or already picked view is farthest.",
        farthest_score,
    ),
    _greedy(
        "farthest_arc",
        "Greedily the view whose nearest chosen view is farthest along the great circle.",
        partial(farthest_score, distance=great_circle),
    ),
    _greedy(
        "spread",
        "Greedily the view that brings all candidates nearest to a chosen view, in the square.",
        spread_score,
    ),
)
