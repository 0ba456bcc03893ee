"""D-optimal design (POp-GS): the views that shrink the posterior's volume most."""

from functools import partial

import numpy as np

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.information import (
    add_curvature,
    batch_upper_bound,
    candidate_gains,
    log_det_gain,
)
from bavs_jax.selection.policy import Policy


def make_informative(*, name, summary, gain) -> Policy:
    """Greedy policy under a gain `(h [n, 3], precision [n, 3]) -> []` (see `information.py`)."""

    def score(key, ctx):
        del key
        information = require(ctx, "information")
        return score_candidates(ctx, partial(candidate_gains, information, gain=gain))

    def update(ctx, index):
        return ctx.replace(information=add_curvature(require(ctx, "information"), index))

    return Policy(
        name=name,
        summary=summary,
        score_fn=score,
        update_fn=update,
        needs=frozenset({"information"}),
        mode="greedy",
    )


def bound(ctx, selected):
    """Against the best batch of all that could be picked, which is what a filter has left."""
    return batch_upper_bound(require(ctx, "information"), selected, np.flatnonzero(ctx.mask))


POLICY = make_informative(
    name="d_optimal",
    summary="Greedily the view of largest sum log(1 + h / H) over the field's posterior (POp-GS).",
    gain=log_det_gain,
)._replace(bound_fn=bound)
