"""Oracle: the views whose renders are truly worst. A reference, for it looks at the answers."""

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.policy import Policy


def score(key, ctx):
    """Mean squared error of each candidate's render against its photo."""
    del key
    return score_candidates(ctx, require(ctx, "true_error_fn"))


POLICY = Policy(
    name="oracle",
    summary="The k candidates of largest true error; needs their photos, so a reference only.",
    score_fn=score,
    needs=frozenset({"true_error_fn"}),
)
