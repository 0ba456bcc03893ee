"""Slow float64 references for view selection: literal loops over the words of the paper."""

from __future__ import annotations

import numpy as np


def distance(a, b) -> float:
    """Euclidean distance of two points."""
    return float(np.linalg.norm(np.asarray(a, np.float64) - np.asarray(b, np.float64)))


def nearest_distance(point, others) -> float:
    """Distance to the nearest of others, infinity if there is none."""
    return min((distance(point, other) for other in others), default=np.inf)


def max_min_filter(
    positions, training, mask, num_wanted, *, view_ids, radii, shrink=0.8, max_shrinks=32
):
    """Fig 5 candidate by candidate; `training` holds only the training views.

    Returns:
      survivors [C] bool, number of shrinks, whether it fell back to all of `mask`.
    """
    nearest = [nearest_distance(p, training) for p in positions]
    visit = sorted(np.flatnonzero(mask), key=lambda i: (-nearest[i], view_ids[i]))
    for shrinks in range(max_shrinks + 1):
        min_train, min_candidate = (r * shrink**shrinks for r in radii)
        kept = []
        for i in visit:
            far_from_training = nearest[i] >= min_train
            far_from_kept = all(distance(positions[i], positions[j]) >= min_candidate for j in kept)
            if far_from_training and far_from_kept:
                kept.append(i)
        if len(kept) >= num_wanted:
            return np.isin(np.arange(len(mask)), kept), shrinks, False
    return np.array(mask, bool), max_shrinks, True


def farthest_order(positions, training, mask, num_picks, *, view_ids) -> list[int]:
    """Farthest-view sampling: indices in the order of picking."""
    picks, left = [], set(np.flatnonzero(mask).tolist())
    while left and len(picks) < num_picks:
        chosen = [*training, *(positions[i] for i in picks)]
        nearest = {i: nearest_distance(positions[i], chosen) for i in left}
        picks.append(min(left, key=lambda i: (-nearest[i], view_ids[i])))
        left.remove(picks[-1])
    return picks


def top_k(scores, mask, view_ids, k) -> list[int]:
    """Indices of the k largest scores within mask, ties to the smallest view id."""
    return sorted(np.flatnonzero(mask).tolist(), key=lambda i: (-scores[i], view_ids[i]))[:k]
