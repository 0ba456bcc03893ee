"""Collects allowed poses from any source of draws, and counts what was turned away and why."""

import dataclasses
from collections.abc import Callable

import numpy as np

from bavs_jax.placement.clearance import REASONS


class PlacementError(ValueError):
    """Too few places for a camera: one line that names the reasons and the fix."""


@dataclasses.dataclass(frozen=True)
class Proposals:
    """Poses that a camera may take, and how many others were drawn."""

    poses: np.ndarray  # [N, 3, 4] scene units
    num_drawn: int
    dropped: dict[str, int]  # by `REASONS`

    def in_words(self) -> str:
        """Such as `40 drawn, 30 kept; dropped: 10 inside matter`."""
        reasons = [f"{num} {reason}" for reason, num in self.dropped.items() if num]
        kept = f"{self.num_drawn} drawn, {len(self.poses)} kept"
        return f"{kept}; dropped: {', '.join(reasons) if reasons else 'none'}"


def collect_poses(
    draw_fn: Callable[[int], np.ndarray],
    judge_fn: Callable[[np.ndarray], np.ndarray],
    num: int,
    *,
    max_laps: int = 16,
) -> Proposals:
    """Draws until `num` poses are allowed, or `max_laps` times.

    Args:
      draw_fn: from the number of a lap to poses [n, 3, 4]; none at all ends the laps.
      judge_fn: poses [n, 3, 4] -> reasons [n] int, an index of `REASONS` or -1: allowed.
      num: how many are wanted.
      max_laps: how often to draw at most.

    Returns:
      At most `num` allowed poses, in the order of drawing. Draws after the last of them count as
      not drawn.
    """
    kept: list[np.ndarray] = [np.zeros((0, 3, 4))]
    reasons: list[np.ndarray] = [np.zeros(0, int)]
    num_kept = 0
    for lap in range(max_laps):
        poses = draw_fn(lap)
        if not len(poses):
            break
        reason = np.asarray(judge_fn(poses))
        enough = np.cumsum(reason < 0) <= num - num_kept
        poses, reason = poses[enough], reason[enough]
        kept.append(poses[reason < 0])
        reasons.append(reason)
        num_kept += len(kept[-1])
        if num_kept >= num:
            break
    every = np.concatenate(reasons)
    counts = {name: int((every == i).sum()) for i, name in enumerate(REASONS)}
    return Proposals(np.concatenate(kept), len(every), counts)


def check_enough(proposals: Proposals, num_needed: int, *, fixes: dict[str, str]) -> None:
    """Raises PlacementError if there are too few poses, with the fix for the main reason.

    Args:
      num_needed: how many there must be.
      fixes: what helps against each of `REASONS`, and against "" where nothing was dropped.
    """
    if len(proposals.poses) >= num_needed:
        return
    main = max(proposals.dropped, key=proposals.dropped.__getitem__)
    fix = fixes[main if proposals.dropped[main] else ""]
    raise PlacementError(
        f"candidates: {num_needed} places for a camera are needed, but of "
        f"{proposals.in_words()}: {fix}"
    )
