"""Which views fit the scale, which calibrate the factors, and which test the intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

SHARES = (0.25, 0.5, 0.25)  # calibration needs the most: V views promise V / (V + 1) at best


class ViewGroups(NamedTuple):
    """Views that were not trained on, in three disjoint groups, each sorted."""

    fit: np.ndarray
    calibration: np.ndarray
    test: np.ndarray


def split_views(
    views: Sequence[int], *, seed: int | None, shares: Sequence[float] = SHARES
) -> ViewGroups:
    """Splits views, never pixels, into fit, calibration and test.

    Args:
      views: numbers of views that were not trained on, each once.
      seed: of a random split, or None for an interleaved one: each group then takes its views
        evenly spread over the order in which they are given, such as along a camera path. The
        guarantee is for the random split; the interleaved one has no luck of the draw.
      shares: of fit, calibration and test, > 0, whose sum is 1.

    Returns:
      the groups, each within one view of its share.

    Raises:
      ValueError: views come twice, shares are not such, or a group would be empty.
    """
    views, shares = np.asarray(views, np.int64), np.asarray(shares, np.float64)
    if shares.shape != (3,) or not (shares > 0.0).all() or abs(shares.sum() - 1.0) > 1e-6:
        raise ValueError(
            f"shares {shares.tolist()}: give three of fit, calibration and test, each > 0, sum 1"
        )
    if views.ndim != 1 or len(np.unique(views)) != len(views):
        raise ValueError("views: give a list of numbers, each view once")
    order = views if seed is None else np.random.default_rng(seed).permutation(np.sort(views))
    counts = np.zeros(3, int)
    group = np.zeros(len(views), int)
    for row in range(len(views)):
        # The group that is furthest behind its share; rounded, for ties to go to the first.
        group[row] = np.argmax(np.round(shares * (row + 1) - counts, 9))
        counts[group[row]] += 1
    if not counts.all():
        raise ValueError(
            f"views: {len(views)} are too few for fit, calibration and test with shares "
            f"{shares.tolist()}: they would get {counts.tolist()}; give more views"
        )
    return ViewGroups(*(np.sort(order[group == which]) for which in range(3)))
