"""From scores to a batch of views: the jitted selector and the driver of every policy."""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.selection import SelectionError
from bavs_jax.selection.context import Context, mark_picked
from bavs_jax.selection.distances import (
    SURVIVOR_SHARE,
    FilterInfo,
    Radii,
    farthest_ranks,
    max_min_filter,
    nearest_distances,
    radii_for_share,
)
from bavs_jax.selection.information import BatchBound
from bavs_jax.selection.policy import MODES, Mode, Policy, UpdateFn


class SelectionInfo(NamedTuple):
    """Why a batch was chosen; only reports. Host arrays and numbers."""

    scores: np.ndarray  # [C] before the first pick; NaN where not scored
    selected_scores: np.ndarray  # [k] the score each had when it was picked
    nearest_training_distance: np.ndarray  # [k] of the picks, scene units
    survivors: np.ndarray  # [C] bool, what the filter left; all allowed ones without a filter
    filter: FilterInfo | None  # None without a filter
    farthest_overlap: int  # of the k picks, those that are among farthest-view's first k
    # Of the n survivors, those among farthest-view's first n. If n is close to k, and this close
    # to n, then the filter has chosen, not the score.
    survivors_farthest_overlap: int
    bound: BatchBound | None = None  # how far the batch can be from the best, where it is known


def top_k(scores: jax.Array, mask: jax.Array, view_ids: jax.Array, *, k: int) -> jax.Array:
    """Indices [k] of the largest scores in `mask` (Eq 15), best first; ties to the smallest id.

    Args:
      scores: [C] larger is better; not NaN within `mask`, anything outside.
      mask: [C] bool with at least k set.
      view_ids: [C] int, distinct.
      k: static, 1 .. C.
    """
    return jnp.lexsort((view_ids, -scores, ~mask))[:k]


def select_batch(
    scores: jax.Array,
    positions: jax.Array,
    mask: jax.Array,
    k: int,
    *,
    view_ids: jax.Array,
    training_positions: jax.Array,
    is_training_view: jax.Array,
    radii: Radii,
) -> tuple[jax.Array, jax.Array, FilterInfo]:
    """The paper's batch policy on given scores: max-min filter (Fig 5), then the k largest.

    Args:
      scores, k: see `top_k`.
      positions, mask, view_ids, training_positions, is_training_view, radii: see `max_min_filter`.

    Returns:
      selected [k] int from the largest score down, survivors [C] bool, `FilterInfo`.
    """
    survivors, info = max_min_filter(
        positions, training_positions, is_training_view, mask, k, view_ids=view_ids, radii=radii
    )
    return top_k(scores, survivors, view_ids, k=k), survivors, info


class SelectBatchFn(Protocol):
    """See `make_select_batch_fn`."""

    def __call__(
        self, scores: Array, ctx: Context, *, radii: Radii | None = None
    ) -> tuple[jax.Array, jax.Array, FilterInfo]: ...


def make_select_batch_fn(k: int) -> SelectBatchFn:
    """Jits `select_batch` for one batch size: filter and top-k in one function of fixed shapes.

    Runs take `acquire`: the same two steps compiled apart, since scores cost something and only
    those of the survivors are made, in between.

    Returns:
      `select_batch_fn(scores [C], ctx, radii=None)`, which gives what `select_batch` does; `radii`
      default to those that leave `SURVIVOR_SHARE` of the candidates. It raises SelectionError if a
      score in `ctx.mask` is NaN, or if k is more than `ctx.mask` has.
    """
    jitted = jax.jit(select_batch, static_argnums=3)

    def select_batch_fn(scores, ctx: Context, *, radii: Radii | None = None):
        _check_available(k, ctx.mask)
        return jitted(
            _checked_scores(scores, ctx),
            ctx.positions,
            ctx.mask,
            k,
            view_ids=ctx.view_ids,
            training_positions=ctx.training_positions,
            is_training_view=ctx.is_training_view,
            radii=_as_radii(radii, ctx, SURVIVOR_SHARE),
        )

    return select_batch_fn


# The jit boundary of `acquire`: policies score on the host, in streams of any form; what comes
# before and after is compiled once per number of candidates and views, and takes no `Context`,
# whose callables are new in every round.
_filter_fn = jax.jit(max_min_filter)
_ranks_fn = jax.jit(farthest_ranks)
_nearest_fn = jax.jit(nearest_distances)
_radii_fn = jax.jit(radii_for_share)
_top_k_fn = jax.jit(top_k, static_argnames="k")


