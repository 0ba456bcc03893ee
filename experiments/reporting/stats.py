"""Means and intervals over seeds, gaps between policies, and runs of the mean over scenes."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy.stats import t as student_t

from experiments.reporting.results import Run
from experiments.runtime import ReportError


@dataclasses.dataclass(frozen=True)
class Measure:
    """How a measure is called and printed."""

    key: str
    label: str
    unit: str  # empty where it has none
    digits: int
    better: str  # "higher" or "lower"

    @property
    def heading(self) -> str:
        """Of a column, with the unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    @property
    def title(self) -> str:
        return f"{self.heading}, {self.better} is better"


REFERENCES = ("random", "farthest")  # what a policy must beat to be worth its time
MEASURES = (
    Measure("psnr", "PSNR", "dB", 2, "higher"),
    Measure("ssim", "SSIM", "", 4, "higher"),
    Measure("lpips", "LPIPS", "", 4, "lower"),
    Measure("depth_mae", "Depth error", "scene units", 4, "lower"),
)


@dataclasses.dataclass(frozen=True)
class Interval:
    """A mean over seeds with its 95 % interval, `mean ± half`."""

    mean: float
    half: float | None  # None: one seed says nothing about the spread
    num: int

    @property
    def low(self) -> float | None:
        return None if self.half is None else self.mean - self.half

    @property
    def high(self) -> float | None:
        return None if self.half is None else self.mean + self.half


def mean_interval(values) -> Interval | None:
    """Mean and Student's t interval: `half = t_{0.975, n - 1} s / sqrt(n)`.

    Args:
      values: one number per seed, or paired differences, one per seed.

    Returns:
      The interval, or None of no values.
    """
    values = np.asarray(list(values), np.float64)
    if values.size == 0:
        return None
    half = None
    if values.size > 1:
        half = student_t.ppf(0.975, values.size - 1) * values.std(ddof=1) / np.sqrt(values.size)
    return Interval(float(values.mean()), None if half is None else float(half), values.size)


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


def completed(runs: list[Run], policy: str | None = None) -> list[Run]:
    """Runs that ended and measured something, of one policy or of all."""
    return [r for r in runs if r.completed and r.rounds and policy in (None, r.policy)]


def focus_policy(policies: list[str]) -> str | None:
    """The policy that a report is about: ours where it ran, otherwise the first."""
    ours = [p for p in policies if p == "bavs"] or [p for p in policies if p.startswith("bavs")]
    return next(iter(ours or policies), None)


def over_seeds(
    runs: list[Run], policy: str, measure: str, num_views: int | None
) -> Interval | None:
    """Mean over the seeds of a policy."""
    return mean_interval(by_seed(runs, policy, measure, num_views).values())


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One policy against another over the seeds both have."""

    policy: Interval
    reference: Interval
    gap: Interval  # of the paired differences, policy - reference
    gaps: list[float]  # the differences, seed by seed


def compare(
    runs: list[Run], policy: str, reference: str, measure: str, num_views: int | None
) -> Comparison | None:
    """Pairs the seeds of two policies: the initial views, and so their luck, are the same.

    Returns:
      The comparison, or None where no seed has both.
    """
    pairs = _pairs(runs, policy, reference, measure, num_views).values()
    if not pairs:
        return None
    ours, theirs = zip(*pairs)
    gaps = [a - b for a, b in pairs]
    return Comparison(mean_interval(ours), mean_interval(theirs), mean_interval(gaps), gaps)


def mean_round_gap(runs: list[Run], policy: str, reference: str, measure: str) -> Interval | None:
    """Paired gap averaged over the rounds in which views had been chosen, one number per seed.

    A field trained from few views differs from run to run by luck; the mean over rounds has less
    of that than the last round alone, and it also counts what is gained early.
    """
    by_round = [_pairs(runs, policy, reference, measure, n) for n in chosen_num_views(runs)]
    seeds = set.intersection(*map(set, by_round)) if by_round else set()
    return mean_interval(
        np.mean([pairs[seed][0] - pairs[seed][1] for pairs in by_round]) for seed in sorted(seeds)
    )


def shared_num_views(runs: list[Run]) -> list[int]:
    """Numbers of views at which all completed runs were measured, few views first."""
    sets = [{r["num_views"] for r in run.rounds} for run in completed(runs)]
    return sorted(set.intersection(*sets)) if sets else []


def common_num_views(runs: list[Run]) -> int | None:
    """The largest number of views that every completed run has been measured at."""
    return max(shared_num_views(runs), default=None)


def chosen_num_views(runs: list[Run]) -> list[int]:
    """The shared numbers of views without that of the initial views."""
    return shared_num_views(runs)[1:]


def by_seed(runs: list[Run], policy: str, measure: str, num_views: int | None) -> dict[int, float]:
    """What each completed run of a policy reached, where it is known."""
    values = {run.seed: run.value(measure, num_views) for run in completed(runs, policy)}
    return {seed: value for seed, value in values.items() if value is not None}


def _pairs(runs, policy, reference, measure, num_views) -> dict[int, tuple[float, float]]:
    """By seed, what the two policies reached."""
    ours, theirs = (by_seed(runs, name, measure, num_views) for name in (policy, reference))
    return {seed: (value, theirs[seed]) for seed, value in ours.items() if seed in theirs}


def mean_curve(runs: list[Run], policy: str, measure: str) -> list[tuple[int, Interval]]:
    """(number of views, interval over seeds) of a policy, few views first."""
    numbers = sorted({r["num_views"] for run in completed(runs, policy) for r in run.rounds})
    curve = [(n, over_seeds(runs, policy, measure, n)) for n in numbers]
    return [(n, interval) for n, interval in curve if interval is not None]


def views_to_reach(curve: list[tuple[int, Interval]], target: float) -> float | None:
    """Number of views at which a mean curve first reaches `target`, linear in between."""
    for (n0, a), (n1, b) in itertools.pairwise(curve):
        if a.mean < target <= b.mean:
            return n0 + (n1 - n0) * (target - a.mean) / (b.mean - a.mean)
    return None


def mean_seconds(runs: list[Run], policy: str, part: str) -> float | None:
    """Seconds of one part of the work, summed over rounds, mean over completed runs."""
    totals = [
        sum(r.get("seconds", {}).get(part) or 0.0 for r in run.rounds)
        for run in completed(runs, policy)
    ]
    return float(np.mean(totals)) if totals else None


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
    by_scene = [{(run.policy, run.seed): run for run in completed(runs)} for runs in runs_of_scenes]
    shared = [key for key in by_scene[0] if all(key in others for others in by_scene)]
    return [_mean_run([runs[key] for runs in by_scene]) for key in shared]


def _mean_run(runs: list[Run]) -> Run:
    first = runs[0]
    if len({tuple(r["num_views"] for r in run.rounds) for run in runs}) > 1:
        names = ", ".join(run.result["scene"]["name"] for run in runs)
        raise ReportError(
            f"{first.label}: {names} were measured at different numbers of views; there is no mean"
        )
    rounds = [_mean([run.rounds[i] for run in runs]) for i in range(len(first.rounds))]
    return dataclasses.replace(first, rounds=rounds)


def _mean(values: list):
    """Mean of numbers, key by key in dicts; None where one is missing or no number."""
    if all(isinstance(value, dict) for value in values):
        keys = [key for key in values[0] if all(key in value for value in values)]
        return {key: _mean([value[key] for value in values]) for key in keys}
    if all(isinstance(value, int | float) for value in values):
        return values[0] if len(set(values)) == 1 else float(np.mean(values))
    return None
