"""Runs of several scenes as runs of their mean, which is what the paper's tables are of."""

from __future__ import annotations

import dataclasses

import numpy as np

from experiments.report import stats
from experiments.report.results import ReportError, Run


def mean_runs(runs_of_scenes: list[list[Run]]) -> list[Run]:
    """Of each policy and seed one run, whose measures are means over the scenes.

    So an interval over these runs is one over seeds: scenes are not a sample of anything.

    Args:
      runs_of_scenes: of each scene its runs. A policy and seed that not every scene has completed
        is left out.

    Raises:
      ReportError: scenes were measured at different numbers of views.
    """
    by_scene = [
        {(run.policy, run.seed): run for run in stats.completed(runs)} for runs in runs_of_scenes
    ]
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
