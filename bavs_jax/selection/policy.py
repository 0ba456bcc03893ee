"""The protocol of an acquisition policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax

from bavs_jax.selection.context import Context

Mode = Literal["top_k", "greedy"]
MODES: tuple[Mode, ...] = ("top_k", "greedy")


class Policy(NamedTuple):
    """How to value candidate views, and how to make a batch of the values.

    `score_fn(key, ctx) -> scores [C]`: larger is better. Only entries in `ctx.mask` count, the
    others may hold anything (NaN included); `acquire` handles masks, ties and the filter.
    `update_fn(ctx, index) -> ctx`: what changes for the policy once candidate `index` is in the
    batch (`acquire` has marked it already). None: candidates are valued independently, so
    "greedy" mode is refused.
    `bound_fn(ctx, selected) -> BatchBound`: how far a batch can be from the best one of its size,
    given the context before the first pick; None where nothing is known.
    """

    name: str  # by which a config names it
    summary: str  # one sentence
    score_fn: Callable[[jax.Array, Context], jax.Array]
    update_fn: Callable[[Context, int], Context] | None = None
    bound_fn: Callable | None = None
    needs: frozenset[str] = frozenset()  # fields of `Context` that the caller must fill
    uncertainty: str = "laplace"  # the model behind `mean_uncertainty_fn` (uncertainty/models)
    measure: str = "uncertainty"  # which of the model's images its mean is taken of
    field_kind: str = "reconstruction"  # of the field that the run itself trains and is measured on
    mode: Mode = "top_k"  # default way to a batch: the k largest at once, or one after another
    distance_filter: bool = False  # whether the max-min distance filter (Fig 5) goes first
    stochastic: bool = False  # whether scores depend on the key
