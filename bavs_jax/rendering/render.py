"""The one renderer: training, images, curvature, uncertainty and clean-up all go through it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.cameras import Rays
from bavs_jax.rendering.compositing import (
    composite,
    composite_colour,
    expected_depth,
    render_weights,
)
from bavs_jax.rendering.packing import evaluate_all_passes, evaluate_dense, evaluate_one_pass
from bavs_jax.rendering.sampling import Samples, flatten_inputs


class Rendering(struct.PyTreeNode):
    """What R rays see."""

    rgb: jax.Array  # [R, 3] sRGB in [0, 1]
    depth: jax.Array  # [R] distance along the ray, scene units; 0 on empty rays
    opacity: jax.Array  # [R] in [0, 1]
    thinned: jax.Array  # [R] bool, looked at more coarsely than asked for
    channels: dict[str, jax.Array]  # each [R]


class RayRendering(Rendering):
    """What R rays see of a field that is sampled along them, and by which samples."""

    samples: Samples  # [R, S]
    weights: jax.Array  # [R, S]
    density: jax.Array  # [R, S] 1 / scene unit, 0 in empty slots
    values: dict[str, jax.Array]  # what more the field returned at each sample, [R, S, ...]
    ray_mask: jax.Array  # [R] bool, false: the ray did not fit the buffer and must be left out


def basic_images(rendering: Rendering) -> dict[str, jax.Array]:
    """What every render gives: "rgb" [R, 3], "depth", "opacity" and "thinned" [R]."""
    return {name: getattr(rendering, name) for name in ("rgb", "depth", "opacity", "thinned")}


DisplaceFn = Callable[[jax.Array], jax.Array]  # offsets [K, 3] at positions [K, 3], scene units
# A field whose parameters are fixed: from positions [K, 3], directions [K, 3] and its inputs by
# name, what `ApplyField` says.
FieldFn = Callable[..., tuple]


class Channel(NamedTuple):
    """One more quantity to composite like colour: `sum_i w_i value_i + (1 - sum_i w_i) floor`."""

    # [K] at positions [K, 3], scene units, that are looked at along unit directions [K, 3].
    value_fn: Callable[[jax.Array, jax.Array], jax.Array]
    floor: float = 0.0  # what a ray sees that meets nothing


def render_rays(
    rays: Rays,
    samples: Samples,
    field_fn: FieldFn,
    *,
    background: Array | None,
    capacity: int,
    exact: bool,
    inputs: Mapping[str, jax.Array] | None = None,
    displace_fn: DisplaceFn | None = None,
    channels: Mapping[str, Channel] | None = None,
) -> RayRendering:
    """Renders rays at given samples (Eqs 2-3).

    Args:
      rays: R rays.
      samples: [R, S] where to look.
      field_fn: what is rendered; it is given `inputs` by name.
      background: [3] colour of what lies behind everything, or [R, 3]; None: see
        `composite_colour`.
      capacity: places of the buffer in which valid samples are evaluated.
      exact: true evaluates all samples in as many passes as needed, and cannot be differentiated
        in reverse mode; false makes one pass and marks rays that did not fit in `ray_mask`. Dense
        samples always fit: one pass then takes them all at once.
      inputs: what more the field reads at each sample, by name, [R, S, ...] (`Field.inputs`).
      displace_fn: the deformation `D(x)`; the field is read at `x + D(x)`.
      channels: more quantities to composite, by name; each reads the undisplaced position.
    """
    channels = dict(channels or {})
    num_rays, num_slots = samples.t_mids.shape
    flat_inputs = flatten_inputs(inputs or {})

    def evaluate(row, slot, valid):
        place = row * num_slots + slot
        t = samples.t_mids.reshape(-1)[place]
        directions = rays.directions[row]
        positions = rays.origins[row] + t[:, None] * directions
        moved = positions if displace_fn is None else positions + displace_fn(positions)
        more = {name: x[place] for name, x in flat_inputs.items()}
        density, rgb, *values = field_fn(moved, directions, **more)
        extra = {
            name: channel.value_fn(positions, directions) for name, channel in channels.items()
        }
        return jnp.where(valid, density, 0.0), rgb, extra, values[0] if values else {}

    ray_mask = jnp.ones(num_rays, bool)
    if samples.dense:
        at_once = capacity if exact else None
        outputs = evaluate_dense(evaluate, num_rays, num_slots, capacity=at_once)
    elif exact:
        outputs = evaluate_all_passes(evaluate, samples.sample_mask, capacity=capacity)
    else:
        outputs, ray_mask = evaluate_one_pass(evaluate, samples.sample_mask, capacity=capacity)
    density, rgb, extra, values = outputs

    weights = render_weights(density, samples.deltas)
    return RayRendering(
        rgb=composite_colour(weights, rgb, background),
        depth=expected_depth(weights, samples.t_mids),
        opacity=weights.sum(-1),
        channels={
            name: composite(weights, value[..., None], channels[name].floor)[..., 0]
            for name, value in extra.items()
        },
        thinned=samples.thinned,
        samples=samples,
        weights=weights,
        density=density,
        values=values,
        ray_mask=ray_mask,
    )
