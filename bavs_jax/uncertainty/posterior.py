"""The Laplace posterior of the deformation offsets (Eqs 6-9, 13)."""

from __future__ import annotations

import jax

# Curvature of the mean loss per unit of the raw sum: H = (factor / R) jac_sq_sum + 2 lambda.
_FACTORS = {"eq13": 2.0, "eq11": 4.0, "empirical": 4.0}


def default_prior_weight(log2_cells: int) -> float:
    """`lambda = 1e-4 / (2^L)^3`: the weight in `loss + lambda |theta|^2`."""
    return 1e-4 / (2**log2_cells) ** 3


def posterior_precision(
    jac_sq_sum: jax.Array, *, num_rays, prior_weight, weighting: str = "eq13"
) -> jax.Array:
    """Curvature of the negative log posterior, `H = (f / R) jac_sq_sum + 2 lambda` (Eq 13).

    `f` is 2 for `eq13` and 4 for `eq11` and `empirical`.

    Args:
      jac_sq_sum: [G, 3] raw sum over rays, >= 0.
      num_rays: R, the rays of the first round. It stays fixed for a run, and for candidates:
        a mean over a growing set would widen the posterior where only old views look.
      prior_weight: lambda > 0.
      weighting: how `jac_sq_sum` was weighted.

    Returns:
      [G, 3] > 0, 1 / scene unit^2.

    Differs from the paper: Eqs 6, 9, 10 and 13 carry sign slips; H here is positive.
    """
    return (_FACTORS[weighting] / num_rays) * jac_sq_sum + 2.0 * prior_weight


def laplace_variance(precision: jax.Array) -> jax.Array:
    """Variance of each offset, `1 / H` (Eq 9 with a diagonal H), scene unit^2.

    A vertex that no ray has seen keeps the prior's `1 / (2 lambda)`.
    """
    return 1.0 / precision


def bayesrays_vertex_variance(jac_sq_sum: jax.Array, *, num_rays, prior_weight) -> jax.Array:
    """Bayes' Rays' vertex value, `U = 1 / (sum_d jac_sq_sum_d / R + lambda)`, [G].

    Differs from the Laplace variance: axes are summed before the inversion, and there is no
    factor of 2, as in the code its authors published.
    """
    return 1.0 / (jac_sq_sum.sum(-1) / num_rays + prior_weight)
