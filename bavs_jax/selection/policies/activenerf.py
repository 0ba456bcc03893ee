"""ActiveNeRF (Pan et al. 2022): its choice and its field, which learns a variance of colour."""

from bavs_jax.selection.policies import activenerf_star

POLICY = activenerf_star.POLICY._replace(
    name="activenerf",
    summary="The k candidates that would remove most of the learned variance; its own field.",
    field_kind="variance",
)
