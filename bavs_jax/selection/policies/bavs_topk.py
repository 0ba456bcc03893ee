"""BavsNeRF's score (Eq 15) without its batch policy: the k most uncertain renders."""

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.policy import Policy


def score(key, ctx):
    """Mean over the pixels of each candidate's rendered uncertainty (Eq 15)."""
    del key
    mean_uncertainty = require(ctx, "mean_uncertainty_fn")
    return score_candidates(ctx, lambda indices: mean_uncertainty(indices, ctx.picked))


POLICY = Policy(
    name="bavs_topk",
    summary="The k candidates of largest mean rendered uncertainty (Eq 15), no distance filter.",
    score_fn=score,
    needs=frozenset({"mean_uncertainty_fn"}),
)
