
from functools import partial
from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.directional import gains, add, first
from bavs_jax.selection.policy import Policy
_memo = {}
def start(ctx):
    d = require(ctx, "directional")
    if d.done: return d
    if _memo.get("key") is not d.looks:
        _memo["key"] = d.looks; _memo["value"] = first(d, 4.0)
    return _memo["value"]
def score(key, ctx):
    del key
    return score_candidates(ctx, partial(gains, start(ctx), power=4.0, prior=7.6e-10))
def update(ctx, index):
    return ctx.replace(directional=add(start(ctx), index, 4.0))
POLICY = Policy(name="dir4", summary="try", score_fn=score, update_fn=update, needs=frozenset({"directional"}), mode="greedy")
