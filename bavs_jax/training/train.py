"""Training of a radiance field: state, and a compiled run of several optimiser steps (Eq 4)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from bavs_jax.fields.base import Field
from bavs_jax.rendering.occupancy import Occupancy, init_occupancy, update_occupancy
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.sampling import MarchOptions, march
from bavs_jax.training.batches import sample_pixels
from bavs_jax.training.losses import colour_loss


@struct.dataclass
class TrainState:
    """What must be carried from one optimiser step to the next."""

    step: jax.Array  # [] int32, optimiser steps since the parameters were drawn
    params: Any
    opt_state: optax.OptState
    occupancy: Occupancy


@struct.dataclass
class TrainInfo:
    """What one compiled run of steps reports; means over its steps."""

    loss: jax.Array  # [] mean squared colour error
    rays: jax.Array  # [] rays per step that fitted the sample buffer
    samples: jax.Array  # [] samples per step
    thinned: jax.Array  # [] share of rays with more occupied steps than slots
    learning_rate: jax.Array  # []


def make_optimiser(*, learning_rate: float, final_share: float, num_steps: int, warmup: int = 32):
    """Adam with a short warm-up and an exponential decay to `final_share * learning_rate`."""
    schedule = optax.warmup_exponential_decay_schedule(
        init_value=0.1 * learning_rate,
        peak_value=learning_rate,
        warmup_steps=warmup,
        transition_steps=max(num_steps - warmup, 1),
        decay_rate=final_share,
        end_value=final_share * learning_rate,
    )
    return optax.adam(schedule, b1=0.9, b2=0.99, eps=1e-15), schedule


def init_train_state(key, field: Field, optimiser, *, box, occupancy_resolution: int) -> TrainState:
    """Fresh parameters, a fresh optimiser and an occupancy grid that knows nothing."""
    params = field.init(key)
    return TrainState(
        step=jnp.int32(0),
        params=params,
        opt_state=optimiser.init(params),
        occupancy=init_occupancy(box, resolution=occupancy_resolution),
    )


def make_train_fn(
    field: Field,
    optimiser,
    schedule: Callable,
    march_options: MarchOptions,
    *,
    background,
    num_rays: int,
    capacity: int,
    penalty_weight: float = 0.0,
    steps_per_call: int = 16,
    occupancy_samples: int | None = None,
) -> Callable:
    """Makes the compiled training function.

    Returns:
      `train(key, state, table, is_training_view) -> (state, TrainInfo)`: `steps_per_call` steps in
      one jitted call. Views are a mask, so adding views compiles nothing anew. `state` is donated.
    """
    background = jnp.asarray(background, jnp.float32)

    def loss_fn(params, key, occupancy, table, is_training_view):
        pixel_key, jitter_key = jax.random.split(key)
        rays, target, ray_weight = sample_pixels(pixel_key, table, is_training_view, num_rays)
        jitter = jax.random.uniform(jitter_key, (num_rays,))
        samples = march(rays, occupancy, march_options, jitter=jitter)
        rendering = render_rays(
            rays,
            samples,
            partial(field.apply, params),
            background=background,
            capacity=capacity,
            exact=False,
        )
        ray_weight = ray_weight * rendering.ray_mask
        loss = colour_loss(rendering.rgb, target, ray_weight)
        report = {
            "rays": rendering.ray_mask.sum(),
            "samples": (samples.sample_mask & rendering.ray_mask[:, None]).sum(),
            "thinned": samples.thinned.mean(),
        }
        return loss + penalty_weight * field.penalty(params), {"loss": loss, **report}

    def one_step(state, key, table, is_training_view):
        (_, report), grads = jax.value_and_grad(loss_fn, has_aux=True)(
            state.params, key, state.occupancy, table, is_training_view
        )
        updates, opt_state = optimiser.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        state = state.replace(step=state.step + 1, params=params, opt_state=opt_state)
        return state, report

    @partial(jax.jit, donate_argnums=1)
    def train(key, state, table, is_training_view):
        occupancy_key, steps_key = jax.random.split(key)
        cells = state.occupancy.density.shape[0]
        occupancy = update_occupancy(
            occupancy_key,
            state.occupancy,
            partial(field.density, state.params),
            num_samples=occupancy_samples or cells // 4,
            step_size=march_options.step_size,
        )
        state = state.replace(occupancy=occupancy)
        rate = schedule(state.step)
        state, reports = jax.lax.scan(
            lambda s, k: one_step(s, k, table, is_training_view),
            state,
            jax.random.split(steps_key, steps_per_call),
        )
        return state, TrainInfo(
            **jax.tree.map(lambda x: x.astype(jnp.float32).mean(), reports), learning_rate=rate
        )

    return train
