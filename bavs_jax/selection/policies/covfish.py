
import numpy as np
from functools import partial
from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.information import add_curvature, candidate_gains, log_det_gain, trace_ratio_gain
from bavs_jax.selection.policy import Policy
def score(key, ctx):
    del key
    info = score_candidates(ctx, partial(candidate_gains, require(ctx, "information"), gain=trace_ratio_gain))
    cov = score_candidates(ctx, lambda i: require(ctx, "mean_uncertainty_fn")(i, ctx.picked))
    return cov*info
def update(ctx, index):
    return ctx.replace(information=add_curvature(require(ctx, "information"), index))
POLICY = Policy(name="covfish", summary="try", score_fn=score, update_fn=update, needs=frozenset({"information","mean_uncertainty_fn"}), mode="greedy", uncertainty="coverage")
