"""Density-aware ensembles (Sünderhauf et al. 2022): the views on which fields disagree most."""

from bavs_jax.selection.policies import bavs_topk

POLICY = bavs_topk.POLICY._replace(
    name="ensemble",
    summary="The k candidates on which several trained fields disagree most.",
    uncertainty="ensemble",
)
