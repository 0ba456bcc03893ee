"""Several processes that work on one run: who writes, and how they stay together."""

from __future__ import annotations

import jax
import numpy as np
from jax.experimental import multihost_utils


def is_first_process() -> bool:
    """Whether this process is the one that writes files."""
    return not jax.distributed.is_initialized() or jax.process_index() == 0


def as_first_process(value: bool) -> bool:
    """What the first process says, so that all do the same where clocks or files differ."""
    if not jax.distributed.is_initialized():
        return value
    return bool(multihost_utils.broadcast_one_to_all(np.array(value)))
