"""Policies by what a view would tell about declared target views, not about parameters."""

from collections.abc import Callable
from functools import partial

import numpy as np

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.directional import add_look
from bavs_jax.selection.gaps import add_view, gap_gains
from bavs_jax.selection.policies.curvature import directional_score
from bavs_jax.selection.policies.distance import spread_score
from bavs_jax.selection.policy import Policy
from bavs_jax.selection.targets import TargetInformation, linear_gain, log_gain

TargetGain = Callable[[TargetInformation, np.ndarray], np.ndarray]


def target_score(key, ctx, *, gain: TargetGain = log_gain):
    """What each candidate would tell about the targets (`selection/targets.py`).

    Ours. I-optimal design and the expected predictive information gain on the paper's deformation
    grid, in which a look counts for a target as far as it came from the same side.
    """
    del key
    return score_candidates(ctx, partial(gain, require(ctx, "targets")))


def target_spread_score(key, ctx):
    """`spread` times `target_information_log`.

    Ours. From few views the curvature is that of fog. Distance needs no field and leads then, as in
    `bavs_spread`.
    """
    return np.asarray(spread_score(key, ctx)) * target_score(key, ctx)


def target_gaps_score(key, ctx):
    """By how much a view lowers the predicted log error of target views (`selection/gaps.py`).

    Ours. It asks from how near by, in angle, the pixels of target views are seen, and by whom; the
    field says only where surfaces are.
    """
    del key
    return score_candidates(ctx, partial(gap_gains, require(ctx, "gaps")))


def bavs_gaps_score(key, ctx):
    """`target_gaps` times `directional`: what a view closes, and what the field learns by it.

    Ours. Gaps know no more of the field than where its surfaces are; the curvature says how much
    there is to learn of them from this side.
    """
    return target_gaps_score(key, ctx) * directional_score(key, ctx)


def add_gaps_and_look(ctx, index):
    """A picked view closes gaps, and its curvature joins the looks."""
    information = add_look(require(ctx, "directional"), index)
    return ctx.replace(gaps=add_view(require(ctx, "gaps"), index), directional=information)


TARGET_INFORMATION = Policy(
    name="target_information",
    summary="Greedily the view that lowers the predicted colour variance of target views most.",
    score_fn=partial(target_score, gain=linear_gain),
    update_fn=lambda ctx, index: ctx.replace(targets=add_look(require(ctx, "targets"), index)),
    needs=frozenset({"targets"}),
    mode="greedy",
)

POLICIES = (
    TARGET_INFORMATION,
    TARGET_INFORMATION._replace(
        name="target_information_log",
        summary="Greedily the view of largest information about target views, view by view.",
        score_fn=target_score,
    ),
    TARGET_INFORMATION._replace(
        name="target_spread",
        summary="Greedily the view of largest spread times information about target views.",
        score_fn=target_spread_score,
    ),
    Policy(
        name="target_gaps",
        summary="Greedily the view that closes most of the angular gaps of target views.",
        score_fn=target_gaps_score,
        update_fn=lambda ctx, index: ctx.replace(gaps=add_view(require(ctx, "gaps"), index)),
        needs=frozenset({"gaps"}),
        mode="greedy",
    ),
    Policy(
        name="bavs_gaps",
        summary="Greedily the view that closes most angular gaps, times directional information.",
        score_fn=bavs_gaps_score,
        update_fn=add_gaps_and_look,
        needs=frozenset({"gaps", "directional"}),
        mode="greedy",
    ),
)