def acquire(
    policy: Policy,
    key: jax.Array,
    ctx: Context,
    k: int,
    *,
    radii: Radii | None = None,
    survivor_share: float = SURVIVOR_SHARE,
    mode: Mode | None = None,
    distance_filter: bool | None = None,
) -> tuple[np.ndarray, SelectionInfo]:
    """Chooses the next k views by a policy: filter (Fig 5), then scores, then the batch.

    The filter goes first, so that only its survivors are scored: the saving of the paper's
    Table 4. "top_k" scores once and takes the k largest; "greedy" scores, takes the largest,
    updates, and scores what is left again. Ties go to the smallest view id.

    Args:
      policy: an entry of `POLICIES`.
      key: random key; in greedy mode every scoring gets the same one, so that picks differ by
        what was picked before and not by noise.
      ctx: candidates and sources of scores.
      k: batch size, 1 .. the number of candidates in `ctx.mask`.
      radii: where the filter begins, scene units; None: by `survivor_share`.
      survivor_share: of the candidates in `ctx.mask`, which the filter is to leave (see
        `radii_for_share`).
      mode: "top_k" or "greedy"; default the policy's own.
      distance_filter: whether to filter; default the policy's own.

    Returns:
      selected [k] int, indices of candidates in the order of picking, and `SelectionInfo`.

    Raises:
      SelectionError: if k is out of range, the policy cannot do `mode`, a score is NaN, or a
        source that the policy needs is missing.
    """
    mode = policy.mode if mode is None else mode
    distance_filter = policy.distance_filter if distance_filter is None else distance_filter
    _check_mode(policy, mode)
    _check_available(k, ctx.mask)

    survivors, filter_info = np.asarray(ctx.mask), None
    if distance_filter:
        survivors, filter_info = _max_min_survivors(ctx, k, _as_radii(radii, ctx, survivor_share))

    choose = _choose_top_k if mode == "top_k" else _choose_greedily
    left = ctx.replace(mask=survivors)
    selected, scores, selected_scores = choose(policy, key, left, k)

    ranks = _farthest_ranks(ctx, max(k, int(survivors.sum())))
    nearest = _nearest_fn(ctx.positions, ctx.training_positions, ctx.is_training_view)
    return selected, SelectionInfo(
        scores=np.where(survivors, scores, np.nan),
        selected_scores=selected_scores,
        nearest_training_distance=np.asarray(nearest)[selected],
        survivors=survivors,
        filter=filter_info,
        farthest_overlap=int((ranks[selected] < k).sum()),
        survivors_farthest_overlap=int((ranks[survivors] < survivors.sum()).sum()),
        bound=None if policy.bound_fn is None else policy.bound_fn(left, selected),
    )


def _choose_top_k(policy: Policy, key, ctx: Context, k: int):
    scores = _checked_scores(policy.score_fn(key, ctx), ctx)
    selected = np.asarray(_top_k_fn(scores, ctx.mask, ctx.view_ids, k=k))
    return selected, scores, scores[selected]


def _choose_greedily(policy: Policy, key, ctx: Context, k: int):
    update_fn = _update_fn(policy)
    selected: list[int] = []
    selected_scores: list[float] = []
    first_scores = None
    for _ in range(k):
        scores = _checked_scores(policy.score_fn(key, ctx), ctx)
        first_scores = scores if first_scores is None else first_scores
        index = int(_top_k_fn(scores, ctx.mask, ctx.view_ids, k=1)[0])
        selected.append(index)
        selected_scores.append(scores[index])
        ctx = update_fn(mark_picked(ctx, index), index)
    return np.array(selected), first_scores, np.array(selected_scores)


def _cameras(ctx: Context) -> tuple[Array, Array, Array, Array]:
    return ctx.positions, ctx.training_positions, ctx.is_training_view, ctx.mask


def _max_min_survivors(ctx: Context, k: int, radii: Radii) -> tuple[np.ndarray, FilterInfo]:
    survivors, info = _filter_fn(*_cameras(ctx), k, view_ids=ctx.view_ids, radii=radii)
    return np.asarray(survivors), jax.tree.map(lambda x: x.item(), info)


def _farthest_ranks(ctx: Context, num_picks: int) -> np.ndarray:
    return np.asarray(_ranks_fn(*_cameras(ctx), num_picks, view_ids=ctx.view_ids))


def _as_radii(radii: Radii | None, ctx: Context, survivor_share: float) -> Radii:
    if radii is None:
        radii = _radii_fn(*_cameras(ctx), survivor_share, view_ids=ctx.view_ids, centre=ctx.centre)
    # One dtype whoever gave them, so that default and given radii share one compilation.
    return Radii(*(np.asarray(r, np.float32) for r in radii))


def _check_mode(policy: Policy, mode: str) -> None:
    if mode not in MODES:
        raise SelectionError(f"mode: unknown {mode!r}; use one of {', '.join(MODES)}")
    if mode == "greedy":
        _update_fn(policy)


def _update_fn(policy: Policy) -> UpdateFn:
    if policy.update_fn is None:
        raise SelectionError(
            f"mode: {policy.name!r} has no update between picks, so 'greedy' would be 'top_k'; "
            "use 'top_k'"
        )
    return policy.update_fn


def _check_available(k: int, mask) -> None:
    available = int(np.sum(mask))
    if not 1 <= k <= available:
        raise SelectionError(f"k: asked for {k} views, but 1 to {available} can be picked")


def _checked_scores(scores, ctx: Context) -> np.ndarray:
    """Scores [C] on the host; a NaN that could be picked is an error, never hidden."""
    scores, mask = np.asarray(scores, np.float32), np.asarray(ctx.mask)
    if scores.shape != mask.shape:
        raise SelectionError(f"scores: shape {scores.shape}, but it must be {mask.shape}")
    broken = np.asarray(ctx.view_ids)[mask & np.isnan(scores)]
    if len(broken):
        raise SelectionError(
            f"scores: NaN for view ids {broken[:8].tolist()} ({len(broken)} in all); "
            "look for NaN in the field or its uncertainty"
        )
    return scores
