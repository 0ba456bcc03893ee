"""Policies by the curvature that a view would add: its information about the field."""

from functools import partial

import numpy as np

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.directional import add_look, directional_gains
from bavs_jax.selection.information import (
    Gain,
    add_curvature,
    batch_upper_bound,
    candidate_gains,
    log_det_gain,
    trace_ratio_gain,
)
from bavs_jax.selection.policies.distance import nearest_chosen, spread_score
from bavs_jax.selection.policy import Policy


def information_score(key, ctx, *, gain: Gain):
    """The gain of each candidate's h over the posterior."""
    del key
    information = require(ctx, "information")
    return score_candidates(ctx, partial(candidate_gains, information, gain=gain))


def add_information(ctx, index):
    """A picked view's curvature joins the posterior."""
    return ctx.replace(information=add_curvature(require(ctx, "information"), index))


def information_bound(ctx, selected):
    """Against the best batch of all that could be picked, which is what a filter has left."""
    return batch_upper_bound(require(ctx, "information"), selected, np.flatnonzero(ctx.mask))


def directional_score(key, ctx):
    """`sum log(1 + h / H)`, with H from looks of the same side; 0 for a view of nothing.

    Ours. D-optimal design (POp-GS) on the paper's deformation grid, in which what earlier views
    say about a point counts only as far as they saw it from the same side
    (`selection/directional.py`).
    """
    del key
    information = require(ctx, "directional")
    return score_candidates(ctx, lambda indices: directional_gains(information, indices))


def farthest_informative_score(key, ctx):
    """Distance to the nearest chosen view times what the view would tell (`directional`).

    Ours, and a soft form of the paper's batch policy (Fig 5, Eq 15): where that drops what is near
    and then asks for uncertainty alone, this asks for both of every view. Distance needs no field
    and leads while the field is poor; information leads among views that are about equally far.
    """
    return np.asarray(nearest_chosen(ctx)) * directional_score(key, ctx)


def bavs_spread_score(key, ctx):
    """`spread` times `directional`; a view that meets nothing, or repeats a chosen one, gains 0.

    Ours. As `farthest_informative`, with what a view does for all places in place of its distance.
    """
    return np.asarray(spread_score(key, ctx)) * directional_score(key, ctx)


D_OPTIMAL = Policy(
    name="d_optimal",
    summary="Greedily the view of largest sum log(1 + h / H) over the field's posterior (POp-GS).",
    score_fn=partial(information_score, gain=log_det_gain),
    update_fn=add_information,
    bound_fn=information_bound,
    needs=frozenset({"information"}),
    mode="greedy",
)
DIRECTIONAL = Policy(
    name="directional",
    summary="Greedily the view that tells most about sides that no view has looked at yet.",
    score_fn=directional_score,
    update_fn=lambda ctx, index: ctx.replace(
        directional=add_look(require(ctx, "directional"), index)
    ),
    needs=frozenset({"directional"}),
    mode="greedy",
)

POLICIES = (
    D_OPTIMAL,
    # FisherRF. Differs from the published code: h is summed per channel (theirs squares the sum
    # over channels), and the prior is the same for a single view and within a batch.
    D_OPTIMAL._replace(
        name="fisher_ratio",
        summary="Greedily the view of largest sum h / H over the field's posterior (FisherRF).",
        score_fn=partial(information_score, gain=trace_ratio_gain),
        bound_fn=None,
    ),
    DIRECTIONAL,
    DIRECTIONAL._replace(
        name="farthest_informative",
        summary="Greedily the view of largest distance to the chosen ones times what it would "
        "tell.",
        score_fn=farthest_informative_score,
    ),
    DIRECTIONAL._replace(
        name="bavs_spread",
        summary="Greedily the view of largest spread times directional information.",
        score_fn=bavs_spread_score,
    ),
)
