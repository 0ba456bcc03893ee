"""The Laplace posterior of the deformation offsets (Eqs 6-9, 13)."""

import jax
import jax.numpy as jnp

NOISE_VARIANCE = 1e-3  # squared colour error per channel that a field leaves on its photos: 30 dB

# Curvature of the mean loss per unit of the raw sum: H = (factor / R) jac_sq_sum + 2 lambda.
_FACTORS = {"gauss_newton": 2.0, "residual_weighted": 4.0, "empirical_fisher": 4.0}


def default_prior_weight(log2_cells: int) -> float:
    """`lambda = 1e-4 / (2^L)^3`: the weight in `loss + lambda |theta|^2`, theta in `offset_unit`s.

    Differs from the paper, whose theta is in whatever unit a scene comes in.
    """
    return 1e-4 / (2**log2_cells) ** 3


def curvature_factor(num_rays, weighting: str = "gauss_newton"):
    """`f / R`, by which the raw sum over rays enters the precision (Eq 13)."""
    return _FACTORS[weighting] / num_rays


def prior_precision(prior_weight):
    """`2 lambda`, the precision where no ray has looked, 1 / scene unit^2."""
    return 2.0 * prior_weight


def posterior_precision(
    jac_sq_sum: jax.Array, *, num_rays, prior_weight, weighting: str = "gauss_newton"
) -> jax.Array:
    """Curvature of the negative log posterior, `H = (f / R) jac_sq_sum + 2 lambda` (Eq 13).

    H is in 1 / scene unit^2; `f` is 2 for `gauss_newton` and 4 for the other two
    weightings.

    Args:
      jac_sq_sum: [G, 3] raw sum over rays, >= 0.
      num_rays: R, the rays of the first round. It stays fixed for a run, and for candidates:
        a mean over a growing set would widen the posterior where only old views look.
      prior_weight: lambda > 0, 1 / scene unit^2.
      weighting: how `jac_sq_sum` was weighted.

    Differs from the paper: Eqs 6, 9, 10 and 13 carry sign slips; H here is positive.
    """
    return curvature_factor(num_rays, weighting) * jac_sq_sum + prior_precision(prior_weight)


def laplace_variance(precision: jax.Array) -> jax.Array:
    """Variance of each offset, `1 / H` (Eq 9 with a diagonal H), scene unit^2.

    A vertex that no ray has seen keeps the prior's `1 / (2 lambda)`.
    """
    return 1.0 / precision


def offset_variance(
    jac_sq_sum: jax.Array, offset_std, *, noise_variance: float = NOISE_VARIANCE
) -> jax.Array:
    """Variance of each offset in its own units, `1 / (jac_sq_sum / s^2 + 1 / std^2)`, scene unit^2.

    The posterior of a linear model: colours are known up to a noise of variance s^2, and offsets
    are a priori normal with standard deviation `std`. It is `laplace_variance` of the mean loss,
    times `2 s^2 / R`, with `lambda = s^2 / (R std^2)`. The paper's `lambda` stands for offsets of
    many scene sizes, where nothing is linear any more.

    Args:
      jac_sq_sum: [G, 3] raw sum over the training rays, weighting `gauss_newton`.
      offset_std: `std`, [3] or a number > 0, scene units.
      noise_variance: s^2 > 0, per colour channel.
    """
    return 1.0 / (jac_sq_sum / noise_variance + 1.0 / jnp.square(jnp.asarray(offset_std)))


def bayesrays_vertex_variance(jac_sq_sum: jax.Array, *, num_rays, prior_weight) -> jax.Array:
    """Bayes' Rays' vertex value, `U = 1 / (sum_d jac_sq_sum_d / R + lambda)`, [G].

    Differs from the Laplace variance: axes are summed before the inversion, and there is no
    factor of 2, as in the code its authors published.
    """
    return 1.0 / (jac_sq_sum.sum(-1) / num_rays + prior_weight)
