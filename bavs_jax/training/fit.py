"""The one training loop: compiled calls in turn, and a fresh start for a field that is stuck."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.training.batches import PixelTable
from bavs_jax.training.health import MAX_RESTARTS, colour_spread, is_stuck
from bavs_jax.training.train import TrainInfo, TrainState


class Fitted(NamedTuple):
    """Where training stands after a compiled call."""

    train: TrainState
    calls: int  # since the last fresh start
    restarts: int  # fresh starts, each since the field was stuck
    info: TrainInfo  # of the call


def fit(
    key: jax.Array,
    init: Callable,
    call: Callable,
    train: TrainState,
    table: PixelTable,
    is_training_view,
    *,
    num_calls: int,
    check_call: int | None = None,
    calls: int = 0,
    restarts: int = 0,
    label: str = "",
) -> Iterator[Fitted]:
    """Trains for `num_calls` compiled calls; yields after each one.

    All randomness comes from `key`, `restarts` and `calls`, so training that is stopped and picked
    up goes the same way.

    Args:
      key: of the whole training.
      init: key -> `TrainState`, for a fresh start.
      call: from `make_train_fn`.
      train: where it begins. It is given away: use what is yielded.
      table, is_training_view: the photos, and which are trained on.
      num_calls: how many compiled calls there are in all.
      check_call: after how many of them a field that is stuck starts afresh with another key, at
        most `MAX_RESTARTS` times; None: never. See `health.check_call`.
      calls, restarts: done before.
      label: what is trained, for the error.

    Raises:
      FloatingPointError: the loss is not finite; nothing of that call is yielded.
    """
    while calls < num_calls:
        train, info = call(_call_key(key, restarts, calls), train, table, is_training_view)
        if not np.isfinite(info.loss):
            raise FloatingPointError(
                f"{label}, training call {calls}: the loss is {float(info.loss)}; "
                "try a smaller learning rate"
            )
        calls += 1
        looked_at = calls == check_call and restarts < MAX_RESTARTS
        if looked_at and is_stuck(info, colour_spread(table, is_training_view)):
            restarts += 1
            train, calls = init(_call_key(key, restarts, num_calls)), 0
        yield Fitted(train, calls, restarts, info)


def _call_key(key, restarts: int, call: int):
    """Of one compiled call; after a fresh start other pixels are drawn."""
    if restarts:
        key = jax.random.fold_in(key, 2**31 - 1 - restarts)
    return jax.random.fold_in(key, call)
