"""ActiveNeRF (Pan et al. 2022): variance of colour, and how much of it a view would remove."""

from __future__ import annotations

import jax

from bavs_jax.numerics import opacity_or_empty, safe_divide


def variance_reduction(
    weights: jax.Array, beta: jax.Array, *, by_opacity: bool = True
) -> jax.Array:
    """Variance along a ray that its observation would remove.

    The observation has the variance U of the rendered colour (`rendered_variance`); by Bayes' rule
    sample i keeps `1 / (1 / beta_i + w_i^2 / U)`, so the gain is

        sum_i beta_i - sum_i 1 / (1 / beta_i + w_i^2 / U)
            = sum_i beta_i^2 w_i^2 / (U + beta_i w_i^2).

    U scales with the square of the weights, hence the formula makes no difference between a wall
    and the thinnest fog. Times the ray's opacity (`by_opacity`) it is as published for rays that
    end surely, and fades out with what is there.

    Args:
      weights: [..., S] rendering weights >= 0, summing to at most 1.
      beta: [..., S] > 0, colour unit^2.
      by_opacity: False leaves the factor out, as published.

    Returns:
      [...] >= 0, colour unit^2; 0 on a ray that meets nothing.

    Numerics: the second form has no difference of near numbers, and weights enter relative to
    their sum, so that small ones do not vanish when they are squared. A ray of an opacity below
    1e-6 counts as empty.
    """
    opacity = opacity_or_empty(weights)
    share = safe_divide(weights, opacity[..., None])
    information = share * share * beta
    variance = information.sum(-1)[..., None]
    gain = safe_divide(beta * information, variance + information).sum(-1)
    return opacity * gain if by_opacity else gain
