"""What every other policy has to beat, and a reference that looks at the answers."""

import jax

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.distances import uniform_ranks
from bavs_jax.selection.policy import Policy


def random_score(key, ctx):
    """One uniform draw in [0, 1) per candidate, from its view id alone, so order never matters."""

    def draw(view_id):
        return jax.random.uniform(jax.random.fold_in(key, view_id))

    return jax.vmap(draw)(ctx.view_ids)


_ranks_fn = jax.jit(uniform_ranks)  # compiled once per number of candidates


def uniform_score(key, ctx):
    """Minus each candidate's place in the fixed order.

    The order is of all candidates, `ctx.mask` left aside. With a dataset these are the whole pool
    in every round, so that the order never depends on what has been taken; views that are only
    tested on, which `ctx.training_positions` may hold too, have no place in it. Candidates that
    are drawn anew are spread among themselves.
    """
    del key
    return -_ranks_fn(ctx.positions, ctx.view_ids)


def oracle_score(key, ctx):
    """Mean squared error of each candidate's render against its photo."""
    del key
    return score_candidates(ctx, require(ctx, "true_error_fn"))


POLICIES = (
    Policy(
        name="random",
        summary="Uniform without replacement.",
        score_fn=random_score,
        stochastic=True,
    ),
    Policy(
        name="uniform",
        summary="Evenly spaced: the next views of a farthest-point order of the whole pool.",
        score_fn=uniform_score,
    ),
    Policy(
        name="oracle",
        summary="The k candidates of largest true error; needs their photos, so a reference only.",
        score_fn=oracle_score,
        needs=frozenset({"true_error_fn"}),
    ),
)
