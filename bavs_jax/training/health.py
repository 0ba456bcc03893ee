"""Whether a field learns at all: one that is stuck in fog must not become a result unnoticed."""

from __future__ import annotations

import numpy as np

from bavs_jax.training.batches import PixelTable, training_pixels
from bavs_jax.training.train import TrainInfo

CHECK_SHARE = 0.1  # of a round's steps, after which a field is looked at
CHECK_STEPS = 256  # at least; a round of less than twice as many steps is not looked at
MAX_RESTARTS = 2  # of one round
FULL_OF_FOG = 0.9  # share of rays with more occupied steps than slots


def check_call(num_calls: int, steps_per_call: int) -> int | None:
    """After how many compiled calls of a round its field is looked at; None: never."""
    steps = max(CHECK_SHARE * num_calls * steps_per_call, CHECK_STEPS)
    call = int(np.ceil(steps / steps_per_call))
    return call if 2 * call <= num_calls else None


def colour_spread(table: PixelTable, is_training_view) -> float:
    """Mean squared error of the best single colour for all training pixels, over channels."""
    view_ids, pixel_ids = training_pixels(table, is_training_view)
    rows = np.asarray(table.offsets)[view_ids] + pixel_ids
    return float((np.asarray(table.pixels)[rows] / 255.0).var(axis=0).mean())


def is_stuck(info: TrainInfo, spread: float) -> bool:
    """Whether a field explains its own photos worse than one colour does, or is nothing but fog."""
    return bool(info.loss >= spread or info.thinned >= FULL_OF_FOG)
