import numpy as np
from bavs_jax.selection.distances import pairwise_distances, masked_nearest
from bavs_jax.selection.policy import Policy
import jax.numpy as jnp
def score(key, ctx):
    del key
    chosen = jnp.concatenate([ctx.training_positions, ctx.positions])
    is_chosen = jnp.concatenate([ctx.is_training_view, ctx.picked])
    now = masked_nearest(pairwise_distances(ctx.positions, chosen), is_chosen)
    d = pairwise_distances(ctx.positions, ctx.positions)
    return -(jnp.minimum(now[:, None], d) ** 2).mean(0)
POLICY = Policy(name="kmed2", summary="try", score_fn=score, update_fn=lambda ctx, i: ctx, mode="greedy")
