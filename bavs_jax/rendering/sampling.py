"""Where along a ray the field is evaluated: steps through the occupied cells of the scene box."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.arrays import DensityFn
from bavs_jax.cameras import Rays
from bavs_jax.numerics import safe_reciprocal
from bavs_jax.rendering.compositing import transmittance
from bavs_jax.rendering.occupancy import Occupancy, cell_index
from bavs_jax.rendering.packing import evaluate_one_pass

WORD = 32  # bits


class Hits(NamedTuple):
    """Rows of true and false, packed."""

    words: tuple[jax.Array, ...]  # each [R] uint32; the lowest bit is the first column
    before: tuple[jax.Array, ...]  # each [R] int32, true entries in all earlier words

    @property
    def total(self) -> jax.Array:
        """True entries of each row, [R] int32."""
        return self.before[-1] + _count(self.words[-1])


def _count(words: jax.Array) -> jax.Array:
    return jax.lax.population_count(words).astype(jnp.int32)


def pack_hits(hit: jax.Array) -> Hits:
    """Packs rows [R, C] of bool, any C."""
    num_rows, num_columns = hit.shape
    num_words = -(-num_columns // WORD)
    padded = jnp.pad(hit, ((0, 0), (0, num_words * WORD - num_columns)))
    bits = padded.reshape(num_rows, num_words, WORD).astype(jnp.uint32)
    packed = (bits << jnp.arange(WORD, dtype=jnp.uint32)).sum(-1, dtype=jnp.uint32)
    words = tuple(packed[:, i] for i in range(num_words))
    before = [jnp.zeros(num_rows, jnp.int32)]
    for word in words[:-1]:
        before.append(before[-1] + _count(word))
    return Hits(words, tuple(before))


def nth_hit(hits: Hits, index: jax.Array) -> jax.Array:
    """The column of the true entry that `index` others come before.

    Args:
      hits: of R rows.
      index: [R, S] int32 >= 0.

    Returns:
      [R, S] int32; where a row has no such entry, some column of its last word.
    """
    word, column, rest = (jnp.zeros(index.shape, dtype) for dtype in ("uint32", "int32", "int32"))
    for number, (bits, before) in enumerate(zip(hits.words, hits.before)):
        is_later = index >= before[:, None]
        word = jnp.where(is_later, bits[:, None], word)
        column = jnp.where(is_later, number * WORD, column)
        rest = jnp.where(is_later, index - before[:, None], rest)
    half = WORD // 2
    while half:  # is it in the lower half of what is left of the word, or in the upper one?
        in_lower = _count(word & jnp.uint32((1 << half) - 1))
        is_upper = rest >= in_lower
        word = jnp.where(is_upper, word >> half, word)
        column = jnp.where(is_upper, column + half, column)
        rest = jnp.where(is_upper, rest - in_lower, rest)
        half //= 2
    return column


class Samples(struct.PyTreeNode):
    """Samples along R rays; the valid ones of a row come first."""

    t_mids: jax.Array  # [R, S] distance along the ray, scene units
    deltas: jax.Array  # [R, S] length a sample stands for, scene units, 0 where invalid
    sample_mask: jax.Array  # [R, S] bool
    thinned: jax.Array  # [R] bool, true where a ray had more occupied steps than slots
    # Whether every slot is valid, but for rays that have none: nothing is gained by packing then.
    dense: bool = struct.field(pytree_node=False, default=False)


def flatten_inputs(inputs: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """What a field reads at each sample, [R, S, ...], as [R * S, ...]."""
    return {name: x.reshape(-1, *x.shape[2:]) for name, x in inputs.items()}


def sample_positions(rays: Rays, samples: Samples) -> jax.Array:
    """Where samples are, [R, S, 3] scene units."""
    along = samples.t_mids[..., None] * rays.directions[:, None]
    return jnp.add(rays.origins[:, None], along)


def first_slots(samples: Samples, num_slots: int) -> Samples:
    """The same samples with fewer slots, for rays that have no more valid ones than that."""
    return samples.replace(
        t_mids=samples.t_mids[:, :num_slots],
        deltas=samples.deltas[:, :num_slots],
        sample_mask=samples.sample_mask[:, :num_slots],
    )


class MarchOptions(struct.PyTreeNode):
    """How rays are stepped through the scene box; static, so each value compiles once."""

    near: float = struct.field(pytree_node=False)  # closest distance along a ray, scene units
    far: float = struct.field(pytree_node=False)  # farthest distance, scene units
    step_size: float = struct.field(pytree_node=False)  # spacing, scene units
    num_steps: int = struct.field(pytree_node=False)  # most steps of a ray
    num_slots: int = struct.field(pytree_node=False)  # S, most samples of a ray
    last_length: float | None = struct.field(pytree_node=False, default=None)  # see `march`


CLOSED_LENGTH = 1e3  # diagonals of a closed box that the last sample of a ray stands for


def make_march_options(
    box, *, near, far, num_steps: int, num_slots: int, closed: bool = False
) -> MarchOptions:
    """Steps of one `num_steps`-th of the box's diagonal, so that any ray through it is covered.

    In a `closed` box each ray's last sample stands for so much that even thin fog is opaque there.
    """
    diagonal = float(np.linalg.norm(np.asarray(box)[1] - np.asarray(box)[0]))
    return MarchOptions(
        near=float(near),
        far=float(far),
        step_size=diagonal / num_steps,
        num_steps=num_steps,
        num_slots=num_slots,
        last_length=CLOSED_LENGTH * diagonal if closed else None,
    )


def box_interval(rays: Rays, box: jax.Array, near: float, far: float):
    """Distances [R] at which rays enter and leave the box, within [near, far].

    A ray that misses the box gets an empty interval (`t_enter >= t_leave`).
    """
    inverse = safe_reciprocal(rays.directions)
    to_lower = (box[0] - rays.origins) * inverse
    to_upper = (box[1] - rays.origins) * inverse
    t_enter = jnp.minimum(to_lower, to_upper).max(-1)
    t_leave = jnp.maximum(to_lower, to_upper).min(-1)
    return jnp.maximum(t_enter, near), jnp.minimum(t_leave, far)


def march(
    rays: Rays, occupancy: Occupancy, options: MarchOptions, *, jitter: jax.Array | None = None
) -> Samples:
    """Even steps through the scene box, kept where the cell is occupied.

    `t_i = t_enter + (i + jitter) step_size` for `t_i < t_leave`. A ray with more than `num_slots`
    occupied steps has one sample for each n of them, at the jitter's place among these and with
    their length, so its whole way is still integrated, more coarsely; such rays are marked in
    `thinned`.

    With `options.last_length` the box is closed: each ray's last step in it is kept, whatever its
    cell holds, and stands for that length, scene units, so that no light passes. A young field then
    shows each ray's end on the box, where it soon looks like the walls. Fog that must hide a
    background of another colour would come first, and stay.

    Args:
      rays: R rays.
      occupancy: the grid, whose box bounds the way.
      options: spacing and limits; `num_steps * step_size` should reach through the box.
      jitter: [R] in [0, 1), place of the sample within each step; 0.5 when None.
    """
    num_rays = rays.origins.shape[0]
    step_size, num_slots = options.step_size, options.num_slots
    t_enter, t_leave = box_interval(rays, occupancy.box, options.near, options.far)
    place = jnp.full(num_rays, 0.5) if jitter is None else jitter
    t = t_enter[:, None] + (jnp.arange(options.num_steps) + place[:, None]) * step_size
    positions = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    cell = cell_index(occupancy, positions)
    is_within = t < t_leave[:, None]
    hit = occupancy.occupied.at[cell].get(mode="promise_in_bounds") & is_within
    if options.last_length is not None:
        hit |= is_within & (t + step_size >= t_leave[:, None])

    hits = pack_hits(hit)
    total = hits.total
    stride = jnp.maximum((total + num_slots - 1) // num_slots, 1)
    begin = jnp.arange(num_slots) * stride[:, None]
    group = jnp.clip(total[:, None] - begin, 0, stride[:, None])
    sample_mask = group > 0
    # Of each group the step at the jitter's place: were it always the first one, the others
    # would never be looked at.
    along = place[:, None] * group
    nth = jnp.clip(along.astype(jnp.int32), 0, jnp.maximum(group - 1, 0))
    step = nth_hit(hits, begin + nth)
    t_mids = t_enter[:, None] + (step + along - nth) * step_size
    deltas = step_size * group
    if options.last_length is not None:
        is_last = jnp.arange(num_slots) == sample_mask.sum(-1, keepdims=True) - 1
        deltas = jnp.where(is_last, options.last_length, deltas)
    return Samples(
        t_mids=jnp.where(sample_mask, t_mids, options.far),
        deltas=deltas,
        sample_mask=sample_mask,
        thinned=total > num_slots,
    )


def visible_samples(
    density_fn: DensityFn, rays: Rays, samples: Samples, *, capacity: int, least: float
) -> tuple[Samples, jax.Array]:
    """Leaves out the samples that light no longer reaches: `T_i < least` (Eq 3).

    A colour changes by less than `least` without them, and so does its gradient. Densities alone
    are a fifth of the work of a training step, and half of the samples of a trained field are
    hidden. No gradient runs through this.

    Args:
      rays: R rays.
      samples: [R, S], not dense.
      capacity: samples whose density is evaluated.
      least: transmittance below which a sample is left out, in [0, 1).

    Returns:
      The samples, and [R] bool that is false for rays which did not fit the buffer: all of their
      samples are left out.
    """
    t = samples.t_mids.reshape(-1)

    def density(row, slot, valid):
        place = row * samples.t_mids.shape[1] + slot
        positions = rays.origins[row] + t[place, None] * rays.directions[row]
        return jnp.where(valid, density_fn(positions), 0.0)

    found, ray_mask = evaluate_one_pass(density, samples.sample_mask, capacity=capacity)
    # Light only ever fades along a ray, so what is seen of a row still comes first.
    # What is not a number is seen too, and shows in the loss.
    seen = ~(transmittance(found, samples.deltas) < least)
    mask = samples.sample_mask & seen & ray_mask[:, None]
    samples = samples.replace(sample_mask=mask, deltas=jnp.where(mask, samples.deltas, 0.0))
    return jax.lax.stop_gradient((samples, ray_mask))
