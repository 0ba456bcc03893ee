"""Predicts all batches of finished runs from the field of their initial views.

So does someone who plans several batches at once and cannot train in between. Curvature needs
poses only, so the posterior of the first field can be followed along all of a run's views.
"""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
from collections.abc import Sequence

import numpy as np

from bavs_jax.cameras import take
from bavs_jax.candidates import Candidates
from bavs_jax.prediction import make_predict_fn
from bavs_jax.selection.policies import get_policy
from bavs_jax.training.batches import num_training_pixels
from bavs_jax.uncertainty.model import RECONSTRUCTION, Situation
from experiments import runtime
from experiments.build import build_problem
from experiments.build_scene import load_config_scene
from experiments.errors import WorkdirError
from experiments.predicted.cases import realised_gain
from experiments.progress import track
from experiments.report.results import Run as FinishedRun
from experiments.runner import Run
from experiments.trained import saved_config


def comparable_rows(rounds: Sequence[dict]) -> list[dict]:
    """The rows after round 0, up to the last whose gain is known."""
    pairs = list(itertools.pairwise(rounds))
    known = [i for i, pair in enumerate(pairs, start=1) if realised_gain(*pair) is not None]
    return list(rounds[1 : max(known, default=0) + 1])


def plan_ahead(folder: pathlib.Path, runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """The runs, with predictions from the first field in place of any that they had.

    Args:
      folder: of the experiment, with its checkpoints of round 0.
      runs: finished runs of it. Those that train another kind of field are left out, for they have
        another round 0.

    Raises:
      WorkdirError: the runs' pictures were taken at free poses.
    """
    config = saved_config(folder)
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    problem = build_problem(config, scene)
    if problem.has_empty_views:
        raise WorkdirError(
            f"{folder}: config.candidates.source: pictures were taken at free poses, which cannot "
            "be predicted afterwards; record predictions with --config.predict_gain=True"
        )
    predict = make_predict_fn(
        problem.make_toolbox(track), image_scale=config.candidates.image_scale
    )
    planned, pool = [], np.asarray(scene.pool)
    place = {int(view): index for index, view in enumerate(pool)}
    of_kind = [run for run in runs if get_policy(run.policy).field_kind == RECONSTRUCTION]
    for seed in sorted({run.seed for run in of_kind}):
        first = Run(config, problem, folder, None, seed)
        state = first.state()
        is_training = np.asarray(state.is_training_view)
        num_rays = int(num_training_pixels(scene, first.initial).sum())
        situation = Situation(state.train, state.table, is_training, num_rays)
        candidates = Candidates(take(scene.cameras, pool), pool, ~is_training[pool])
        for run in (run for run in of_kind if run.seed == seed):
            rows = comparable_rows(run.rounds)
            batches = [[place[view] for view in row["selected"]] for row in rows]
            predictions = predict(situation, candidates, batches)
            fresh = [row | {"predicted": p} for row, p in zip(rows, predictions)]
            rest = [row | {"predicted": None} for row in run.rounds[1 + len(rows) :]]
            planned.append(dataclasses.replace(run, rounds=[run.rounds[0], *fresh, *rest]))
            print(f"{run.label}: {len(rows)} batches predicted from the first field", flush=True)
    return planned
