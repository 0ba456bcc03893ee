"""What a compiled program does: floating-point operations and bytes, as XLA counts them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp


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
