"""ActiveNeRF* of the paper: ActiveNeRF's choice with our reconstruction."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="activenerf_star",
    summary="ActiveNeRF's choice, from a field trained beside; the reconstruction is ours.",
    uncertainty="learned_variance",
    measure="gain",
)
