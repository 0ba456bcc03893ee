"""Means and intervals over seeds, and gaps between policies, of one scene or of several."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr, stdtrit  # scipy.stats takes a second of every start to import

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
    """Mean and Student's t interval, `half = t_{0.975, n - 1} s / sqrt(n)`; None of no values."""
    numbers = np.array([*(values.values() if isinstance(values, dict) else values)], np.float64)
    if numbers.size < 2:
        return Interval(float(numbers[0]), None, 1) if numbers.size else None
    half = stdtrit(numbers.size - 1, 0.975) * numbers.std(ddof=1) / np.sqrt(numbers.size)
    return Interval(float(numbers.mean()), float(half), numbers.size)


def paired_p_value(gap: Interval) -> float | None:
    """Chance of a mean gap at least as large if there were none: the two-sided paired t-test.

    `p = 2 P(T > |mean| / (s / sqrt(n)))`, T of Student with n - 1 degrees of freedom. It says what
    the interval says: p < 0.05 where that excludes zero. (Flipping signs could not: over 5 seeds
    its least p is 2 / 32.) Nothing is corrected for the number of gaps that are looked at. None of
    one seed.
    """
    if gap.half is None:
        return None
    if gap.half == 0.0:
        return float(gap.mean == 0.0)
    standard_error = gap.half / stdtrit(gap.num - 1, 0.975)
    return float(2.0 * stdtr(gap.num - 1, -abs(gap.mean) / standard_error))


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
    """What the completed runs of a policy reached, where it is known.

    The mean is taken over the rounds `at` some numbers of views: a field from few views differs by
    luck from run to run, of which the mean has less. None: at the most that all runs share.
    """
    at = shared_num_views(runs)[-1:] if at is None else at
    mine = completed(runs, policy)
    return _seed_means((run.seed, [run.value(measure, n) for n in at]) for run in mine)


def run_seconds(runs: list[Run], policy: str, *parts: str) -> Interval | None:
    """Seconds of some parts of the work, all rounds of a run together, mean over its seeds."""
    totals = [
        (run.seed, [sum(r.get("seconds", {}).get(p) or 0.0 for r in run.rounds for p in parts)])
        for run in completed(runs, policy)
    ]
    return mean_interval(_seed_means(totals))


def _seed_means(values: Iterable[tuple[int, list]]) -> dict[int, float]:
    """By seed the mean of all numbers of its runs, which are several where there are more scenes.

    So an interval is one over seeds: scenes are not a sample of anything.
    """
    found: dict[int, list] = {}
    for seed, numbers in values:
        found.setdefault(seed, []).extend(numbers)
    known = {seed: numbers for seed, numbers in found.items() if numbers and None not in numbers}
    return {seed: float(np.mean(numbers)) for seed, numbers in known.items()}


def paired_gap(ours: dict[int, float], theirs: dict[int, float]) -> Interval | None:
    """Mean difference over the seeds that both have: these share initial views, and so luck."""
    return mean_interval(value - theirs[seed] for seed, value in ours.items() if seed in theirs)


def in_all_scenes(runs_of_scenes: Iterable[list[Run]]) -> list[Run]:
    """All completed runs, but for policies and seeds that not every scene has completed."""
    scenes = [completed(runs) for runs in runs_of_scenes]
    labels = set.intersection(*({run.label for run in runs} for runs in scenes))
    return [run for runs in scenes for run in runs if run.label in labels]
