"""Coverage (CONVERGE): greedily the view that looks at surfaces from the newest directions."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="coverage",
    summary="Greedily the view that sees most surface from directions that are new.",
    uncertainty="coverage",
    update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
    mode="greedy",
)
