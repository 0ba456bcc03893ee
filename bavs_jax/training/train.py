"""Training of a radiance model: state, and a compiled run of several optimiser steps (Eq 4)."""

from collections.abc import Callable
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.devices import gather_rays
from bavs_jax.fields.base import Params
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.pixel_table import PixelTable


class TrainState(struct.PyTreeNode):
    """What must be carried from one optimiser step to the next."""

    step: jax.Array  # [] int32, optimiser steps since the parameters were drawn
    model: ModelState  # what is rendered: its parameters are the mean of the last steps'
    last_params: Params  # those of the last step, which the optimiser goes on from
    opt_state: optax.OptState


class TrainInfo(struct.PyTreeNode):
    """What one compiled run of steps reports; means over its steps."""

    loss: jax.Array  # [] mean squared colour error
    rays: jax.Array  # [] rays per step that fitted the sample buffer
    samples: jax.Array  # [] samples per step
    thinned: jax.Array  # [] share of rays with more occupied steps than slots
    learning_rate: jax.Array  # []


Schedule = Callable[[jax.Array], jax.Array]  # the learning rate [] after so many steps []


class TrainCall(Protocol):
    """Several optimiser steps on the marked views [V] in one compiled call; `state` is donated."""

    def __call__(
        self, key: jax.Array, state: TrainState, table: PixelTable, is_training_view: Array, /
    ) -> tuple[TrainState, TrainInfo]: ...


def make_optimiser(
    *,
    learning_rate: float,
    final_share: float,
    num_steps: int,
    warmup: int = 32,
    max_grad_norm: float = 0.0,
    second_decay: float = 0.99,
    epsilon: float = 1e-15,
) -> tuple[optax.GradientTransformation, Schedule]:
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


def init_train_state(
    key: jax.Array, model: RadianceModel, optimiser: optax.GradientTransformation
) -> TrainState:
    """A model that has seen nothing, and a fresh optimiser."""
    state = model.init(key)
    return TrainState(
        step=jnp.int32(0),
        model=state,
        last_params=jax.tree.map(jnp.copy, state.params),  # `train` donates both
        opt_state=optimiser.init(state.params),
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
    model: RadianceModel,
    optimiser: optax.GradientTransformation,
    schedule: Schedule,
    *,
    average_age: float = 0.0,
    steps_per_call: int = 16,
    mesh: Mesh | None = None,
) -> TrainCall:
    """Makes the compiled training function, of `steps_per_call` steps.

    Views are a mask: more of them compile nothing anew.

    Args:
      model: what is trained; it draws its batches and says what is made small.
      optimiser, schedule: from `make_optimiser`.
      average_age: mean age of the parameters that are rendered, as a share of the steps done
        (see `average_weight`); 0 renders the last ones.
      steps_per_call: optimiser steps compiled together.
      mesh: devices that share the rays (see `devices.py`); the model must have the same.
    """

    def one_step(state: TrainState, key, table, is_training_view):
        def loss_fn(params):
            return model.loss(key, state.model.replace(params=params), table, is_training_view)

        (_, report), grads = jax.value_and_grad(loss_fn, has_aux=True)(state.last_params)
        updates, opt_state = optimiser.update(grads, state.opt_state, state.last_params)
        params = optax.apply_updates(state.last_params, updates)
        state = state.replace(step=state.step + 1, last_params=params, opt_state=opt_state)
        return state, report

    @partial(jax.jit, donate_argnums=1)
    def train(key, state: TrainState, table, is_training_view):
        refresh_key, steps_key = jax.random.split(key)
        latest = state.model.replace(params=state.last_params)
        carried = model.refresh(refresh_key, latest, state.step).carried
        state = state.replace(model=state.model.replace(carried=carried))
        rate = schedule(state.step)
        state, reports = jax.lax.scan(
            lambda s, k: one_step(s, k, table, is_training_view),
            state,
            jax.random.split(steps_key, steps_per_call),
        )
        params = state.last_params
        if average_age:
            weight = average_weight(state.step, steps_per_call, average_age)
            params = jax.tree.map(
                lambda mean, x: mean + weight * (x - mean), state.model.params, params
            )
        state = state.replace(model=state.model.replace(params=params))
        means = {
            name: getattr(reports, name).astype(jnp.float32).mean()
            for name in ("loss", "rays", "samples", "thinned")
        }
        return gather_rays((state, TrainInfo(**means, learning_rate=rate)), mesh)

    return train
