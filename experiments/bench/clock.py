"""Seconds of work that a device does while the host has moved on."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax


def timed(fn: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until all that it returns is there, and what that is."""
    start = time.perf_counter()
    value = jax.block_until_ready(fn())
    return time.perf_counter() - start, value


def timed_runs(fn: Callable[[], Any], repeats: int) -> tuple[list[float], list[Any]]:
    """The same of several calls, one after another."""
    seconds, values = zip(*(timed(fn) for _ in range(repeats)))
    return list(seconds), list(values)
