
from functools import partial
from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.directional import gains, add, first
from bavs_jax.selection.policy import Policy
_memo = {}
def start(ctx):
    d = require(ctx, "directional")
    if d.done: return d
    if _memo.get("key") is not d.looks:
        _memo["key"] = d.looks; _memo["value"] = first(d, 8.0)
    return _memo["value"]
def score(key, ctx):
    del key
    import jax.numpy as jnp, numpy as np
    from bavs_jax.selection.distances import masked_nearest, pairwise_distances
    chosen = jnp.concatenate([ctx.training_positions, ctx.positions])
    is_chosen = jnp.concatenate([ctx.is_training_view, ctx.picked])
    far = np.asarray(masked_nearest(pairwise_distances(ctx.positions, chosen), is_chosen))
    return far * score_candidates(ctx, partial(gains, start(ctx), power=8.0, prior=7.6e-10))
def update(ctx, index):
    return ctx.replace(directional=add(start(ctx), index, 8.0))
POLICY = Policy(name="fardir8", summary="try", score_fn=score, update_fn=update, needs=frozenset({"directional"}), mode="greedy")
