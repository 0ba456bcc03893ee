"""CF-NeRF (Shen et al. 2022): the views on which draws of its distribution differ most.

The authors use their uncertainty for maps alone; the choice of views by it is ours.
"""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="cf_nerf",
    summary="The k candidates of largest variance over draws of conditional flows.",
    uncertainty="cf_nerf",
)
