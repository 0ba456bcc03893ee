"""Signals: what ends a script, and how its processes go with it."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from typing import NoReturn

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


CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}

_received: list[int] = []


def end_at_once() -> None:
    """From now on a signal ends this process: for the seconds of imports, before any work."""
    _handle(lambda number, frame: end(number))


def interrupt_work() -> None:
    """From now on a signal is a KeyboardInterrupt, and a second one ends this process."""

    def handle(number, frame):
        if _received:
            end(number)
        _received.append(number)
        raise KeyboardInterrupt

    _handle(handle)


def _handle(handler: Callable) -> None:
    for number in CODES:
        # What starts a job in the background may have it ignore one.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def received() -> int | None:
    """The signal that has interrupted the work, if one has."""
    return _received[0] if _received else None


def end(number: int) -> NoReturn:
    """Says that the work was stopped, and ends without waiting for threads or other processes."""
    sys.stdout.flush()
    os.write(2, b"stopped; the same command goes on\n")
    os._exit(CODES[number])
