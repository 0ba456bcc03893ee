"""Batches with what they were predicted to be worth and what they were: read from result files."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from experiments.report.results import Run

# By name in result files: how it is called, and its unit; the first is the definition that counts.
PREDICTORS = {
    "variance_db": ("posterior variance, prior of one cell", "dB"),
    "paper_prior_db": ("posterior variance, the paper's prior", "dB"),
    "information_nats": ("information of the batch", "nats"),
    "views_db": ("number of views alone", "dB"),
    "distance_db": ("distance to the nearest view alone", "dB"),
}


@dataclasses.dataclass(frozen=True)
class Case:
    """One batch."""

    scene: str
    policy: str
    seed: int
    round: int  # 1 for the first batch
    num_views: int  # before the batch
    predicted: dict[str, float | None]  # by the names of `PREDICTORS`
    realised: float  # rise of the mean PSNR of the test views, dB

    @property
    def within_round(self) -> tuple:
        """Cases that are ranked among themselves: those of one scene and round."""
        return self.scene, self.round

    @property
    def within_seed(self) -> tuple:
        """Batches of several policies; in round 1 all from one and the same field."""
        return self.scene, self.round, self.seed


def realised_gain(before: dict, after: dict) -> float | None:
    """Rise of the mean PSNR from one round's row to the next, dB.

    None where the rounds were measured on different numbers of test views.
    """
    if before["num_test_views"] != after["num_test_views"]:
        return None
    return after["psnr"] - before["psnr"]


def run_cases(run: Run) -> tuple[list[Case], int]:
    """The cases of a run, and how many rounds were left out.

    A round is left out where there is no prediction, or where the test views before and after it
    are not the same in number.
    """
    cases, left_out = [], 0
    for number, (before, after) in enumerate(itertools.pairwise(run.rounds), start=1):
        realised = realised_gain(before, after)
        if not after.get("predicted") or realised is None:
            left_out += 1
            continue
        cases.append(
            Case(
                scene=run.result["scene"]["name"],
                policy=run.policy,
                seed=run.seed,
                round=number,
                num_views=before["num_views"],
                predicted={name: after["predicted"].get(name) for name in PREDICTORS},
                realised=realised,
            )
        )
    return cases, left_out


def known(cases: Sequence[Case], name: str) -> tuple[list[Case], np.ndarray, np.ndarray]:
    """The cases that a predictor says something about, with predicted and realised gains [n]."""
    rest = [case for case in cases if case.predicted[name] is not None]
    predicted = np.array([case.predicted[name] for case in rest], np.float64)
    return rest, predicted, np.array([case.realised for case in rest], np.float64)
