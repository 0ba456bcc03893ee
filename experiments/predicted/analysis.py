"""Rank correlation, calibration and stop rule of predicted against realised gains.

The definitions are in `experiments/predicted/__init__.py`.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr


class Correlation(NamedTuple):
    """A rank correlation, pooled or as a mean over groups."""

    value: float | None  # in [-1, 1]; None where nothing can be ranked
    standard_error: float | None  # if there were nothing to find
    num_cases: int
    num_groups: int


class Calibration(NamedTuple):
    """Predictions in dB, each from a line fitted to other cases."""

    predicted: np.ndarray  # [n] dB; NaN where no other cases are known
    constant: np.ndarray  # [n] dB, the mean realised gain of the same other cases


class StopRule(NamedTuple):
    """How often "stop when the next batch is worth less than x dB" was right."""

    threshold: float  # x, dB
    num_cases: int
    num_stops: int
    false_stops: int  # stopped, though x dB or more was realised
    missed_stops: int  # went on, though less than x dB was realised
    hit_rate: float
    base_rate: float  # of the better of always and never stopping


def rank_correlation(predicted, realised, groups: Sequence[Hashable]) -> Correlation:
    """Spearman's correlation within groups, their mean with weights n - 1.

    Each correlation of n independent cases has the variance `1 / (n - 1)` if there is nothing to
    find, so the mean has `1 / sum (n - 1)`. Groups of one case, and those in which either is the
    same throughout, say nothing and are left out.

    Args:
      predicted, realised: [n].
      groups: [n] which group each case is of; all the same for the pooled correlation.
    """
    predicted, realised = np.asarray(predicted, np.float64), np.asarray(realised, np.float64)
    total, weight, num_cases, num_groups = 0.0, 0, 0, 0
    for group in dict.fromkeys(groups):
        rows = [i for i, other in enumerate(groups) if other == group]
        x, y = predicted[rows], realised[rows]
        if len(rows) < 2 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
            continue
        total += (len(rows) - 1) * float(spearmanr(x, y).statistic)
        weight += len(rows) - 1
        num_cases, num_groups = num_cases + len(rows), num_groups + 1
    if not weight:
        return Correlation(None, None, 0, 0)
    return Correlation(total / weight, 1.0 / math.sqrt(weight), num_cases, num_groups)


def fit_line(predicted, realised) -> tuple[float, float]:
    """Least squares `realised ~ a + b predicted` with b >= 0: more is never mapped to less.

    Returns:
      a, b; with b = 0 and the mean where the slope would be negative or cannot be told.
    """
    predicted, realised = np.asarray(predicted, np.float64), np.asarray(realised, np.float64)
    x = predicted - predicted.mean()
    square = float(x @ x)
    slope = max(float(x @ realised) / square, 0.0) if square > 0.0 else 0.0
    return float(realised.mean() - slope * predicted.mean()), slope


def calibrate_on_others(predicted, realised, groups: Sequence[Hashable]) -> Calibration:
    """Maps each prediction by the line of all cases of other groups.

    Args:
      predicted: [n] in any unit.
      realised: [n] dB.
      groups: [n] what is left out together, such as seeds.
    """
    predicted, realised = np.asarray(predicted, np.float64), np.asarray(realised, np.float64)
    mapped, constant = np.full(len(predicted), np.nan), np.full(len(predicted), np.nan)
    for group in dict.fromkeys(groups):
        is_own = np.array([other == group for other in groups])
        if is_own.all():
            continue
        intercept, slope = fit_line(predicted[~is_own], realised[~is_own])
        mapped[is_own] = intercept + slope * predicted[is_own]
        constant[is_own] = realised[~is_own].mean()
    return Calibration(mapped, constant)


def root_mean_square(error) -> float | None:
    """Root of the mean square of an error [n]; None of nothing, or where it is not known."""
    error = np.asarray(error, np.float64)
    if not error.size or np.isnan(error).any():
        return None
    return float(np.sqrt(np.mean(np.square(error))))


def stop_rule(predicted, realised, threshold: float) -> StopRule:
    """Counts of hits and of both kinds of misses.

    Args:
      predicted: [n] dB, n >= 1, what each next batch is taken to be worth.
      realised: [n] dB.
      threshold: x, dB.
    """
    stops = np.asarray(predicted) < threshold
    should = np.asarray(realised) < threshold
    num = len(stops)
    return StopRule(
        threshold=threshold,
        num_cases=num,
        num_stops=int(stops.sum()),
        false_stops=int((stops & ~should).sum()),
        missed_stops=int((~stops & should).sum()),
        hit_rate=float((stops == should).mean()),
        base_rate=max(float(should.mean()), 1.0 - float(should.mean())),
    )
