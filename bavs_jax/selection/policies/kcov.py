import numpy as np
from bavs_jax.selection.distances import masked_nearest, pairwise_distances
from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.policy import Policy
import jax.numpy as jnp
def score(key, ctx):
    del key
    chosen = jnp.concatenate([ctx.training_positions, ctx.positions])
    is_chosen = jnp.concatenate([ctx.is_training_view, ctx.picked])
    far = np.asarray(masked_nearest(pairwise_distances(ctx.positions, chosen), is_chosen))
    d2 = np.asarray(pairwise_distances(ctx.positions, ctx.positions)) ** 2
    gain = np.maximum(far[:, None] ** 2 - d2, 0.0).mean(0)
    cov = score_candidates(ctx, lambda i: require(ctx, "mean_uncertainty_fn")(i, ctx.picked))
    return gain * cov
POLICY = Policy(name="kcov", summary="try", score_fn=score, update_fn=lambda ctx, i: ctx, needs=frozenset({"mean_uncertainty_fn"}), mode="greedy", uncertainty="coverage")
