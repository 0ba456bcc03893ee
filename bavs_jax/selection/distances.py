"""Distances between cameras and the maximum-minimum distance policy (Fig 5)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array

SURVIVOR_SHARE = 0.17  # of the candidates, as in the paper's Table 4, which leaves 43 of 250
SHARE_SHRINK, SHARE_MAX_SHRINKS = 0.95, 180  # radii of a share end at 1e-4 of where they began
DEFAULT_SHRINK = 0.8
GAP_SHRINK = 0.95  # of the least distance in `far_from_chosen`
DEFAULT_MAX_SHRINKS = 32  # radii end at 0.8^32 < 1e-3 of where they began


class Radii(NamedTuple):
    """How far apart the max-min distance filter keeps cameras, scene units."""

    min_train_distance: Array  # [] from a candidate to every training view
    min_candidate_distance: Array  # [] between two candidates


class FilterInfo(NamedTuple):
    """What the max-min distance filter did."""

    num_survivors: jax.Array  # [] int32
    shrinks: jax.Array  # [] int32, how often both radii were shrunk
    radii: Radii  # the radii of the last attempt
    fell_back: jax.Array  # [] bool, too few survived every attempt: all of `mask` was kept


def pairwise_distances(a: jax.Array, b: jax.Array) -> jax.Array:
    """Euclidean distances `|a_n - b_m|`, [..., N, M] of points [..., N, 3] and [..., M, 3]."""
    # By differences, not |a|^2 + |b|^2 - 2 a.b: that loses near neighbours to cancellation.
    difference = a[..., :, None, :] - b[..., None, :, :]
    return jnp.sqrt(jnp.sum(difference * difference, axis=-1))


def nearest_distances(points: jax.Array, others: jax.Array, is_valid: jax.Array) -> jax.Array:
    """Distance [C] of each point to the nearest valid one of others; infinity where none is valid.

    Args:
      points, others: [C, 3] and [V, 3], scene units.
      is_valid: [V] bool.
    """
    return masked_nearest(pairwise_distances(points, others), is_valid)


def masked_nearest(distances: jax.Array, is_valid: jax.Array) -> jax.Array:
    """Smallest of distances [C, V] over valid columns; [C], infinity where nothing is valid."""
    return jnp.min(jnp.where(is_valid, distances, jnp.inf), axis=-1, initial=jnp.inf)


def radii_for_share(
    positions: jax.Array,
    training_positions: jax.Array,
    is_training_view: jax.Array,
    mask: jax.Array,
    share: float | jax.Array,
    *,
    view_ids: jax.Array,
    centre: jax.Array,
) -> Radii:
    """The largest radii, both the same, with which the filter leaves a share of the candidates.

    Found from twice the median camera distance from the scene centre down, in steps of 0.95: a few
    more may be left than asked for. The paper names no radii, but what they leave (Table 4).

    Args:
      positions, training_positions, is_training_view, mask, view_ids: see `max_min_filter`.
      share: of the candidates in `mask`, in [0, 1].
      centre: [3] scene units.
    """
    cameras = jnp.concatenate([positions, training_positions])
    counts = jnp.concatenate([mask, is_training_view])
    distance = pairwise_distances(cameras, centre[None])[:, 0]
    start = 2.0 * jnp.nanmedian(jnp.where(counts, distance, jnp.nan))
    _, info = max_min_filter(
        positions,
        training_positions,
        is_training_view,
        mask,
        jnp.ceil(share * mask.sum()),
        view_ids=view_ids,
        radii=Radii(start, start),
        shrink=SHARE_SHRINK,
        max_shrinks=SHARE_MAX_SHRINKS,
    )
    return info.radii


def max_min_filter(
    positions: jax.Array,
    training_positions: jax.Array,
    is_training_view: jax.Array,
    mask: jax.Array,
    num_wanted: int | jax.Array,
    *,
    view_ids: jax.Array,
    radii: Radii,
    shrink: float | jax.Array = DEFAULT_SHRINK,
    max_shrinks: int | jax.Array = DEFAULT_MAX_SHRINKS,
) -> tuple[jax.Array, FilterInfo]:
    """Candidates far from all training views and from each other (Fig 5).

    Visits candidates from the largest distance to their nearest training view down, ties to the
    smallest view id, and keeps one if it is at least `min_train_distance` from every training view
    and at least `min_candidate_distance` from every candidate kept before. While fewer than
    `num_wanted` survive, multiplies both radii by `shrink` and begins again.

    Args:
      positions: [C, 3] candidates, scene units.
      training_positions: [V, 3] scene units.
      is_training_view: [V] bool.
      mask: [C] bool, which candidates may survive.
      num_wanted: how many have to survive at least.
      view_ids: [C] int, distinct.
      radii: what to begin with, scene units, >= 0.
      shrink: factor in (0, 1).
      max_shrinks: bound of the loop, >= 0; beyond it all of `mask` is kept and
        `FilterInfo.fell_back` says so (also where `num_wanted` is more than `mask` has).

    Returns:
      survivors [C] bool, within `mask`, and `FilterInfo`.

    Everything but shapes may be traced. One attempt costs O(C) per survivor, and an attempt that
    fails has fewer than `num_wanted` of them.
    """
    nearest = nearest_distances(positions, training_positions, is_training_view)
    visit = jnp.lexsort((view_ids, -nearest))
    points, nearest, allowed = positions[visit], nearest[visit], mask[visit]

    def radii_after(shrinks):
        factor = jnp.asarray(shrink, nearest.dtype) ** shrinks
        return Radii(*(factor * r for r in radii))

    def attempt(state):
        _, num_attempts = state
        tried = radii_after(num_attempts)

        # One step for each candidate kept, not for each visited: the next one to keep is the
        # first, in order of visit, that is still far enough from all kept before.
        def keep_next(state):
            kept, eligible = state
            first = jnp.argmax(eligible)
            apart = pairwise_distances(points, points[first][None])[:, 0]
            eligible = eligible & (apart >= tried.min_candidate_distance)
            return kept.at[first].set(True), eligible.at[first].set(False)

        start = (jnp.zeros_like(allowed), allowed & (nearest >= tried.min_train_distance))
        kept, _ = jax.lax.while_loop(lambda state: state[1].any(), keep_next, start)
        return kept, num_attempts + 1

    def goes_on(state):
        kept, num_attempts = state
        too_few = (num_attempts == 0) | (kept.sum() < num_wanted)
        return too_few & (num_attempts <= max_shrinks)

    kept, num_attempts = jax.lax.while_loop(
        goes_on, attempt, (jnp.zeros_like(allowed), jnp.zeros((), jnp.int32))
    )
    fell_back = kept.sum() < num_wanted
    kept = jnp.where(fell_back, allowed, kept)
    info = FilterInfo(
        num_survivors=kept.sum(),
        shrinks=num_attempts - 1,
        radii=radii_after(num_attempts - 1),
        fell_back=fell_back,
    )
    return jnp.zeros_like(mask).at[visit].set(kept), info


def far_from_chosen(
    nearest, mask, num_wanted: int, *, shrink: float = GAP_SHRINK, max_shrinks: int = 256
) -> np.ndarray:
    """Candidates at least tau from all chosen views, [C] bool within `mask`.

    Tau starts at the largest gap, the largest of the distances, and is multiplied by `shrink` until
    as many as are wanted remain.

    Args:
      nearest: [C] distance of each candidate to the nearest chosen view; infinity where there is
        none.
      mask: [C] bool.
      num_wanted: how many have to remain; all of `mask` do if it has no more, or if `max_shrinks`
        are not enough.
      shrink: in (0, 1).
    """
    nearest, mask = np.asarray(nearest, np.float64), np.asarray(mask)
    tau = nearest[mask].max(initial=0.0)
    for _ in range(max_shrinks):
        far = mask & (nearest >= tau)
        if far.sum() >= num_wanted:
            return far
        tau *= shrink
    return mask


def farthest_ranks(
    positions: jax.Array,
    training_positions: jax.Array,
    is_training_view: jax.Array,
    mask: jax.Array,
    num_picks: int | jax.Array,
    *,
    view_ids: jax.Array,
) -> jax.Array:
    """Order in which farthest-view sampling would pick the candidates.

    Each pick is the candidate whose nearest training view or earlier pick is farthest, ties to
    the smallest view id.

    Args:
      mask: [C] bool, which candidates may be picked.
      num_picks: how many to pick; no more than `mask` has are picked.
      positions, training_positions, is_training_view, view_ids: see `max_min_filter`.

    Returns:
      [C] int32: 0 for the first pick, 1 for the next, ...; C for those never picked.
    """
    nearest = nearest_distances(positions, training_positions, is_training_view)
    by_id = jnp.argsort(view_ids)  # argmax takes the first of equals: the smallest id
    points, start = positions[by_id], jnp.where(mask, nearest, -jnp.inf)[by_id]

    def pick(step, state):
        ranks, nearest = state
        farthest = jnp.argmax(nearest)
        apart = pairwise_distances(points, points[farthest][None])[:, 0]
        nearest = jnp.minimum(nearest, apart).at[farthest].set(-jnp.inf)
        return ranks.at[farthest].set(step), nearest

    num = mask.shape[0]
    never = jnp.full((num,), num, jnp.int32)
    last = jnp.minimum(num_picks, mask.sum())
    ranks, _ = jax.lax.fori_loop(0, last, pick, (never, start))
    return never.at[by_id].set(ranks)


def uniform_ranks(positions, view_ids):
    """Place [C] of each camera in the farthest-point order of all of them, 0 .. C - 1.

    The order begins with the camera nearest to their mean position, the middle of a front-facing
    capture, and goes on with the one farthest from all before it; ties go to the smallest view id.

    Args:
      positions: [C, 3] scene units.
      view_ids: [C] int, distinct.
    """
    by_id = jnp.argsort(view_ids)  # also the order of summing, so that no other order matters
    points = positions[by_id]
    first = jnp.argmin(pairwise_distances(points, points.mean(axis=0)[None])[:, 0])
    later = farthest_ranks(
        points,
        points[first][None],
        jnp.ones(1, bool),
        jnp.arange(len(points)) != first,
        len(points) - 1,
        view_ids=view_ids[by_id],
    )
    ranks = (later + 1).at[first].set(0)
    return jnp.zeros_like(ranks).at[by_id].set(ranks)
