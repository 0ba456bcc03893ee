"""Directional information: greedily the view that tells most about sides not yet looked at.

Ours. D-optimal design (POp-GS) on the paper's deformation grid, in which what earlier views say
about a point counts only as far as they saw it from the same side (`selection/directional.py`).
"""

from bavs_jax.selection.context import require, score_candidates
from bavs_jax.selection.directional import add_look, directional_gains
from bavs_jax.selection.policy import Policy


def score(key, ctx):
    """`sum log(1 + h / H)`, with H from looks of the same side; 0 for a view of nothing."""
    del key
    information = require(ctx, "directional")
    return score_candidates(ctx, lambda indices: directional_gains(information, indices))


def update(ctx, index):
    return ctx.replace(directional=add_look(require(ctx, "directional"), index))


POLICY = Policy(
    name="directional",
    summary="Greedily the view that tells most about sides that no view has looked at yet.",
    score_fn=score,
    update_fn=update,
    needs=frozenset({"directional"}),
    mode="greedy",
)
