"""One field on all photos of a capture, and the batch of candidates that a policy chooses by it."""

from __future__ import annotations

import dataclasses
import pathlib
import time
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.active import round_keys
from bavs_jax.cameras import Cameras, num_pixels, reduced_cameras, take
from bavs_jax.candidates import Candidates
from bavs_jax.pixel_table import num_training_pixels, view_mask
from bavs_jax.policy_inputs import make_candidate_curvature_fn
from bavs_jax.scenes import Scene, SceneError
from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.context import SelectionError, make_context
from bavs_jax.selection.information import (
    Information,
    add_curvature,
    candidate_gains,
    log_det_gain,
    make_cached_curvature_fn,
)
from bavs_jax.selection.policies import get_policy
from bavs_jax.selection.worth import Worth, worth_along
from bavs_jax.training.checkpoints import Checkpoints
from bavs_jax.training.fit import fit
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.model import RECONSTRUCTION, Acquired
from bavs_jax.uncertainty.models.laplace import training_curvature
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments.build import Problem, run_key, stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.configs import capture
from experiments.evaluate import evaluate_views, evenly_spaced
from experiments.files import read_arrays, write_arrays
from experiments.runtime import track, warn
from experiments.suggest.places import Options

NUM_AT_ONCE = 8  # candidates between two steps of the progress bar
NUM_COMPARED = 8  # photos whose repetition is what new views are compared with


# --- the field -------------------------------------------------------------------------------


def default_config():
    """The config of a field that is trained once on every photo of a capture."""
    config = capture.get_config()
    config.loader, config.image_size = "auto", 135
    config.holdout = 0  # photos left out of training, to measure the field on
    config.train.num_steps = 2400
    config.lpips_net = ""
    config.checkpoint_seconds = 20.0
    # Every photo's rays weigh in the curvature through a uniform subset, scaled up.
    config.uncertainty.max_rays = 40_000
    return config


def all_for_training(scene: Scene, holdout: int) -> Scene:
    """The scene with every view in the pool, but for `holdout` evenly spaced ones that are only
    measured."""
    views = np.arange(scene.num_views, dtype=np.int32)
    if not 0 <= holdout <= scene.num_views - 2:
        raise SceneError(
            f"{scene.name}: --holdout={holdout} of {scene.num_views} photos leaves fewer than 2 "
            "to train on: give a smaller number"
        )
    test = evenly_spaced(views, holdout) if holdout else views[:0]
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
    setup = problem.setup
    acquired = Acquired(train, problem.table, is_training, num_rays=0, label="photos")
    jac_sq_sum = training_curvature(
        stream_key(seed, "photos"), setup, acquired, weighting=setup.laplace.weighting
    )
    write_arrays(path, jac_sq_sum=np.asarray(jac_sq_sum))
    return jac_sq_sum


def holdout_quality(problem: Problem, train: TrainState) -> dict | None:
    """Image measures on the photos that were left out, or None if none were."""
    scene = problem.scene
    if not len(scene.test):
        return None
    rays_per_pixel = problem.config.rays_per_pixel
    num_rays = rays_per_pixel * int(np.diff(scene.offsets)[scene.test].sum())
    with track(num_rays, f"measure on {len(scene.test)} photos left out", "rays") as bar:
        return evaluate_views(
            problem.render(train),
            scene,
            scene.test,
            rays_per_pixel=rays_per_pixel,
            progress_fn=bar.advance,
        )


# --- the choice ------------------------------------------------------------------------------


class Suggestion(NamedTuple):
    """The chosen candidates, in the order of picking."""

    selected: np.ndarray  # [k] indices of candidates
    scores: np.ndarray  # [C] Eq 15 for all candidates
    info: SelectionInfo
    worth: Worth  # of what each pick tells, and the best one left would tell, nats
    photo_gain: float  # what one more photo from where there is one would tell, nats


def check_policy(name: str) -> None:
    """Raises SelectionError for a policy that is unknown or needs more than one field and poses."""
    policy = get_policy(name)
    if "true_error_fn" in policy.needs:
        reason = "needs the candidates' photos, which do not exist yet"
    elif policy.field_kind != RECONSTRUCTION:
        reason = f"needs a field of kind {policy.field_kind!r}"
    else:
        return
    raise SelectionError(f"--policy: {name!r} {reason}; use another policy, such as bavs")


