"""Slow float64 references for predicted gains: whole matrices, ray by ray, rank by rank."""

from __future__ import annotations

import numpy as np


def expected_squared_error(jacobians, precision) -> float:
    """`mean_r sum_c g_rc^T H^-1 g_rc` with the matrix written out.

    Args:
      jacobians: [R, 3, P] derivative of each ray's colour by each of P offsets.
      precision: [P] diagonal of H.
    """
    covariance = np.linalg.inv(np.diag(np.asarray(precision, np.float64)))
    return float(np.mean([sum(g @ covariance @ g for g in ray) for ray in jacobians]))


def sampled_squared_error(rng, jacobians, precision, num: int) -> np.ndarray:
    """Squared colour errors of `num` draws of the offsets, each a mean over rays, [num]."""
    offsets = rng.normal(size=(num, len(precision))) / np.sqrt(precision)
    return np.square(np.einsum("rcp,np->nrc", jacobians, offsets)).sum(-1).mean(-1)


def spearman(x, y) -> float:
    """Pearson's correlation of ranks, ties at the mean of their places."""
    ranks = []
    for values in (x, y):
        values = np.asarray(values, np.float64)
        ranks.append([(values < v).sum() + ((values == v).sum() - 1) / 2.0 for v in values])
    return float(np.corrcoef(*ranks)[0, 1])


def brute_force_line(x, y) -> tuple[float, float]:
    """Least squares with a slope >= 0, by the normal equations and by the corner b = 0."""
    design = np.stack([np.ones(len(x)), np.asarray(x, np.float64)], axis=1)
    a, b = np.linalg.lstsq(design, np.asarray(y, np.float64), rcond=None)[0]
    return (float(a), float(b)) if b > 0.0 else (float(np.mean(y)), 0.0)
