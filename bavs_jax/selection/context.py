"""What a policy may look at when it scores candidates."""

from collections.abc import Callable
from typing import Literal, Protocol, overload

import numpy as np
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.selection import SelectionError
from bavs_jax.selection.directional import DirectionalInformation
from bavs_jax.selection.gaps import ViewGaps
from bavs_jax.selection.information import Information
from bavs_jax.selection.targets import TargetInformation


class SourceFn(Protocol):
    """One number for each of the candidates `indices` [n], float [n]; made when it is asked for."""

    def __call__(self, indices: np.ndarray, /) -> Array: ...


# Eq 15: mean uncertainty [n] of renders of candidates [n], where those marked [C] are picked.
MeanUncertaintyFn = Callable[[np.ndarray, Array], Array]


class Context(struct.PyTreeNode):
    """C candidate cameras, the V views that may be trained on, and sources of scores.

    All arrays keep their shapes while views are added: only the masks change. The callables close
    over parameters that change every round, so a `Context` must not be passed into `jax.jit`
    whole: jit over its arrays.

    A policy that needs something new gets one more optional field here, with a default of None,
    and reads it through `require`; the caller fills it where the policy's `needs` ask for it.
    Sources take indices and stream over them, so that only candidates which are still in `mask`
    cost anything.
    """

    positions: Array  # [C, 3] candidate camera centres, scene units
    view_ids: Array  # [C] int32, distinct, >= 0: settle ties and seed random draws
    mask: Array  # [C] bool, which candidates may be picked now
    picked: Array  # [C] bool, the batch chosen so far; kept by `acquire`
    training_positions: Array  # [V, 3] scene units
    is_training_view: Array  # [V] bool
    centre: Array  # [3] scene centre, scene units
    places: Array  # [P, 3] of cameras, which `spread` is to bring near to a view; the candidates
    mean_uncertainty_fn: MeanUncertaintyFn | None = struct.field(pytree_node=False, default=None)
    # The posterior of the field and what each candidate would add to it (`information.py`).
    information: Information | None = struct.field(pytree_node=False, default=None)
    # What views told about each side of the field (`directional.py`).
    directional: DirectionalInformation | None = struct.field(pytree_node=False, default=None)
    # What views told about each side of the field, as far as targets show it (`targets.py`).
    targets: TargetInformation | None = struct.field(pytree_node=False, default=None)
    # From how near by views see the pixels of targets (`gaps.py`).
    gaps: ViewGaps | None = struct.field(pytree_node=False, default=None)
    # Mean squared errors of renders of candidates against their photos.
    true_error_fn: SourceFn | None = struct.field(pytree_node=False, default=None)


def make_context(
    positions,
    *,
    training_positions,
    is_training_view,
    centre,
    view_ids=None,
    mask=None,
    places=None,
    mean_uncertainty_fn: MeanUncertaintyFn | None = None,
    information: Information | None = None,
    directional: DirectionalInformation | None = None,
    targets: TargetInformation | None = None,
    gaps: ViewGaps | None = None,
    true_error_fn: SourceFn | None = None,
) -> Context:
    """Checks and builds a `Context` with nothing picked yet, on the host.

    Args:
      positions: [C, 3] candidate camera centres, scene units.
      training_positions: [V, 3] centres of all views that may be trained on, scene units.
      is_training_view: [V] bool, which of them are trained on now.
      centre: [3] scene centre, scene units.
      view_ids: [C] distinct integers >= 0; default 0 .. C - 1.
      mask: [C] bool, which candidates may be picked; default all.
      places: [P, 3] see `Context`; default the candidates.
      mean_uncertainty_fn, information, directional, targets, gaps, true_error_fn: see `Context`.

    Raises:
      SelectionError: on a wrong shape, a position that is not finite, or repeated view ids.
    """
    num = len(positions)
    arrays = {
        "positions": np.asarray(positions, np.float32),
        "view_ids": np.asarray(np.arange(num) if view_ids is None else view_ids, np.int32),
        "mask": np.asarray(np.ones(num) if mask is None else mask, bool),
        "training_positions": np.asarray(training_positions, np.float32),
        "is_training_view": np.asarray(is_training_view, bool),
        "centre": np.asarray(centre, np.float32),
        "places": np.asarray(positions if places is None else places, np.float32),
    }
    shapes = {
        "positions": (num, 3),
        "view_ids": (num,),
        "mask": (num,),
        "training_positions": (len(training_positions), 3),
        "is_training_view": (len(training_positions),),
        "centre": (3,),
        "places": (num if places is None else len(places), 3),
    }
    for name, array in arrays.items():
        if array.shape != shapes[name]:
            raise SelectionError(f"{name}: shape {array.shape}, but it must be {shapes[name]}")
        if not np.isfinite(array).all():
            raise SelectionError(f"{name}: not finite; give unused slots any finite position")
    view_ids = arrays["view_ids"]
    if len(np.unique(view_ids)) != num or (view_ids < 0).any():
        raise SelectionError("view_ids: must be distinct and >= 0, for they settle ties")
    return Context(
        **arrays,
        picked=np.zeros(num, bool),
        mean_uncertainty_fn=mean_uncertainty_fn,
        information=information,
        directional=directional,
        targets=targets,
        gaps=gaps,
        true_error_fn=true_error_fn,
    )


@overload
def require(ctx: Context, field: Literal["mean_uncertainty_fn"]) -> MeanUncertaintyFn: ...
@overload
def require(ctx: Context, field: Literal["information"]) -> Information: ...
@overload
def require(ctx: Context, field: Literal["directional"]) -> DirectionalInformation: ...
@overload
def require(ctx: Context, field: Literal["targets"]) -> TargetInformation: ...
@overload
def require(ctx: Context, field: Literal["gaps"]) -> ViewGaps: ...
@overload
def require(ctx: Context, field: Literal["true_error_fn"]) -> SourceFn: ...
def require(ctx: Context, field: str):
    """The field of `ctx` with that name; raises SelectionError if the caller gave none."""
    value = getattr(ctx, field)
    if value is None:
        raise SelectionError(f"{field}: this policy needs it; give it to make_context")
    return value


def mark_picked(ctx: Context, index: int) -> Context:
    """`ctx` after candidate `index` joined the batch: in `picked`, no longer in `mask`."""
    is_pick = np.arange(len(ctx.mask)) == index
    return ctx.replace(mask=np.asarray(ctx.mask) & ~is_pick, picked=ctx.picked | is_pick)


def score_candidates(ctx: Context, source_fn: SourceFn) -> np.ndarray:
    """Scores [C] from a source that is asked only for the candidates in `mask`; NaN elsewhere.

    Raises:
      SelectionError: if the source returns another shape than [n].
    """
    indices = np.flatnonzero(ctx.mask)
    values = np.asarray(source_fn(indices))
    if values.shape != indices.shape:
        raise SelectionError(
            f"scores: shape {values.shape} for {len(indices)} candidates; return one number each"
        )
    scores = np.full(len(ctx.mask), np.nan, np.float32)
    scores[indices] = values
    return scores
