"""Functions with a singular point, each with its value *and* gradient stated there."""

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array

MAX_LOG_DENSITY = 12.0
MIN_VARIANCE = 0.01  # of a point's colour, where a field learns one
MIN_OPACITY = 1e-6  # what is relative to a ray's opacity is 0 below it, or gradients overflow


@jax.custom_jvp
def density_from_raw(raw: jax.Array) -> jax.Array:
    """Density `exp(raw)`, 1 / scene unit, from an unbounded network output.

    Numerics: `raw` is clipped to at most 12 (a density of 1.6e5, opaque in any cell), so the value
    stays finite; the derivative is that of the clipped value, kept also above the clip, so that a
    saturated density can still come down.
    """
    return jnp.exp(jnp.minimum(raw, MAX_LOG_DENSITY))


@density_from_raw.defjvp
def _density_from_raw_jvp(primals, tangents):
    density = density_from_raw(primals[0])
    return density, density * tangents[0]


def point_variance(raw: jax.Array) -> jax.Array:
    """Variance of a point's colour, `softplus(raw) + 0.01`, from a network output (ActiveNeRF)."""
    return jax.nn.softplus(raw) + MIN_VARIANCE


def safe_divide(numerator: Array, denominator: Array) -> jax.Array:
    """`numerator / denominator`, and 0 with gradient 0 where the denominator is 0."""
    is_zero = denominator == 0
    return jnp.where(is_zero, 0.0, numerator / jnp.where(is_zero, 1.0, denominator))


def unit_vectors(vectors: Array) -> jax.Array:
    """Vectors [..., D] at length 1; one of length 0 stays 0."""
    return safe_divide(vectors, jnp.linalg.norm(vectors, axis=-1, keepdims=True))


def opacity_or_empty(weights: jax.Array) -> jax.Array:
    """Opacity `sum_i w_i` of rays [..., S], and 0 with gradient 0 where it is below 1e-6: [...].

    To divide by with `safe_divide`, whose gradient would overflow at smaller opacities.
    """
    opacity = weights.sum(-1)
    return jnp.where(opacity < MIN_OPACITY, 0.0, opacity)


def x_log_x(x: jax.Array) -> jax.Array:
    """`x log x` for x >= 0, and 0 with gradient 0 where x is 0, in nats.

    Numerics: a positive number too small for a normal float counts as 0.
    """
    is_zero = x < jnp.finfo(x.dtype).tiny
    return jnp.where(is_zero, 0.0, x * jnp.log(jnp.where(is_zero, 1.0, x)))


def safe_reciprocal(x: Array) -> jax.Array:
    """`1 / x` for ray-box tests: a zero component becomes 1e-12 and keeps its sign."""
    tiny = jnp.where(jnp.signbit(x), -1e-12, 1e-12)
    return 1.0 / jnp.where(jnp.abs(x) < 1e-12, tiny, x)


def materialize(x: jax.Array) -> jax.Array:
    """`x` [..., D] as it is, but stored where it is used many times.

    XLA for CPUs computes a cheap producer anew inside of each of its consumers, and drops
    `optimization_barrier` before it does so: positions that 64 gathers read were computed 64
    times, which took half of a training step. It never does so with a matrix product, and one
    with the identity, in full precision, changes no value.
    """
    return jnp.dot(x, jnp.eye(x.shape[-1], dtype=x.dtype), precision=jax.lax.Precision.HIGHEST)
