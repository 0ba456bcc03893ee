"""Slow float64 references for information gains: determinants of whole matrices, every subset."""

from __future__ import annotations

import itertools

import numpy as np


def log_det_of_set(precision, curvatures, batch) -> float:
    """`log det(H + sum_{c in batch} h_c) - log det H` of diagonal matrices written out.

    Args:
      precision: [G, 3] H > 0.
      curvatures: [C, G, 3] h >= 0.
      batch: candidates, a set.
    """
    before = np.diag(np.asarray(precision, np.float64).ravel())
    after = before + sum(
        (np.diag(np.asarray(curvatures[c], np.float64).ravel()) for c in batch),
        np.zeros_like(before),
    )
    return float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1])


def trace_ratio(precision, h) -> float:
    """`tr(h H^-1)` of diagonal matrices written out."""
    inverse = np.linalg.inv(np.diag(np.asarray(precision, np.float64).ravel()))
    return float(np.trace(np.diag(np.asarray(h, np.float64).ravel()) @ inverse))


def best_set(precision, curvatures, k) -> tuple[float, tuple[int, ...]]:
    """Largest `log_det_of_set` of all batches of k, and one that has it."""
    batches = itertools.combinations(range(len(curvatures)), k)
    return max((log_det_of_set(precision, curvatures, b), b) for b in batches)


def greedy_order(precision, curvatures, k, gain_fn) -> list[int]:
    """Greedy picks under `gain_fn(precision, h)`; ties to the smallest index."""
    precision, picks = np.array(precision, np.float64), []
    for _ in range(k):
        left = [c for c in range(len(curvatures)) if c not in picks]
        picks.append(max(left, key=lambda c: (gain_fn(precision, curvatures[c]), -c)))
        precision = precision + curvatures[picks[-1]]
    return picks


def directional_gain(prior, vertices, looks, look, sharpness) -> float:
    """What one more look tells, vertex by vertex, from the angles themselves.

    Args:
      prior: > 0.
      vertices: [G, 3].
      looks: (h [G, 3], position [3]) of those before.
      look: the same of the new one.
      sharpness: of the kernel `((1 + cos angle) / 2)^sharpness`.
    """
    total = 0.0
    new_h, new_position = (np.asarray(x, np.float64) for x in look)
    for vertex, h in zip(np.asarray(vertices, np.float64), new_h):
        known = np.full(3, prior, np.float64)
        for old_h, old_position in looks:
            a, b = new_position - vertex, np.asarray(old_position, np.float64) - vertex
            cosine = a @ b / np.sqrt((a @ a) * (b @ b))
            known += ((1.0 + cosine) / 2.0) ** sharpness * old_h[np.all(vertices == vertex, 1)][0]
        total += sum(np.log((k + x) / k) for k, x in zip(known, h))
    return total


def target_variance(prior, vertices, target, looks, sharpness) -> float:
    """Predicted variance of a target's colours, a matrix of every vertex written out.

    Args:
      prior: [3] > 0, `1 / std^2`.
      vertices: [G, 3].
      target: (T [G, 3], position [3]); T and h are divided by the noise's variance.
      looks: (h [G, 3], position [3]) of what is known.
      sharpness: of the kernel `((1 + cos angle) / 2)^sharpness`.
    """
    curvature, stand = (np.asarray(x, np.float64) for x in target)
    total = 0.0
    for row, vertex in enumerate(np.asarray(vertices, np.float64)):
        precision = np.diag(np.asarray(prior, np.float64))
        for h, place in looks:
            a, b = stand - vertex, np.asarray(place, np.float64) - vertex
            cosine = a @ b / np.sqrt((a @ a) * (b @ b))
            kernel = ((1.0 + cosine) / 2.0) ** sharpness
            precision = precision + kernel * np.diag(np.asarray(h[row], np.float64))
        total += np.trace(np.diag(curvature[row]) @ np.linalg.inv(precision))
    return float(total)
