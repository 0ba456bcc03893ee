"""What is still to be gained: the best score left after each pick of a batch."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.selection.context import SourceFn

State = TypeVar("State")  # what scores follow from, such as a `jac_sq_sum`


class Worth(NamedTuple):
    """Scores along a batch of k picks; only reports."""

    picked: np.ndarray  # [k] score of each pick, given those before it
    best_left: np.ndarray  # [k + 1] best score of the rest, before and after each pick; NaN: none


def worth_along(
    state: State,
    picks,
    scores,
    *,
    add_fn: Callable[[State, int], State],
    score_fn: Callable[[State, np.ndarray], Array],
    batch: int = 4,
) -> Worth:
    """Scores of the picks and of the best candidate left, as if the picks had been taken.

    A pick's curvature needs its pose only, so it can be added before there is a photo. More
    curvature never makes anything more uncertain; hence a score from earlier is an upper bound of
    the score now, and the best one is found by scoring only those whose bound is above it
    (the accelerated greedy of Minoux 1978).

    Args:
      state: what the scores follow from, before the first pick.
      picks: [k] int, candidates in the order of picking.
      scores: [C] score of each candidate before the first pick; NaN: not allowed.
      add_fn: the state after a candidate has been taken.
      score_fn: scores [n] of n candidates, which may only fall as views are added.
      batch: candidates scored at once.
    """
    bound = np.array(scores, np.float64)
    picked: list[float] = []
    best_left = [_largest(bound)]
    for pick in picks:
        picked.append(bound[pick] if not picked else float(score_fn(state, np.array([pick]))[0]))
        state = add_fn(state, int(pick))
        bound[pick] = np.nan
        best_left.append(_refresh_largest(bound, lambda rows, s=state: score_fn(s, rows), batch))
    return Worth(np.array(picked), np.array(best_left))


def _largest(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.max()) if len(known) else float("nan")


def _refresh_largest(bound: np.ndarray, score_fn: SourceFn, batch: int) -> float:
    """The largest score now; tightens the upper bounds [C] in place where it looked."""
    stale = ~np.isnan(bound)
    while stale.any():
        rows = np.flatnonzero(stale)
        rows = rows[np.argsort(-bound[rows], kind="stable")][:batch]
        fresh = bound[~stale & ~np.isnan(bound)]
        if len(fresh) and fresh.max() >= bound[rows[0]]:
            break
        # Rounding may lift a score above its bound; the bound is right.
        bound[rows] = np.minimum(bound[rows], np.asarray(score_fn(rows), np.float64))
        stale[rows] = False
    return _largest(bound)
