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


BY_IMAGE = Policy(
    name="",
    summary="",
    score_fn=mean_score,
    needs=frozenset({"mean_uncertainty_fn"}),
)
ACTIVENERF_STAR = BY_IMAGE._replace(
    name="activenerf_star",
    summary="ActiveNeRF's choice, from a field trained beside; the reconstruction is ours.",
    uncertainty="learned_variance",
    measure="gain",
)
# BavsNeRF. The paper leaves the scale of sigma open: its mean counts what is least known, that of
# its logarithm, as pictures show it, counts what is known a little less than the rest.
BAVS = BY_IMAGE._replace(
    name="bavs",
    summary="The paper's batch policy: max-min distance filter (Fig 5), then mean sigma (Eq 15).",
    measure="sigma",
    distance_filter=True,
)

POLICIES = (
    BAVS,
    BAVS._replace(
        name="bavs_log",
        summary="As bavs, by the mean of log sigma, as pictures show it.",
        measure="uncertainty",
    ),
    BAVS._replace(
        name="bavs_topk",
        summary="The k candidates of largest mean sigma (Eq 15), no distance filter.",
        distance_filter=False,
    ),
    # ActiveNeRF (Pan et al. 2022): its choice and its field, which learns a variance of colour.
    ACTIVENERF_STAR._replace(
        name="activenerf",
        summary="The k candidates that would remove most of the learned variance; its own field.",
        field_kind="variance",
    ),
    ACTIVENERF_STAR,
    # Shen et al. 2022 use their uncertainty for maps alone; the choice of views by it is ours.
    BY_IMAGE._replace(
        name="cf_nerf",
        summary="The k candidates of largest variance over draws of conditional flows.",
        uncertainty="cf_nerf",
    ),
    # CONVERGE.
    BY_IMAGE._replace(
        name="coverage",
        summary="Greedily the view that sees most surface from directions that are new.",
        uncertainty="coverage",
        update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
        mode="greedy",
    ),
    # After SBV, CONVERGE and AGILE.
    BY_IMAGE._replace(
        name="surface_coverage",
        summary="Greedily, of the views far from all chosen ones, that of most surface from new "
        "directions and most unseen space.",
        score_fn=far_mean_score,
        uncertainty="surface_coverage",
        update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
        mode="greedy",
    ),
    # Density-aware ensembles (Sünderhauf et al. 2022).
    BY_IMAGE._replace(
        name="ensemble",
        summary="The k candidates on which several trained fields disagree most.",
        uncertainty="ensemble",
    ),
    # Lee et al. 2022: how sure rays are of where they end.
    BY_IMAGE._replace(
        name="entropy",
        summary="The k candidates of largest mean ray entropy.",
        uncertainty="entropy",
    ),
    # WarpRF (Safadoust et al. 2025).
    BY_IMAGE._replace(
        name="warp",
        summary="The k candidates whose renders agree least with training views warped into them.",
        uncertainty="warp",
    ),
)
