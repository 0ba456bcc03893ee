"""Coverage (CONVERGE): greedily the view that looks at surfaces from the newest directions."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="bavsnov",
    summary="Greedily the view that sees most surface from directions that are new.",
    uncertainty="novel_laplace",
    update_fn=lambda ctx, index: ctx,  # the model is conditioned on `ctx.picked`
    mode="greedy",
)
