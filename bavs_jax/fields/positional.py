"""Sines and cosines of positions, of points and of the cones behind pixels."""

import jax
import jax.numpy as jnp

# Radius of the disc with the variance of a unit square, in Mip-NeRF's convention.
PIXEL_TO_RADIUS = 2.0 / 12.0**0.5


def positional_encoding(x: jax.Array, degree: int) -> jax.Array:
    """`sin(2^k pi x), cos(2^k pi x)` for k = 0 .. degree - 1, [..., 6 * degree] (NeRF, Eq 4)."""
    phase = _phases(x, degree)
    return jnp.concatenate([jnp.sin(phase), jnp.cos(phase)], axis=-1)


def integrated_encoding(mean: jax.Array, variance: jax.Array, degree: int) -> jax.Array:
    """Mean of `positional_encoding` over `x ~ N(mean, diag(variance))` (Mip-NeRF, Eq 14).

    `E sin(a x) = sin(a mean) exp(-a^2 variance / 2)`, likewise for the cosine: octaves finer than
    the cone fade out.

    Args:
      mean: [..., 3].
      variance: [..., 3] >= 0.
      degree: octaves.
    """
    phase = _phases(mean, degree)
    scale = jnp.square(jnp.pi * 2.0 ** jnp.arange(degree, dtype=mean.dtype))
    spread = (variance[..., None, :] * scale[:, None]).reshape(phase.shape)
    fade = jnp.exp(-0.5 * spread)
    return jnp.concatenate([fade * jnp.sin(phase), fade * jnp.cos(phase)], axis=-1)


def _phases(x, degree: int):
    """`2^k pi x` as [..., 3 * degree], octave by octave."""
    scale = jnp.pi * 2.0 ** jnp.arange(degree, dtype=x.dtype)
    return (x[..., None, :] * scale[:, None]).reshape(*x.shape[:-1], 3 * degree)


def frustum_variance(t_mids: jax.Array, deltas: jax.Array, radius) -> tuple[jax.Array, jax.Array]:
    """Variance along and across the axis of a piece of a cone (Mip-NeRF, Eq 7).

    Args:
      t_mids: [...] distance of its middle from the tip.
      deltas: [...] its length.
      radius: of the cone at distance 1.

    Returns:
      `(along, across)`, each [...], of a point drawn evenly from the piece.

    Numerics: in the form of Mip-NeRF's supplement, without differences of large powers.
    """
    half, middle2 = 0.5 * deltas, jnp.square(t_mids)
    half2 = jnp.square(half)
    base = jnp.maximum(3.0 * middle2 + half2, 1e-12)
    along = half2 / 3.0 - (4.0 / 15.0) * half2**2 * (12.0 * middle2 - half2) / base**2
    across = middle2 / 4.0 + (5.0 / 12.0) * half2 - (4.0 / 15.0) * half2**2 / base
    return along, radius**2 * across


def cone_variance(rays, samples, radius) -> jax.Array:
    """Variance in each world axis of the piece of a pixel's cone behind each sample, [R, S, 3].

    `along d^2 + across (1 - d^2)`: the diagonal of the covariance, scene unit^2.

    Differs from Mip-NeRF: the Gaussian stands at the middle of its step, not at the centre of mass
    slightly behind it, so that all fields are read at the same positions.
    """
    along, across = frustum_variance(samples.t_mids, samples.deltas, radius)
    squared = jnp.square(rays.directions)[:, None]
    return along[..., None] * squared + across[..., None] * (1.0 - squared)