def photo_rays(problem: Problem) -> int:
    """R of Eq 13: the rays of all training photos that are not masked."""
    return int(num_training_pixels(problem.scene, problem.scene.pool).sum())


def photos_acquired(problem: Problem, train: TrainState, cameras: Cameras) -> Acquired:
    """All photos are trained on; C cameras are candidates."""
    is_training = view_mask(problem.table, problem.scene.pool)
    return Acquired(
        train,
        problem.table,
        is_training,
        photo_rays(problem),
        candidates=cameras,
        label="candidates",
    )


def photo_information(
    problem: Problem, train: TrainState, jac_sq_sum, cameras: Cameras, scale: float
) -> Information:
    """The posterior after all photos, and what each of C cameras' photos would add to it.

    The sum of Eq 13 knows no colours, so a pose is enough.
    """
    setup = problem.setup
    acquired = photos_acquired(problem, train, cameras)
    precision = posterior_precision(
        jac_sq_sum,
        num_rays=acquired.num_rays,
        prior_weight=setup.laplace.prior_weight,
        weighting=setup.laplace.weighting,
    )
    return Information(
        precision,
        make_cached_curvature_fn(
            make_candidate_curvature_fn(setup, acquired, cameras, scale),
            num_vertices=setup.grid.num_vertices,
            group_size=setup.curvature.group_size,
        ),
    )


def information_gains(information: Information, num: int, label: str) -> np.ndarray:
    """What each of `num` cameras would tell, `sum log(1 + h / H)`, nats [num]."""
    gains = []
    with track(num, label, "views") as bar:
        for indices in np.array_split(np.arange(num), -(-num // NUM_AT_ONCE)):
            gains.append(candidate_gains(information, indices, gain=log_det_gain))
            bar.advance(len(indices))
    return np.concatenate(gains)


def suggest(
    problem: Problem,
    train: TrainState,
    jac_sq_sum,
    cameras: Cameras,
    centre,
    options: Options,
) -> Suggestion:
    """Chooses `num_views` candidates and follows what the best one left would still tell.

    Args:
      problem, train, jac_sq_sum: the field, and the curvature of the photos.
      cameras: C candidates.
      centre: [3] what the photos look at, scene units.
      options: what the user asked for.

    Raises:
      SelectionError: the policy cannot choose.
    """
    scale, policy = options.score_scale, get_policy(options.policy)
    small = reduced_cameras(cameras, scale)
    render = problem.render(train, jac_sq_sum, photo_rays(problem))
    with track(int(num_pixels(small).sum()), f"score {len(cameras)} candidates", "rays") as bar:
        scores = mean_uncertainty(render, small, chunk=RENDER_CHUNK, progress_fn=bar.advance)
    information = photo_information(problem, train, jac_sq_sum, cameras, scale)
    gains = information_gains(information, len(cameras), "what candidates would tell")

    source_key, choose_key = jax.random.split(stream_key(options.seed, "choice"))
    acquired = photos_acquired(problem, train, cameras)
    fields = {"mean_uncertainty_fn": lambda rows, picked: scores[rows], "information": information}
    if policy.uncertainty != "laplace" or not policy.needs <= fields.keys():
        everyone = Candidates(cameras, np.arange(len(cameras)), np.ones(len(cameras), bool))
        fields |= problem.inputs(policy, source_key, acquired, everyone).fields
    context = make_context(
        cameras.positions,
        training_positions=np.asarray(problem.table.cameras.positions),
        is_training_view=acquired.is_training_view,
        centre=centre,
        **fields,
    )
    selected, info = acquire(policy, choose_key, context, options.num_views)

    worth = worth_along(
        information,
        selected,
        gains,
        add_fn=add_curvature,
        score_fn=partial(candidate_gains, gain=log_det_gain),
    )
    photos = take(problem.scene.cameras, evenly_spaced(problem.scene.pool, NUM_COMPARED))
    again = photo_information(problem, train, jac_sq_sum, photos, scale)
    photo_gains = information_gains(again, len(photos), "what photos would tell again")
    return Suggestion(selected, scores, info, worth, float(np.median(photo_gains)))
