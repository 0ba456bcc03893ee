"""How things are timed and counted, what the machine could do at most, and how times grow."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


def timed(fn: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of one call until all that it returns is there, and what that is."""
    start = time.perf_counter()
    value = jax.block_until_ready(fn())
    return time.perf_counter() - start, value


def timed_runs(fn: Callable[[], Any], repeats: int) -> tuple[list[float], list[Any]]:
    """The same of several calls, one after another."""
    seconds, values = zip(*(timed(fn) for _ in range(repeats)))
    return list(seconds), list(values)


class Ceilings(NamedTuple):
    """Measured by the plainest programs there are."""

    flops_per_s: float  # of a float32 matrix product at JAX's default precision
    bytes_per_s: float  # read and written, of a copy


def measure_ceilings(*, matmul: int, copy_mb: int, repeats: int) -> Ceilings:
    """The best of several runs: a ceiling is what can be reached, not what is usual.

    Args:
      matmul: n, of `[n, n] @ [n, n]`, which takes `2 n^3` operations.
      copy_mb: 10^6 bytes of an array that is read once and written once. One is added on the way,
        which costs nothing beside the traffic: XLA would hand over the same array for a plain copy.
      repeats: runs of each.
    """
    square = jnp.ones((matmul, matmul), jnp.float32)
    array = jnp.ones(copy_mb * 10**6 // 4, jnp.float32)
    product, copy = jax.jit(jnp.matmul), jax.jit(lambda x: x + 1.0)
    best = []
    for run in (lambda: product(square, square), lambda: copy(array)):
        timed(run)
        best.append(min(timed_runs(run, repeats)[0]))
    return Ceilings(2.0 * matmul**3 / best[0], 2.0 * array.nbytes / best[1])


@dataclasses.dataclass(frozen=True)
class Work:
    """Floating-point operations, and bytes read and written."""

    flops: float
    bytes: float

    def __add__(self, other: Work) -> Work:
        return Work(self.flops + other.flops, self.bytes + other.bytes)

    def __sub__(self, other: Work) -> Work:
        return Work(self.flops - other.flops, self.bytes - other.bytes)

    def __mul__(self, times: float) -> Work:
        return Work(times * self.flops, times * self.bytes)


def compiled_work(fn: Callable, *args) -> Work:
    """Counts one call of a function by XLA's cost analysis.

    XLA counts the body of a loop once, however often it runs, so `fn` should have no loop that
    matters (a binary search does not). Operations are counted in the program for a CPU, before
    XLA's optimisation: the programs of other devices call libraries of their own, or cannot be
    counted at all. Exponentials and the like are not among them. Bytes are counted after it, when
    steps that are fused no longer pass arrays through memory. They bound the traffic to memory
    from above: a gather counts its whole table, and caches are not known.

    Args:
      fn: a function of arrays; jitted or not.
      *args: arrays, or their `jax.ShapeDtypeStruct`s: only shapes matter.

    Returns:
      `Work` of one call.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        before = jax.jit(fn).lower(*_shapes(args)).cost_analysis() or {}
    after = jax.jit(fn).lower(*args).compile().cost_analysis() or {}
    return Work(before.get("flops", 0.0), after.get("bytes accessed", 0.0))


def _shapes(tree):
    """The same without values, which would bind the program to the device that holds them."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), tree)


class Fit(NamedTuple):
    """Two descriptions of the same points; 1 and a small deviation both say linear."""

    exponent: float  # p of t ~ n^p over the measured range, a fixed cost included
    intercept_s: float  # a of t = a + b n: the fixed cost
    slope_s: float  # b: seconds for one more
    largest_deviation: float  # of the points from the line, as a share of the measured time


def fit_growth(sizes, seconds) -> Fit:
    """Fits `log t = log c + p log n` and `t = a + b n`, both by least squares.

    The line minimises relative errors, so that small sizes count as much as large ones.

    Args:
      sizes: [N] n > 0, at least two different ones.
      seconds: [N] t > 0.
    """
    sizes, seconds = np.asarray(sizes, np.float64), np.asarray(seconds, np.float64)
    exponent, _ = np.polyfit(np.log(sizes), np.log(seconds), 1)
    slope, intercept = np.polyfit(sizes, seconds, 1, w=1.0 / seconds)
    deviation = np.abs(intercept + slope * sizes - seconds) / seconds
    return Fit(float(exponent), float(intercept), float(slope), float(deviation.max()))
