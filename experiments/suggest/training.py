"""One field on all photos of a capture, with its curvature; both survive a kill."""

from __future__ import annotations

import dataclasses
import pathlib
import time

import jax.numpy as jnp
import numpy as np

from bavs_jax.active import round_keys
from bavs_jax.pixel_table import view_mask
from bavs_jax.scenes import Scene, SceneError
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.training.fit import fit
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import Situation
from bavs_jax.uncertainty.models.laplace import training_curvature
from experiments.build import Problem
from experiments.evaluate import evaluate_views, spread_evenly
from experiments.files import read_arrays, write_arrays
from experiments.keys import run_key, stream_key
from experiments.progress import track
from experiments.runtime import warn


def all_for_training(scene: Scene, holdout: int) -> Scene:
    """The scene with every view in the pool, but for `holdout` evenly spaced ones that are only
    measured."""
    views = np.arange(scene.num_views, dtype=np.int32)
    if not 0 <= holdout <= scene.num_views - 2:
        raise SceneError(
            f"{scene.name}: --holdout={holdout} of {scene.num_views} photos leaves fewer than 2 "
            "to train on: give a smaller number"
        )
    test = spread_evenly(views, holdout) if holdout else views[:0]
    return dataclasses.replace(scene, pool=np.setdiff1d(views, test), test=test)


def train_field(config, problem: Problem, folder: pathlib.Path, seed: int) -> TrainState:
    """Trains, going on from the last checkpoint in `folder`.

    Raises:
      FloatingPointError: the loss is not finite.
    """
    pool, steps = problem.scene.pool, config.train.steps_per_call
    checkpoints = Checkpoints(folder / "checkpoints", warn_fn=warn)
    train, calls, restarts = problem.trainer.init(stream_key(seed, "init")), 0, 0
    if (found := checkpoints.restore(train)) is not None:
        train, meta = found
        calls, restarts = meta["calls"], meta["restarts"]
    num_calls = problem.trainer.num_calls
    if calls < num_calls:
        saved_at = time.monotonic()
        *_, key = round_keys(run_key(seed), 0)
        with track((num_calls - calls) * steps, f"train on {len(pool)} photos", "steps") as bar:
            for fitted in fit(
                key,
                problem.trainer,
                train,
                problem.table,
                view_mask(problem.table, pool),
                calls=calls,
                restarts=restarts,
                label="photos",
            ):
                train, calls, restarts, info = fitted
                loss = float(info.loss)
                bar.advance(steps, loss=loss, psnr=-10.0 * np.log10(loss))
                if calls == 0:
                    warn(f"the field is stuck: trained anew with another key ({restarts})")
                due = time.monotonic() - saved_at > config.checkpoint_seconds
                if due or calls == num_calls:
                    number = restarts * (num_calls + 1) + calls
                    checkpoints.save(number, train, {"calls": calls, "restarts": restarts})
                    saved_at = time.monotonic()
    checkpoints.close()
    return train


def photo_curvature(problem: Problem, train: TrainState, folder: pathlib.Path, seed: int):
    """`jac_sq_sum` [G, 3] of all training photos, kept in `folder` once it is made."""
    path = folder / "curvature.npz"
    if (kept := read_arrays(path, "jac_sq_sum")) is not None:
        return jnp.asarray(kept["jac_sq_sum"])
    is_training = view_mask(problem.table, problem.scene.pool)
    toolbox = problem.toolbox
    situation = Situation(train, problem.table, is_training, num_rays=0, label="photos")
    jac_sq_sum = training_curvature(
        stream_key(seed, "photos"), toolbox, situation, weighting=toolbox.laplace.weighting
    )
    write_arrays(path, jac_sq_sum=np.asarray(jac_sq_sum))
    return jac_sq_sum


def holdout_quality(problem: Problem, train: TrainState) -> dict | None:
    """Image measures on the photos that were left out, or None if none were."""
    scene = problem.scene
    if not len(scene.test):
        return None
    num_rays = int(np.diff(scene.offsets)[scene.test].sum())
    with track(num_rays, f"measure on {len(scene.test)} photos left out", "rays") as bar:
        return evaluate_views(problem.render(train), scene, scene.test, progress_fn=bar.advance)
