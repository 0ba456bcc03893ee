"""Spread times directional information.

Ours, and the soft form of the paper's batch policy (Fig 5, Eq 15). Where that first drops what is
near and then asks for uncertainty alone, every view is asked for both: what it does for all places
one could look from (`spread`), and what its rays would tell about sides of the scene that no view
has looked at (`directional`). Distance needs no field and leads while the field is poor.
"""

import numpy as np

from bavs_jax.selection.policies import directional, spread


def score(key, ctx):
    """The product of both scores; a view that meets nothing, or repeats a chosen one, gains 0."""
    return np.asarray(spread.score(key, ctx)) * directional.score(key, ctx)


POLICY = directional.POLICY._replace(
    name="bavs_spread",
    summary="Greedily the view of largest spread times directional information.",
    score_fn=score,
)
