"""Which samples of a ray can be seen: those behind something opaque teach a field nothing."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Rays
from bavs_jax.rendering.compositing import transmittance
from bavs_jax.rendering.packing import evaluate_one_pass
from bavs_jax.rendering.sampling import Samples


def visible_samples(
    density_fn: Callable, rays: Rays, samples: Samples, *, capacity: int, least: float
) -> tuple[Samples, jax.Array]:
    """Leaves out the samples that light no longer reaches: `T_i < least` (Eq 3).

    A colour changes by less than `least` without them, and so does its gradient. Densities alone
    are a fifth of the work of a training step, and half of the samples of a trained field are
    hidden. No gradient runs through this.

    Args:
      density_fn: positions [K, 3] -> density [K], 1 / scene unit.
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
