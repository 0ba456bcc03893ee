"""WarpRF (Safadoust et al. 2025): the views that agree least with warped training views."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="warp",
    summary="The k candidates whose renders agree least with training views warped into them.",
    uncertainty="warp",
)
