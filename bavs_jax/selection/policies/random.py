"""Uniform choice without replacement: what every other policy has to beat."""

import jax

from bavs_jax.selection.policy import Policy


def score(key, ctx):
    """One uniform draw in [0, 1) per candidate, from its view id alone, so order never matters."""

    def draw(view_id):
        return jax.random.uniform(jax.random.fold_in(key, view_id))

    return jax.vmap(draw)(ctx.view_ids)


POLICY = Policy(
    name="random",
    summary="Uniform without replacement.",
    score_fn=score,
    stochastic=True,
)
