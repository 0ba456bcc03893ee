"""Density-aware ensembles (Sünderhauf et al. 2022): fields that disagree, or see nothing."""

from __future__ import annotations

import jax


def colour_variance(rgb: jax.Array) -> jax.Array:
    """How far E fields disagree on a ray's colour, `mean_c Var_k(C_kc)`.

    Args:
      rgb: [E, ..., 3] colours of the same rays in each field, in [0, 1].

    Returns:
      [...] in [0, 1/4], colour unit^2; the variance of the members themselves (divided by E).
    """
    return rgb.var(axis=0).mean(axis=-1)


def missing_density(opacity: jax.Array, *, known_background: bool = True) -> jax.Array:
    """What the members do not know for lack of any surface, `(1 - mean_k o_k)^2`.

    The authors' term says that every ray should end somewhere, and where none does the field was
    never told what is there. That holds in rooms and landscapes. In front of a known background
    an empty ray is an answer: members that agree on it are certain. There the term counts in
    proportion to the largest opacity, `max_k o_k (1 - mean_k o_k)^2`: unchanged if any member
    sees a surface that others miss, and 0 if none does.

    Args:
      opacity: [E, ...] of the same rays in each field, in [0, 1].
      known_background: False for the published form, which is 1 on a ray that meets nothing.

    Returns:
      [...] in [0, 1].
    """
    missing = (1.0 - opacity.mean(axis=0)) ** 2
    return opacity.max(axis=0) * missing if known_background else missing


def ensemble_uncertainty(
    rgb: jax.Array, opacity: jax.Array, *, known_background: bool = True
) -> jax.Array:
    """Uncertainty of a ray by E fields, `mean_c Var_k(C) + (1 - mean_k sum_i w_ki)^2`.

    Args:
      rgb: [E, ..., 3] in [0, 1].
      opacity: [E, ...] in [0, 1].
      known_background: whether an empty ray is certain; see `missing_density`.

    Returns:
      [...] >= 0; 0 where all members see the same background and nothing else, or 1 there
      without a known background.
    """
    return colour_variance(rgb) + missing_density(opacity, known_background=known_background)
