"""Slow references of split-conformal calibration: exact fractions, one candidate at a time."""

from __future__ import annotations

import math
from fractions import Fraction


def conformal_quantile_by_counting(views, level) -> float:
    """Smallest t with sum over V views of (share of values <= t) / (V + 1) >= level, exactly.

    Args:
      views: V lists of values.
      level: a Fraction.
    """
    for t in sorted({value for view in views for value in view}):
        shares = [Fraction(sum(value <= t for value in view), len(view)) for view in views]
        if sum(shares) >= level * (len(views) + 1):
            return t
    return math.inf


def isotonic_by_min_max(values, weights) -> list[float]:
    """Non-decreasing weighted least squares: max over starts <= i, min over ends >= i of means."""

    def mean(start, end):
        rows = range(start, end + 1)
        return sum(weights[r] * values[r] for r in rows) / sum(weights[r] for r in rows)

    num = len(values)
    return [
        max(min(mean(start, end) for end in range(i, num)) for start in range(i + 1))
        for i in range(num)
    ]
