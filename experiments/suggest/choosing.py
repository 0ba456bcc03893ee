"""Scores candidates, chooses a batch by a policy, and finds what would be left to gain."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras, take
from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.context import SelectionError, make_context
from bavs_jax.selection.policies import get_policy
from bavs_jax.selection.worth import Worth, worth_along
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.scoring import mean_uncertainty, reduced_cameras
from experiments.build import RENDER_CHUNK, Problem
from experiments.progress import track

SUPPORTED_NEEDS = {"mean_uncertainty_fn"}


class Suggestion(NamedTuple):
    """The chosen candidates, in the order of picking."""

    selected: np.ndarray  # [k] indices of candidates
    scores: np.ndarray  # [C] Eq 15 for all candidates
    info: SelectionInfo
    worth: Worth


def check_policy(name: str) -> None:
    """Raises SelectionError for a policy that is unknown or needs more than a curvature."""
    policy = get_policy(name)
    more = sorted(policy.needs - SUPPORTED_NEEDS)
    if policy.uncertainty != "laplace":
        more.append(policy.uncertainty)
    if more:
        raise SelectionError(
            f"--policy: {name!r} needs {', '.join(more)}, which one field has not; "
            "use another policy, such as bavs"
        )


def make_score_fn(problem: Problem, train: TrainState, cameras: Cameras, scale: float) -> Callable:
    """Makes `score(jac_sq_sum, indices, progress_fn=None) -> [n]`, Eq 15 at a reduced size."""
    num_rays = photo_rays(problem)

    def score(jac_sq_sum, indices, progress_fn=None):
        small = reduced_cameras(take(cameras, np.asarray(indices)), scale)
        chunk_fn = problem.render(train, jac_sq_sum, num_rays)
        return mean_uncertainty(chunk_fn, small, chunk=RENDER_CHUNK, progress_fn=progress_fn)

    return score


def photo_rays(problem: Problem) -> int:
    """R of Eq 13: the rays of all training photos."""
    return int(np.diff(problem.scene.offsets)[problem.scene.pool].sum())


def make_add_fn(problem: Problem, train: TrainState, cameras: Cameras, scale: float) -> Callable:
    """Makes `add(jac_sq_sum, index) -> jac_sq_sum` with a candidate's photo in it.

    The sum of Eq 13 knows no colours, so a pose is enough. It runs over the pixels of a reduced
    image and is scaled up to the number of pixels that the photo would have.
    """
    small = reduced_cameras(cameras, scale)
    table = problem.table

    def add(jac_sq_sum, index):
        # The candidate stands in for view 0, so that all arrays keep the shapes of the photos'
        # table and nothing is compiled anew; its pixels are not looked at.
        stand_in = jax.tree.map(
            lambda x, y: jnp.asarray(x).at[0].set(y[index]), table.cameras, small
        )
        num = int(np.prod(np.asarray(small.sizes)[index]))
        added = problem.curvature(
            train,
            table.replace(cameras=stand_in),
            np.zeros(num, np.int32),
            np.arange(num, dtype=np.int32),
        )
        whole = float(np.prod(np.asarray(cameras.sizes)[index]))
        return jac_sq_sum + (whole / num) * added

    return add


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
    """Chooses `num_views` candidates and follows the score of the best one left.

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
    num_rays = int(np.prod(np.asarray(reduced_cameras(cameras, scale).sizes), axis=-1).sum())
    with track(num_rays, f"score {len(cameras)} candidates", "rays") as bar:
        scores = score(jac_sq_sum, np.arange(len(cameras)), bar.advance)
    is_training = np.zeros(scene.num_views, bool)
    is_training[scene.pool] = True
    context = make_context(
        cameras.positions,
        training_positions=np.asarray(scene.cameras.positions),
        is_training_view=is_training,
        centre=centre,
        mean_uncertainty_fn=lambda indices, picked: scores[indices],
    )
    key = jax.random.fold_in(jax.random.key(seed), 1)
    selected, info = acquire(get_policy(policy), key, context, num_views)

    add = make_add_fn(problem, train, cameras, scale)
    with track(num_views, "what is left to gain", "views") as bar:

        def add_and_report(state, index):
            state = jax.block_until_ready(add(state, index))
            bar.advance()
            return state

        worth = worth_along(jac_sq_sum, selected, scores, add_fn=add_and_report, score_fn=score)
    return Suggestion(selected, scores, info, worth)
