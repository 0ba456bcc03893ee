"""The protocol of an acquisition policy."""

from typing import Literal, NamedTuple, Protocol

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.selection.context import Context
from bavs_jax.selection.information import BatchBound

Mode = Literal["top_k", "greedy"]
MODES: tuple[Mode, ...] = ("top_k", "greedy")


class ScoreFn(Protocol):
    """Scores [C], larger is better. Only entries in `ctx.mask` count, the others may hold anything
    (NaN included); `acquire` handles masks, ties and the filter."""

    def __call__(self, key: jax.Array, ctx: Context, /) -> Array: ...


class UpdateFn(Protocol):
    """The context once candidate `index` is in the batch; `acquire` has marked it already."""

    def __call__(self, ctx: Context, index: int, /) -> Context: ...


class BoundFn(Protocol):
    """How far the batch `selected` [k] can be from the best one of its size, given the context
    before the first pick."""

    def __call__(self, ctx: Context, selected: np.ndarray, /) -> BatchBound: ...


class Policy(NamedTuple):
    """How to value candidate views, and how to make a batch of the values."""

    name: str  # by which a config names it
    summary: str  # one sentence
    score_fn: ScoreFn
    update_fn: UpdateFn | None = None  # None: each is valued by itself, and "greedy" is refused
    bound_fn: BoundFn | None = None  # None where nothing is known
    needs: frozenset[str] = frozenset()  # fields of `Context` that the caller must fill
    uncertainty: str = "laplace"  # the model behind `mean_uncertainty_fn` (uncertainty/models)
    measure: str = "uncertainty"  # which of the model's images its mean is taken of
    field_kind: str = "reconstruction"  # of the field that the run itself trains and is measured on
    mode: Mode = "top_k"  # default way to a batch: the k largest at once, or one after another
    distance_filter: bool = False  # whether the max-min distance filter (Fig 5) goes first
    stochastic: bool = False  # whether scores depend on the key
