"""How a time grows with a size: the exponent, and the straight line."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Fit(NamedTuple):
    """Two descriptions of the same points; 1 and a small deviation both say linear."""

    exponent: float  # p of t ~ n^p over the measured range, a fixed cost included
    intercept_s: float  # a of t = a + b n: the fixed cost
    slope_s: float  # b: seconds for one more
    largest_deviation: float  # of the points from the line, as a share of the measured time


def fit_growth(sizes, seconds) -> Fit:
    """Fits `log t = log c + p log n` and `t = a + b n`, both by least squares.

    The line minimises relative errors, so that small sizes count as much as large ones.

    Args:
      sizes: [N] n > 0, at least two different ones.
      seconds: [N] t > 0.
    """
    sizes, seconds = np.asarray(sizes, np.float64), np.asarray(seconds, np.float64)
    exponent, _ = np.polyfit(np.log(sizes), np.log(seconds), 1)
    slope, intercept = np.polyfit(sizes, seconds, 1, w=1.0 / seconds)
    deviation = np.abs(intercept + slope * sizes - seconds) / seconds
    return Fit(float(exponent), float(intercept), float(slope), float(deviation.max()))
