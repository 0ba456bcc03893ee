"""BavsNeRF: the most uncertain renders among what the max-min distance filter leaves (Fig 5)."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="bavs",
    summary="The paper's batch policy: max-min distance filter (Fig 5), then mean uncertainty.",
    distance_filter=True,
)
