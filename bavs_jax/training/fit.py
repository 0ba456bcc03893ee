"""The one training loop: compiled calls in turn, and a fresh start for a field that is stuck."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.pixel_table import PixelTable, training_pixels
from bavs_jax.training.train import TrainCall, TrainInfo, TrainState

CHECK_SHARE = 0.1  # of a round's steps, after which a field is looked at
CHECK_STEPS = 256  # at least; a round of less than twice as many steps is not looked at
MAX_RESTARTS = 2  # of one round
FULL_OF_FOG = 0.9  # share of rays with more occupied steps than slots


def check_call(num_calls: int, steps_per_call: int) -> int | None:
    """After how many compiled calls of a round its field is looked at; None: never."""
    steps = max(CHECK_SHARE * num_calls * steps_per_call, CHECK_STEPS)
    call = int(np.ceil(steps / steps_per_call))
    return call if 2 * call <= num_calls else None


def single_colour_error(table: PixelTable, is_training_view) -> float:
    """Mean squared error of the best single colour for all training pixels, over channels."""
    view_ids, pixel_ids = training_pixels(table, is_training_view)
    rows = np.asarray(table.offsets)[view_ids] + pixel_ids
    return float((np.asarray(table.pixels)[rows] / 255.0).var(axis=0).mean())


def is_stuck(info: TrainInfo, spread: float) -> bool:
    """Whether a field explains its own photos worse than one colour does, or is nothing but fog."""
    return bool(info.loss >= spread or info.thinned >= FULL_OF_FOG)


class Trainer(NamedTuple):
    """How one kind of model is trained in a round."""

    init: Callable[[jax.Array], TrainState]  # has seen nothing; another one for each key
    call: TrainCall  # from `make_train_fn`
    num_calls: int  # compiled calls of a round
    check_call: int | None = None  # after how many of them a stuck field starts afresh


class Fitted(NamedTuple):
    """Where training stands after a compiled call."""

    train: TrainState
    calls: int  # since the last fresh start
    restarts: int  # fresh starts, each since the field was stuck
    info: TrainInfo  # of the call


def fit(
    key: jax.Array,
    trainer: Trainer,
    train: TrainState,
    table: PixelTable,
    is_training_view,
    *,
    calls: int = 0,
    restarts: int = 0,
    label: str = "",
) -> Iterator[Fitted]:
    """Trains a round to its end; yields after each compiled call.

    A field that is stuck at `trainer.check_call` starts afresh with another key, at most
    `MAX_RESTARTS` times. All randomness comes from `key`, `restarts` and `calls`, so training that
    is stopped and picked up goes the same way.

    Args:
      key: of the whole training.
      trainer: how to train, and for how long.
      train: where it begins. It is given away: use what is yielded.
      table, is_training_view: the photos, and which are trained on.
      calls, restarts: done before.
      label: what is trained, for the error.

    Raises:
      FloatingPointError: the loss is not finite; nothing of that call is yielded.
    """
    while calls < trainer.num_calls:
        call_key = _call_key(key, restarts, calls)
        train, info = trainer.call(call_key, train, table, is_training_view)
        if not np.isfinite(info.loss):
            raise FloatingPointError(
                f"{label}, training call {calls}: the loss is {float(info.loss)}; "
                "try a smaller learning rate"
            )
        calls += 1
        looked_at = calls == trainer.check_call and restarts < MAX_RESTARTS
        if looked_at and is_stuck(info, single_colour_error(table, is_training_view)):
            restarts += 1
            train, calls = trainer.init(_call_key(key, restarts, trainer.num_calls)), 0
        yield Fitted(train, calls, restarts, info)


def _call_key(key, restarts: int, call: int):
    """Of one compiled call; after a fresh start other pixels are drawn."""
    if restarts:
        key = jax.random.fold_in(key, 2**31 - 1 - restarts)
    return jax.random.fold_in(key, call)
