"""Means and intervals over seeds, gaps between policies, and runs of the mean over scenes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import t as student_t

from experiments.errors import ReportError
from experiments.reporting.results import Run


class Measure(NamedTuple):
    """How a measure is called and printed."""

    key: str
    label: str
    heading: str  # of a column, with the unit
    digits: int
    better: str  # "higher" or "lower"


PSNR = Measure("psnr", "PSNR", "PSNR (dB)", 2, "higher")
MEASURES = (
    PSNR,
    Measure("ssim", "SSIM", "SSIM", 4, "higher"),
    Measure("lpips", "LPIPS", "LPIPS", 4, "lower"),
    Measure("depth_mae", "Depth error", "Depth error (scene units)", 4, "lower"),
)
REFERENCES = ("random", "farthest")  # what a policy must beat to be worth its time


class Interval(NamedTuple):
    """A mean over seeds with its 95 % interval, `mean ± half`."""

    mean: float
    half: float | None  # None: one seed says nothing about the spread
    num: int


def mean_interval(values: Iterable[float] | dict[int, float]) -> Interval | None:
    """Mean and Student's t interval: `half = t_{0.975, n - 1} s / sqrt(n)`.

    Args:
      values: numbers, or by seed numbers or paired differences.

    Returns:
      The interval, or None of no values.
    """
    numbers = np.array([*(values.values() if isinstance(values, dict) else values)], np.float64)
    if numbers.size < 2:
        return Interval(float(numbers[0]), None, 1) if numbers.size else None
    half = student_t.ppf(0.975, numbers.size - 1) * numbers.std(ddof=1) / np.sqrt(numbers.size)
    return Interval(float(numbers.mean()), float(half), numbers.size)


def paired_p_value(gap: Interval) -> float | None:
    """Chance of a mean gap at least as large if there were none: the two-sided paired t-test.

    `p = 2 P(T > |mean| / (s / sqrt(n)))`, T of Student with n - 1 degrees of freedom. It says what
    the interval says: p < 0.05 where that excludes zero. (Flipping signs could not: over 5 seeds
    its least p is 2 / 32.) Nothing is corrected for the number of gaps that are looked at.

    Args:
      gap: of paired differences.

    Returns:
      p, or None of one seed.
    """
    if gap.half is None:
        return None
    if gap.half == 0.0:
        return float(gap.mean == 0.0)
    standard_error = gap.half / student_t.ppf(0.975, gap.num - 1)
    return float(2.0 * student_t.sf(abs(gap.mean) / standard_error, gap.num - 1))


# --- of runs ---


def completed(runs: list[Run], policy: str | None = None) -> list[Run]:
    """Runs that ended and measured something, of one policy or of all."""
    return [r for r in runs if r.completed and r.rounds and policy in (None, r.policy)]


def shared_num_views(runs: list[Run]) -> list[int]:
    """Numbers of views at which all completed runs were measured, few views first."""
    sets = [{r["num_views"] for r in run.rounds} for run in completed(runs)]
    return sorted(set.intersection(*sets)) if sets else []


def by_seed(
    runs: list[Run], policy: str, measure: str = "psnr", at: Sequence[int] | None = None
) -> dict[int, float]:
    """What each completed run of a policy reached, where it is known.

    Args:
      runs: of all policies.
      policy: whose.
      measure: key of a `Measure`.
      at: numbers of views over which the mean is taken: a field trained from few views differs
        from run to run by luck, of which the mean has less. None: the most that all runs share.
    """
    at = shared_num_views(runs)[-1:] if at is None else at
    found = {run.seed: [run.value(measure, n) for n in at] for run in completed(runs, policy)}
    return {seed: np.mean(values) for seed, values in found.items() if at and None not in values}


def paired_gap(ours: dict[int, float], theirs: dict[int, float]) -> Interval | None:
    """Mean difference over the seeds that both have: these share initial views, and so luck."""
    return mean_interval(value - theirs[seed] for seed, value in ours.items() if seed in theirs)


def run_seconds(runs: list[Run], policy: str, *parts: str) -> Interval | None:
    """Seconds of some parts of the work, all rounds of a run together, mean over its seeds."""
    return mean_interval(
        sum(r.get("seconds", {}).get(part) or 0.0 for r in run.rounds for part in parts)
        for run in completed(runs, policy)
    )


# --- of several scenes ---


def mean_runs(runs_of_scenes: list[list[Run]]) -> list[Run]:
    """Of each policy and seed one run, whose measures are means over the scenes.

    So an interval over these runs is one over seeds: scenes are not a sample of anything.

    Args:
      runs_of_scenes: of each scene its runs. A policy and seed that not every scene has completed
        is left out.

    Raises:
      ReportError: scenes were measured at different numbers of views.
    """
    by_scene = [{run.label: run for run in completed(runs)} for runs in runs_of_scenes]
    shared = [label for label in by_scene[0] if all(label in runs for runs in by_scene)]
    means = []
    for same in ([runs[label] for runs in by_scene] for label in shared):
        if len({tuple(r["num_views"] for r in run.rounds) for run in same}) > 1:
            names = ", ".join(run.result["scene"]["name"] for run in same)
            fault = f"{names} were measured at different numbers of views; there is no mean"
            raise ReportError(f"{same[0].label}: {fault}")
        rounds = [_mean(list(rows)) for rows in zip(*(run.rounds for run in same))]
        means.append(dataclasses.replace(same[0], rounds=rounds))
    return means


def _mean(values: list):
    """Mean of numbers, key by key in dicts; None where one is missing or no number."""
    if all(isinstance(value, dict) for value in values):
        return {key: _mean([value.get(key) for value in values]) for key in values[0]}
    if all(isinstance(value, int | float) for value in values):
        return values[0] if len(set(values)) == 1 else float(np.mean(values))
    return None
