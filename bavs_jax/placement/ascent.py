"""Better poses near those that were chosen: ascent of an acquisition over position and gaze."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, take
from bavs_jax.placement.proposals import aim
from bavs_jax.progress import Progress
from bavs_jax.selection.context import Context, mark_picked
from bavs_jax.selection.policy import Policy

DIFFERENCE = 0.25  # of a step, between the two poses whose scores give one derivative
STRIDES = (0.5, 1.0, 2.0)  # of a step along the gradient that are tried
FIRST_STEP = 0.5  # of what a pose may move


class PoseScores(Protocol):
    """Scores [n] of poses `trials` [n, 3, 4] in place of number `number` of `chosen` [k, 3, 4]."""

    def __call__(self, number: int, chosen: np.ndarray, trials: np.ndarray, /) -> Array: ...


class Ascent(NamedTuple):
    """Poses that were moved, and what it was worth."""

    poses: np.ndarray  # [k, 3, 4]
    before: np.ndarray  # [k] score of each where it was chosen, the others chosen too
    after: np.ndarray  # [k] where it is now, the others being where they are now

    def in_words(self) -> str:
        """Such as `by +3%, +0%, +12%`."""
        rises = [f"{y / x - 1:+.0%}" for x, y in zip(self.before, self.after) if x > 0.0]
        return f"by {', '.join(rises)}"


def moved(pose, moves, *, up, length: float, angle: float) -> np.ndarray:
    """Upright poses [n, 3, 4] beside a pose [3, 4].

    Args:
      pose: OpenGL axes, scene units.
      moves: [n, 5] to the right, up and back along the camera's own axes, in `length`s; and by how
        much the gaze goes up and to the right, in `angle`s.
      up: [3] unit.
      length: scene units.
      angle: radians, below a quarter turn.
    """
    pose, moves = np.asarray(pose, np.float64), np.asarray(moves, np.float64)
    right, above, back, position = (pose[:, i] for i in range(4))
    positions = position + length * moves[:, :3] @ pose[:, :3].T
    rise, turn = np.tan(angle * moves[:, 3:]).T
    ahead = -back + rise[:, None] * above + turn[:, None] * right
    return aim(positions, positions + ahead, up)


def ascend(
    poses,
    score_fn: PoseScores,
    allowed_fn: Callable[[np.ndarray], np.ndarray],
    *,
    up,
    length: float,
    angle: float,
    steps: int,
    progress_fn: Progress | None = None,
) -> Ascent:
    """Moves each pose in turn to where its score is larger, given the others.

    The gradient over the five `moves` comes from central differences: a score is the mean of an
    image, or a sum over vertices, whose samples jump from cell to cell as a camera moves, which
    exact derivatives do not see. The best of the poses along the gradient, and of those looked at
    for it, is taken if it scores more; else the step is halved. No score ever falls.

    Args:
      poses: [k, 3, 4] scene units.
      score_fn: what is made large.
      allowed_fn: which of poses [n, 3, 4] a camera may take, [n] bool.
      up: [3] unit.
      length, angle: as far as a pose may go from where it begins, along each axis, scene units and
        radians.
      steps: of each pose.
      progress_fn: called with 1 after each step of a pose.
    """
    poses, start = np.array(poses, np.float64), np.array(poses, np.float64)
    places, step = np.zeros((len(poses), 5)), np.full(len(poses), FIRST_STEP)
    before = np.array([_score(score_fn, n, poses, poses[n : n + 1])[0] for n in range(len(poses))])

    def look(number, moves):
        """Scores of allowed moves, minus infinity elsewhere; and the poses."""
        trials = moved(start[number], moves, up=up, length=length, angle=angle)
        scores = np.full(len(moves), -np.inf)
        allowed = np.flatnonzero(allowed_fn(trials))
        if len(allowed):
            scores[allowed] = _score(score_fn, number, poses, trials[allowed])
        return scores, trials

    for _ in range(steps):
        for number in range(len(poses)):
            here = places[number]
            (now,) = _score(score_fn, number, poses, poses[number : number + 1])
            apart = DIFFERENCE * step[number] * np.eye(5)
            moves = np.clip(np.concatenate([here + apart, here - apart]), -1.0, 1.0)
            scores, trials = look(number, moves)
            gradient = _gradient(moves, scores, here, now)
            if gradient.any():
                along = step[number] * gradient / np.linalg.norm(gradient)
                strides = np.clip(here + np.outer(STRIDES, along), -1.0, 1.0)
                more = look(number, strides)
                moves = np.concatenate([moves, strides])
                scores, trials = (np.concatenate(x) for x in zip((scores, trials), more))
            best = int(scores.argmax())
            if scores[best] > now:
                places[number], poses[number] = moves[best], trials[best]
            else:
                step[number] /= 2.0
            if progress_fn is not None:
                progress_fn(1)
    after = [_score(score_fn, n, poses, poses[n : n + 1])[0] for n in range(len(poses))]
    return Ascent(poses, before, np.array(after))


def _score(score_fn: PoseScores, number: int, poses, trials) -> np.ndarray:
    return np.asarray(score_fn(number, poses, trials), np.float64)


def _gradient(moves, scores, here, now: float) -> np.ndarray:
    """Differences over each axis, [5]; a side that is not allowed gives way to where one is."""
    num = len(here)
    gradient = np.zeros(num)
    for axis in range(num):
        ends = [(moves[i, axis], scores[i]) for i in (axis, axis + num)]
        ends = [end if np.isfinite(end[1]) else (here[axis], now) for end in ends]
        (x1, y1), (x0, y0) = ends
        gradient[axis] = (y1 - y0) / (x1 - x0) if x1 != x0 else 0.0
    return gradient


def policy_scores(
    policy: Policy, key, cameras: Cameras, context_fn: Callable[[Cameras, np.ndarray], Context]
) -> PoseScores:
    """A policy's own score of free poses, the other chosen ones being picked.

    Args:
      policy: whose score of a camera depends on no other candidate's.
      key: for its scores.
      cameras: [C] all candidates; poses are of cameras like the first one.
      context_fn: from C + k - 1 + n cameras, of which those in a mask may be picked, to the
        policy's context.
    """

    def score_fn(number, chosen, trials):
        others = np.delete(chosen, number, axis=0)
        poses = np.concatenate([cameras.world_from_cam, others, trials]).astype(np.float32)
        like = take(jax.tree.map(np.asarray, cameras), np.zeros(len(poses), int))
        picked, mask = np.arange(len(poses)) >= len(cameras), np.zeros(len(poses), bool)
        mask[len(cameras) + len(others) :] = True
        context = context_fn(like.replace(world_from_cam=poses), mask)
        for index in np.flatnonzero(picked & ~mask):
            context = mark_picked(context, int(index))
            if policy.update_fn is not None:
                context = policy.update_fn(context, int(index))
        return np.asarray(policy.score_fn(key, context))[mask]

    return score_fn
