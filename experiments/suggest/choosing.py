"""Scores candidates, chooses a batch by a policy, and finds what would be left to gain."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.cameras import Cameras, num_pixels, reduced_cameras, take
from bavs_jax.candidates import Candidates
from bavs_jax.pixel_table import num_training_pixels, view_mask
from bavs_jax.policy_inputs import make_candidate_curvature_fn
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
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import RECONSTRUCTION, Situation
from bavs_jax.uncertainty.posterior import posterior_precision
from bavs_jax.uncertainty.scoring import mean_uncertainty
from experiments.build import RENDER_CHUNK, Problem
from experiments.evaluate import spread_evenly
from experiments.keys import stream_key
from experiments.progress import track

NUM_AT_ONCE = 8  # candidates between two steps of the progress bar
NUM_COMPARED = 8  # photos whose repetition is what new views are compared with


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


def make_score_fn(problem: Problem, train: TrainState, cameras: Cameras, scale: float) -> Callable:
    """Makes `score(jac_sq_sum, indices, progress_fn=None) -> [n]`, Eq 15 at a reduced size."""
    num_rays = photo_rays(problem)

    def score(jac_sq_sum, indices, progress_fn=None):
        small = reduced_cameras(take(cameras, np.asarray(indices)), scale)
        chunk_fn = problem.render(train, jac_sq_sum, num_rays)
        return mean_uncertainty(chunk_fn, small, chunk=RENDER_CHUNK, progress_fn=progress_fn)

    return score


def photo_rays(problem: Problem) -> int:
    """R of Eq 13: the rays of all training photos that are not masked."""
    return int(num_training_pixels(problem.scene, problem.scene.pool).sum())


def photo_situation(problem: Problem, train: TrainState, cameras: Cameras) -> Situation:
    """All photos are trained on; C cameras are candidates."""
    is_training = view_mask(problem.table, problem.scene.pool)
    return Situation(
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
    toolbox = problem.toolbox
    situation = photo_situation(problem, train, cameras)
    precision = posterior_precision(
        jac_sq_sum,
        num_rays=situation.num_rays,
        prior_weight=toolbox.laplace.prior_weight,
        weighting=toolbox.laplace.weighting,
    )
    return Information(
        precision,
        make_cached_curvature_fn(
            make_candidate_curvature_fn(toolbox, situation, cameras, scale),
            num_vertices=toolbox.grid.num_vertices,
            group_size=toolbox.curvature.group_size,
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
    *,
    policy: str,
    num_views: int,
    centre,
    scale: float,
    seed: int,
) -> Suggestion:
    """Chooses `num_views` candidates and follows what the best one left would still tell.

    Args:
      problem, train, jac_sq_sum: the field, and the curvature of the photos.
      cameras: C candidates.
      policy: a name in `POLICIES`.
      num_views: k.
      centre: [3] what the photos look at, scene units.
      scale: of candidate images, for scores.
      seed: of policies that draw.

    Raises:
      SelectionError: the policy cannot choose.
    """
    scene = problem.scene
    score = make_score_fn(problem, train, cameras, scale)
    num_rays = int(num_pixels(reduced_cameras(cameras, scale)).sum())
    with track(num_rays, f"score {len(cameras)} candidates", "rays") as bar:
        scores = score(jac_sq_sum, np.arange(len(cameras)), bar.advance)
    information = photo_information(problem, train, jac_sq_sum, cameras, scale)
    gains = information_gains(information, len(cameras), "what candidates would tell")

    chooser = get_policy(policy)
    source_key, choose_key = jax.random.split(stream_key(seed, "choice"))
    situation = photo_situation(problem, train, cameras)
    fields = {"mean_uncertainty_fn": lambda rows, picked: scores[rows], "information": information}
    if chooser.uncertainty != "laplace" or not chooser.needs <= fields.keys():
        everyone = Candidates(cameras, np.arange(len(cameras)), np.ones(len(cameras), bool))
        fields |= problem.inputs(chooser, source_key, situation, everyone).fields
    context = make_context(
        cameras.positions,
        training_positions=np.asarray(problem.table.cameras.positions),
        is_training_view=situation.is_training_view,
        centre=centre,
        **fields,
    )
    selected, info = acquire(chooser, choose_key, context, num_views)

    worth = worth_along(
        information,
        selected,
        gains,
        add_fn=add_curvature,
        score_fn=partial(candidate_gains, gain=log_det_gain),
    )
    photos = take(scene.cameras, spread_evenly(scene.pool, NUM_COMPARED))
    again = photo_information(problem, train, jac_sq_sum, photos, scale)
    photo_gains = information_gains(again, len(photos), "what photos would tell again")
    return Suggestion(selected, scores, info, worth, float(np.median(photo_gains)))
