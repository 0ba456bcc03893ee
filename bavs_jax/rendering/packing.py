"""Evaluates a function at samples: at the valid ones only in a buffer of fixed size, or at all.

Most slots of [R, S] are empty. Valid samples are numbered row by row and evaluated in a packed
buffer of K places; the outputs are read back into [R, S], where all compositing happens. Where
every slot is valid there is nothing to pack, and `evaluate_dense` goes through them in order.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

# From (row [K], slot [K], valid [K]), which say what samples to evaluate and whether they count, a
# pytree of [K, ...].
EvaluateFn = Callable[[jax.Array, jax.Array, jax.Array], Any]


def row_starts(sample_mask: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Number of each row's first sample in packed order, and its number of samples; both [R]."""
    count = sample_mask.sum(-1, dtype=jnp.int32)
    return jnp.cumsum(count) - count, count


def _packed_slots(starts, count, first, capacity):
    """Row, slot and validity of the packed places first .. first + capacity."""
    number = first + jnp.arange(capacity)
    row = jnp.searchsorted(starts + count, number, side="right")
    row = jnp.minimum(row, starts.shape[0] - 1)
    valid = number < starts[-1] + count[-1]
    return row, jnp.where(valid, number - starts[row], 0), valid


def _read_back(packed, starts, first, sample_mask):
    """Packed outputs [K, ...] as [R, S, ...], 0 in empty slots and those of other passes."""
    capacity = packed.shape[0]
    number = starts[:, None] + jnp.arange(sample_mask.shape[1]) - first
    here = sample_mask & (number >= 0) & (number < capacity)
    table = packed.at[jnp.clip(number, 0, capacity - 1)].get(mode="promise_in_bounds")
    return jnp.where(here.reshape(here.shape + (1,) * (packed.ndim - 1)), table, 0)


@jax.custom_vjp
def _read_back_once(packed, starts, kept, places):
    """`_read_back` of a single pass, with a gradient that gathers.

    Each place goes to one slot at most, so its cotangent is that slot's. The derivative of a
    gather would add all [R, S] slots, most of them empty, into the K places one by one.
    """
    del places
    return _read_back(packed, starts, 0, kept)


def _read_back_once_fwd(packed, starts, kept, places):
    return _read_back(packed, starts, 0, kept), places


def _read_back_once_bwd(places, cotangent):
    row, slot, is_read = places
    values = cotangent.reshape(-1, *cotangent.shape[2:])[row * cotangent.shape[1] + slot]
    is_read = is_read.reshape(is_read.shape + (1,) * (values.ndim - 1))
    return jnp.where(is_read, values, 0), None, None, None


_read_back_once.defvjp(_read_back_once_fwd, _read_back_once_bwd)


def evaluate_one_pass(fn: EvaluateFn, sample_mask: jax.Array, *, capacity: int):
    """Differentiable in reverse: as many whole rays as fit into one buffer.

    Args:
      fn: evaluates K samples.
      sample_mask: [R, S] bool, the valid ones of a row first.
      capacity: K.

    Returns:
      outputs as [R, S, ...] and `ray_mask` [R]: false for rays that did not fit; the caller must
      leave those out whole, they are never cut.
    """
    starts, count = row_starts(sample_mask)
    ray_mask = starts + count <= capacity
    row, slot, valid = _packed_slots(starts, count, 0, capacity)
    packed = fn(row, slot, valid)
    kept, places = sample_mask & ray_mask[:, None], (row, slot, valid & ray_mask[row])
    return jax.tree.map(lambda x: _read_back_once(x, starts, kept, places), packed), ray_mask


def evaluate_all_passes(fn: EvaluateFn, sample_mask: jax.Array, *, capacity: int):
    """Outputs [R, S, ...] of any number of samples: as many buffers in turn as are needed.

    Not differentiable in reverse mode (a while loop). Arguments as in `evaluate_one_pass`.
    """
    starts, count = row_starts(sample_mask)
    total = starts[-1] + count[-1]

    def one_pass(first):
        packed = fn(*_packed_slots(starts, count, first, capacity))
        return jax.tree.map(lambda x: _read_back(x, starts, first, sample_mask), packed)

    def body(carry):
        first, table = carry
        return first + capacity, jax.tree.map(jnp.add, table, one_pass(first))

    shapes = jax.eval_shape(one_pass, jnp.int32(0))
    empty = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return jax.lax.while_loop(lambda carry: carry[0] < total, body, (jnp.int32(0), empty))[1]


def evaluate_dense(fn: EvaluateFn, num_rays: int, num_slots: int, *, capacity: int | None):
    """Outputs [R, S, ...] of all slots in order; differentiable.

    Args:
      fn: see `evaluate_one_pass`; all slots count as valid.
      num_rays, num_slots: R and S.
      capacity: most slots at once, in groups of whole rays; None takes all at once.
    """
    group = num_rays if capacity is None else max(min(capacity // num_slots, num_rays), 1)
    slot = jnp.tile(jnp.arange(num_slots), group)

    def evaluate_rays(first):
        row = jnp.minimum(first + jnp.repeat(jnp.arange(group), num_slots), num_rays - 1)
        outputs = fn(row, slot, jnp.ones_like(slot, bool))
        return jax.tree.map(lambda x: x.reshape(group, num_slots, *x.shape[1:]), outputs)

    if group == num_rays:
        return evaluate_rays(0)
    parts = jax.lax.map(evaluate_rays, jnp.arange(0, num_rays, group))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:num_rays], parts)
