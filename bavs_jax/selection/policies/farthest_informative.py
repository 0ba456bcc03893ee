"""Farthest-view sampling weighted by directional information.

Ours, and the soft form of the paper's batch policy (Fig 5, Eq 15): where that drops what is near
and then asks for uncertainty alone, this asks for both of every view. Distance needs no field and
leads while the field is poor; information leads among views that are about equally far.
"""

import numpy as np

from bavs_jax.selection.policies import directional
from bavs_jax.selection.policies.farthest import nearest_chosen


def score(key, ctx):
    """Distance to the nearest chosen view times what the view would tell (`directional`)."""
    return np.asarray(nearest_chosen(ctx)) * directional.score(key, ctx)


POLICY = directional.POLICY._replace(
    name="farthest_informative",
    summary="Greedily the view of largest distance to the chosen ones times what it would tell.",
    score_fn=score,
)
