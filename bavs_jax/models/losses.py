"""Losses: colour errors, and likelihoods under a variance and under draws of fields."""

import jax
import jax.numpy as jnp

from bavs_jax.numerics import safe_divide


def colour_loss(rgb: jax.Array, target: jax.Array, ray_weight: jax.Array) -> jax.Array:
    """Mean squared colour error over rays and channels (Eq 5), []; 0 if every weight is 0.

    Args:
      rgb, target: [R, 3] in [0, 1].
      ray_weight: [R] >= 0; 0 leaves a ray out of the mean.

    Differs from the paper: a mean over channels, not a sum, so that PSNR is `-10 log10` of it.
    """
    return weighted_mean(jnp.square(rgb - target).mean(-1), ray_weight)


def gaussian_nll(rgb: jax.Array, target: jax.Array, variance: jax.Array, ray_weight: jax.Array):
    """Negative log-likelihood of colours under a variance of their own, up to a constant, [].

    `mean_rc (C - C*)^2 / (2 U) + mean_r log(U) / 2`, the mean over rays and channels.

    Args:
      rgb, target: [R, 3] in [0, 1].
      variance: U [R] > 0, of one channel.
      ray_weight: [R] >= 0; 0 leaves a ray out of the mean.
    """
    squared = jnp.square(rgb - target).mean(-1)
    return weighted_mean(0.5 * (squared / variance + jnp.log(variance)), ray_weight)


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
    """`sum w v / sum w` over all entries; 0 if every weight is 0."""
    return safe_divide((values * weights).sum(), weights.sum())


def kernel_bandwidth(
    draws: jax.Array, *, exponent: float = 1.0 / 7.0, floor: float = 1e-5
) -> jax.Array:
    """Widths [R, 3] of the kernels about K rendered colours, constant in derivatives.

    `h = std K / (K - 1) (0.8 / K)^exponent + floor`: Silverman's rule in three dimensions, with the
    standard deviation over `K - 1` widened a little more, as CF-NeRF's code has it.

    Args:
      draws: [K, R, 3] colours of K fields.
      exponent: 1/7 is Silverman's. CF-NeRF's code has -1/7, which is 2.9 times as wide at K = 32.
      floor: > 0, added.

    Raises:
      ValueError: fewer than two draws, which have no spread.
    """
    num_draws = draws.shape[0]
    if num_draws < 2:
        raise ValueError(f"kernel_bandwidth: draws must hold at least 2 fields, got {num_draws}")
    fixed = jax.lax.stop_gradient(draws)
    factor = num_draws / (num_draws - 1) * (0.8 / num_draws) ** exponent
    return factor * fixed.std(0, ddof=1) + floor


def kernel_log_density(draws: jax.Array, target: jax.Array, bandwidth: jax.Array) -> jax.Array:
    """Log-density [R] of the true colour under Gaussian kernels about K rendered ones, nats.

    `log mean_k prod_c N(target_c; draws_kc, bandwidth_c^2)`.

    Args:
      draws: [K, R, 3].
      target: [R, 3].
      bandwidth: [R, 3] > 0.

    Numerics: a log-sum-exp, so that a colour far from all draws still pulls the nearest ones. At
    a bandwidth of 1e-5 that pull is up to 1e10, finite.
    """
    squared = jnp.square((draws - target) / bandwidth).sum(-1)  # [K, R]
    normaliser = (jnp.log(bandwidth) + 0.5 * jnp.log(2.0 * jnp.pi)).sum(-1)
    log_mean = jax.nn.logsumexp(-0.5 * squared, axis=0) - jnp.log(draws.shape[0])
    return log_mean - normaliser


def colour_likelihood_loss(
    draws: jax.Array,
    target: jax.Array,
    ray_weight: jax.Array,
    *,
    exponent: float = 1.0 / 7.0,
    floor: float = 1e-5,
) -> jax.Array:
    """Mean over rays of the negative log-density of the true colour, nats; 0 if every weight is 0.

    Args:
      draws: [K, R, 3] colours of the same rays in K fields.
      target: [R, 3] true colours.
      ray_weight: [R] >= 0; 0 leaves a ray out of the mean.
      exponent, floor: see `kernel_bandwidth`.

    Differs from CF-NeRF's code: one kernel in three dimensions, which its bandwidth is for, where
    the code averages three densities of one channel each, of a third of this size; and no 1e-5
    inside of the logarithm, which took the gradient from the rays that are furthest off.
    """
    bandwidth = kernel_bandwidth(draws, exponent=exponent, floor=floor)
    log_density = kernel_log_density(draws, target, bandwidth)
    return -weighted_mean(log_density, ray_weight)


def mean_log_prob(log_prob: jax.Array, sample_mask: jax.Array) -> jax.Array:
    """Mean of `log q` over draws and valid samples: minus the field's entropy per sample, nats.

    0 if there is no valid sample.

    Args:
      log_prob: [K, ...] of `FlowField.apply`, K draws.
      sample_mask: [...] bool, which samples are valid.

    Differs from CF-NeRF's code: it averages the base's log-density over colour channels, where
    the logarithm of a joint density is a sum.
    """
    total = jnp.where(sample_mask, log_prob, 0.0).sum()
    return safe_divide(total, sample_mask.sum() * float(log_prob.shape[0]))


def flow_loss(
    draws: jax.Array,
    target: jax.Array,
    ray_weight: jax.Array,
    log_prob: jax.Array,
    sample_mask: jax.Array,
    *,
    entropy_weight: float = 0.01,
    exponent: float = 1.0 / 7.0,
    floor: float = 1e-5,
) -> jax.Array:
    """CF-NeRF's loss, nats: `colour_likelihood_loss + entropy_weight * mean_log_prob`.

    The first term fits the draws to what is seen; the second rewards the spread of what is not.

    Args:
      draws, target, ray_weight, exponent, floor: see `colour_likelihood_loss`.
      log_prob, sample_mask: see `mean_log_prob`.
      entropy_weight: of the second term.
    """
    likelihood = colour_likelihood_loss(draws, target, ray_weight, exponent=exponent, floor=floor)
    return likelihood + entropy_weight * mean_log_prob(log_prob, sample_mask)
