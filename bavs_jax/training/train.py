"""Training of a radiance field: state, and a compiled run of several optimiser steps (Eq 4)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh

from bavs_jax.devices import gather_rays, over_rays, spread_rays
from bavs_jax.fields.base import Field
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.rendering.visible import visible_samples
from bavs_jax.training.batches import sample_pixels
from bavs_jax.training.losses import colour_loss

LEAST_LIGHT = 0.01  # that must reach a sample for it to be trained


@struct.dataclass
class TrainState:
    """What must be carried from one optimiser step to the next."""

    step: jax.Array  # [] int32, optimiser steps since the parameters were drawn
    params: dict[str, Any]  # "field" and "sampler", both trained; the mean of the last steps'
    last_params: dict[str, Any]  # those of the last step, which the optimiser goes on from
    opt_state: optax.OptState
    sampler_state: Any  # what the sampler carries untrained, such as an occupancy grid


@struct.dataclass
class TrainInfo:
    """What one compiled run of steps reports; means over its steps."""

    loss: jax.Array  # [] mean squared colour error
    rays: jax.Array  # [] rays per step that fitted the sample buffer
    samples: jax.Array  # [] samples per step
    thinned: jax.Array  # [] share of rays with more occupied steps than slots
    learning_rate: jax.Array  # []


def make_optimiser(
    *,
    learning_rate: float,
    final_share: float,
    num_steps: int,
    warmup: int = 32,
    max_grad_norm: float = 0.0,
    second_decay: float = 0.99,
    epsilon: float = 1e-15,
):
    """Adam with a warm-up and an exponential decay to `final_share * learning_rate`.

    The defaults of `second_decay` (Adam's beta_2) and `epsilon` are those of hash grids, whose
    entries see few and small gradients (Mueller et al. 2022, section 4).

    Args:
      learning_rate: at the end of the warm-up; a tenth of it at the beginning.
      final_share: of the learning rate, after `num_steps`.
      num_steps: optimiser steps.
      warmup: how many of them the learning rate rises for.
      max_grad_norm: gradients of a larger Euclidean norm, over all parameters, are scaled down to
        it; 0 for none.
      second_decay, epsilon: of Adam.

    Returns:
      The optimiser, and its learning rate as a function of the step.
    """
    schedule = optax.warmup_exponential_decay_schedule(
        init_value=0.1 * learning_rate,
        peak_value=learning_rate,
        warmup_steps=warmup,
        transition_steps=max(num_steps - warmup, 1),
        decay_rate=final_share,
        end_value=final_share * learning_rate,
    )
    adam = optax.adam(schedule, b1=0.9, b2=second_decay, eps=epsilon)
    if max_grad_norm > 0.0:
        adam = optax.chain(optax.clip_by_global_norm(max_grad_norm), adam)
    return adam, schedule


def init_train_state(key, field: Field, sampler: Sampler, optimiser) -> TrainState:
    """Fresh parameters, a fresh optimiser and a sampler that knows nothing."""
    params = {"field": field.init(key), "sampler": sampler.init(jax.random.fold_in(key, 1))}
    return TrainState(
        step=jnp.int32(0),
        params=params,
        last_params=jax.tree.map(jnp.copy, params),  # `train` donates both
        opt_state=optimiser.init(params),
        sampler_state=sampler.init_state(),
    )


def average_weight(step: jax.Array, num_steps: int, age: float) -> jax.Array:
    """Weight of the newest parameters in the mean of those of steps 1 to `step`, [].

    The mean weighs step s by `s^(1 / age - 2)`, so that its mean age is `age * step`: it forgets
    the beginning at whatever step it is looked at (Karras et al. 2024, Eq 7).

    Args:
      step: t, of the newest.
      num_steps: since the parameters before them.
      age: in (0, 0.5].
    """
    return 1.0 - (1.0 - num_steps / step) ** (1.0 / age - 1.0)


def make_train_fn(
    field: Field,
    sampler: Sampler,
    objective: Callable,
    optimiser,
    schedule: Callable,
    *,
    num_rays: int,
    background=None,
    random_background: bool = False,
    penalty_weight: float = 0.0,
    roughness_weight: float = 0.0,
    average_age: float = 0.0,
    capacity_before_hiding: int = 0,
    steps_per_call: int = 16,
    mesh: Mesh | None = None,
) -> Callable:
    """Makes the compiled training function.

    Args:
      field: the radiance field.
      sampler: how rays are sampled; its parameters are trained along.
      objective: what the field is trained for, from `objectives.py`.
      optimiser, schedule: from `make_optimiser`.
      num_rays: R, rays of one step.
      background, random_background: what rays end at; see `sample_pixels`.
      penalty_weight: of the field's own penalty.
      roughness_weight: of the field's roughness, for one training pixel: as a prior should, it
        counts the less the more pixels there are.
      average_age: mean age of the parameters that are rendered, as a share of the steps done
        (see `average_weight`); 0 renders the last ones.
      capacity_before_hiding: samples on each device whose density is looked at in a step, to leave
        out those that are hidden behind others (see `visible_samples`); 0 leaves out none.
      steps_per_call: optimiser steps compiled together.
      mesh: devices that share the rays (see `devices.py`); the objective must have the same.

    Returns:
      `train(key, state, table, is_training_view) -> (state, TrainInfo)`: `steps_per_call` steps in
      one jitted call. Views are a mask, so adding views compiles nothing anew. `state` is donated.
    """

    def see(params, rays, samples):
        return visible_samples(
            partial(field.density, params),
            rays,
            samples,
            capacity=capacity_before_hiding,
            least=LEAST_LIGHT,
        )

    visible = over_rays(see, mesh, spread=(False, True, True))

    def loss_fn(params, key, sampler_state, table, is_training_view):
        pixel_key, sample_key, objective_key = jax.random.split(key, 3)
        batch = sample_pixels(
            pixel_key,
            table,
            is_training_view,
            num_rays,
            background=background,
            random_background=random_background,
        )
        batch = spread_rays(batch, mesh)
        samples, aux = sampler.sample(sample_key, params["sampler"], sampler_state, batch.rays)
        fits = jnp.ones(num_rays, bool)
        if capacity_before_hiding and not sampler.dense:
            samples, fits = visible(params["field"], batch.rays, samples)
            batch = batch.replace(ray_weight=batch.ray_weight * fits)
        outcome = objective(objective_key, params["field"], batch, samples)
        ray_weight = batch.ray_weight * outcome.ray_mask
        colour_loss_fn = partial(colour_loss, target=batch.rgb, ray_weight=ray_weight)
        sampler_loss = sampler.loss(aux, samples, outcome.weights, colour_loss_fn)
        report = {
            "loss": colour_loss_fn(outcome.rgb),
            "rays": (outcome.ray_mask & fits).sum(),
            "samples": (samples.sample_mask & outcome.ray_mask[:, None]).sum(),
            "thinned": samples.thinned.mean(),
        }
        penalty = penalty_weight * field.penalty(params["field"])
        if roughness_weight:
            num_pixels = jnp.where(is_training_view, jnp.diff(table.offsets), 0).sum()
            penalty += roughness_weight / num_pixels * field.roughness(params["field"])
        return outcome.loss + sampler_loss + penalty, report

    def one_step(state, key, table, is_training_view):
        (_, report), grads = jax.value_and_grad(loss_fn, has_aux=True)(
            state.last_params, key, state.sampler_state, table, is_training_view
        )
        updates, opt_state = optimiser.update(grads, state.opt_state, state.last_params)
        params = optax.apply_updates(state.last_params, updates)
        state = state.replace(step=state.step + 1, last_params=params, opt_state=opt_state)
        return state, report

    @partial(jax.jit, donate_argnums=1)
    def train(key, state, table, is_training_view):
        update_key, steps_key = jax.random.split(key)
        density_fn = partial(field.density, state.last_params["field"])
        state = state.replace(
            sampler_state=sampler.update(update_key, state.sampler_state, density_fn, state.step)
        )
        rate = schedule(state.step)
        state, reports = jax.lax.scan(
            lambda s, k: one_step(s, k, table, is_training_view),
            state,
            jax.random.split(steps_key, steps_per_call),
        )
        params = state.last_params
        if average_age:
            weight = average_weight(state.step, steps_per_call, average_age)
            params = jax.tree.map(lambda mean, x: mean + weight * (x - mean), state.params, params)
        state = state.replace(params=params)
        means = jax.tree.map(lambda x: x.astype(jnp.float32).mean(), reports)
        return gather_rays((state, TrainInfo(**means, learning_rate=rate)), mesh)

    return train
