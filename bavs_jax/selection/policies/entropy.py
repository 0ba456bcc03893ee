"""Ray entropy (Lee et al. 2022): the views whose rays are least sure of where they end."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="entropy",
    summary="The k candidates of largest mean ray entropy.",
    uncertainty="entropy",
)
