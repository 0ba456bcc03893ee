"""Policies by the mean of a rendered image of uncertainty: the paper's own, and its rivals."""

import math

import numpy as np

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.distances import far_from_chosen
from bavs_jax.selection.policies.distance import nearest_chosen
from bavs_jax.selection.policy import Policy

FAR_SHARE = 0.25  # of the candidates, those among which `surface_coverage` chooses


def mean_score(key, ctx):
    """Mean over the pixels of each candidate's rendered uncertainty (Eq 15)."""
    del key
    mean_uncertainty = require(ctx, "mean_uncertainty_fn")
    return score_candidates(ctx, lambda indices: mean_uncertainty(indices, ctx.picked))


def far_mean_score(key, ctx):
    """`mean_score`, in [0, 1], among the candidates that are farthest from all chosen views.

    They are those that `far_from_chosen` leaves of a quarter of all. The others are not looked at
    and score -1, below any view of nothing.
    """
    mask = np.asarray(ctx.mask)
    far = far_from_chosen(nearest_chosen(ctx), mask, math.ceil(FAR_SHARE * mask.sum()))
    scores = np.full(len(mask), np.nan, np.float32)
    scores[mask] = -1.0
    scores[far] = mean_score(key, ctx.replace(mask=far))[far]
    return scores


BAVS_TOPK = Policy(
    name="bavs_topk",
    summary="The k candidates of largest mean rendered uncertainty (Eq 15), no distance filter.",
    score_fn=mean_score,
    needs=frozenset({"mean_uncertainty_fn"}),
)
ACTIVENERF_STAR = BAVS_TOPK._replace(
    name="activenerf_star",
    summary="ActiveNeRF's choice, from a field trained beside; the reconstruction is ours.",
    uncertainty="learned_variance",
    measure="gain",
)

POLICIES = (
    # BavsNeRF: among what the max-min distance filter leaves.
    BAVS_TOPK._replace(
        name="bavs",
        summary="The paper's batch policy: max-min distance filter (Fig 5), then mean uncertainty.",
        distance_filter=True,
    ),
    BAVS_TOPK,
    # ActiveNeRF (Pan et al. 2022): its choice and its field, which learns a variance of colour.
    ACTIVENERF_STAR._replace(
        name="activenerf",
        summary="The k candidates that would remove most of the learned variance; its own field.",
        field_kind="variance",
    ),
    ACTIVENERF_STAR,
    # Shen et al. 2022 use their uncertainty for maps alone; the choice of views by it is ours.
    BAVS_TOPK._replace(
        name="cf_nerf",
        summary="The k candidates of largest variance over draws of conditional flows.",
        uncertainty="cf_nerf",
    ),
    # CONVERGE.
    BAVS_TOPK._replace(
        name="coverage",
        summary="Greedily the view that sees most surface from directions that are new.",
        uncertainty="coverage",
        update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
        mode="greedy",
    ),
    # After SBV, CONVERGE and AGILE.
    BAVS_TOPK._replace(
        name="surface_coverage",
        summary="Greedily, of the views far from all chosen ones, that of most surface from new "
        "directions and most unseen space.",
        score_fn=far_mean_score,
        uncertainty="surface_coverage",
        update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
        mode="greedy",
    ),
    # Density-aware ensembles (Sünderhauf et al. 2022).
    BAVS_TOPK._replace(
        name="ensemble",
        summary="The k candidates on which several trained fields disagree most.",
        uncertainty="ensemble",
    ),
    # Lee et al. 2022: how sure rays are of where they end.
    BAVS_TOPK._replace(
        name="entropy",
        summary="The k candidates of largest mean ray entropy.",
        uncertainty="entropy",
    ),
    # WarpRF (Safadoust et al. 2025).
    BAVS_TOPK._replace(
        name="warp",
        summary="The k candidates whose renders agree least with training views warped into them.",
        uncertainty="warp",
    ),
)
