"""The most that this machine does in a second: arithmetic and memory traffic."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from experiments.bench.clock import timed, timed_runs


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
