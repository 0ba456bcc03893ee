"""From a config to everything that trains one kind of field."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import jax
from jax.sharding import Mesh

from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields.base import Field
from bavs_jax.fields.flow_field import FlowField, mean_field
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.scenes import Scene
from bavs_jax.training.fit import Fitted, check_call, fit
from bavs_jax.training.objectives import (
    make_colour_objective,
    make_flow_objective,
    make_variance_objective,
)
from bavs_jax.training.train import TrainState, init_train_state, make_optimiser, make_train_fn
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE, Situation
from experiments.build_field import build_field, build_flow, field_background, learning_rate
from experiments.errors import ConfigError
from experiments.runtime import warn


class Trainer(NamedTuple):
    """One kind of field with its training."""

    field: Field
    sampler: Sampler
    init: Callable  # key -> TrainState
    call: Callable  # see `make_train_fn`
    flow: FlowField | None  # the distribution over fields of which `field` is the mean


KINDS = (RECONSTRUCTION, VARIANCE, FLOW)


def build_trainer(
    config, scene: Scene, num_views: int, kind: str, mesh: Mesh | None = None
) -> Trainer:
    """Puts a field, its sampler, its objective and its optimiser together; compiles nothing yet.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene.
      num_views: views of the pixel table.
      kind: one of `KINDS`.
      mesh: devices that share the rays and the sample buffer.

    Raises:
      ConfigError: options that do not go together.
    """
    field, sampler = build_field(config, scene, num_views, learned_variance=kind == VARIANCE)
    train, flow = config.train, None
    capacity = train.capacity // num_shards(mesh)
    if not sampler.dense and capacity < sampler.num_slots:
        raise ConfigError(
            f"config.train.capacity: {capacity} samples of a device cannot hold the "
            f"{sampler.num_slots} of one ray (config.march.num_slots): give more"
        )
    rendering = {"capacity": capacity, "mesh": mesh}
    if kind == FLOW:
        flow = build_flow(config, scene)
        field = mean_field(flow)
        objective = make_flow_objective(flow, **rendering, **config.flow_training)
    elif kind == VARIANCE:
        objective = make_variance_objective(field, **rendering)
    else:
        objective = make_colour_objective(field, **rendering)
    optimiser, schedule = make_optimiser(
        learning_rate=learning_rate(config),
        final_share=train.final_share,
        num_steps=train.num_steps,
        warmup=train.warmup_steps,
        max_grad_norm=train.max_grad_norm,
        second_decay=train.adam_b2,
        epsilon=train.adam_eps,
    )
    call = make_train_fn(
        field,
        sampler,
        objective,
        optimiser,
        schedule,
        num_rays=train.num_rays,
        background=field_background(scene),
        random_background=train.random_background,
        penalty_weight=train.penalty_weight,
        roughness_weight=train.roughness_weight,
        average_age=train.average_age,
        capacity_before_hiding=train.look_ahead * capacity,
        steps_per_call=train.steps_per_call,
        mesh=mesh,
    )
    fresh = jax.jit(partial(init_train_state, field=field, sampler=sampler, optimiser=optimiser))

    def init(key):
        return put_on_all(fresh(key), mesh)

    return Trainer(field, sampler, init, call, flow)


def calls_per_round(config) -> int:
    """Compiled training calls of a round."""
    return -(-config.train.num_steps // config.train.steps_per_call)


def fit_field(
    config, init, call, key, train: TrainState, table, is_training_view, *, label: str, **done
) -> Iterator[Fitted]:
    """`fit` for a round of a config.

    Args:
      config: see `experiments/configs/base.py`.
      init, call, key, train, table, is_training_view, label: see `fit`.
      **done: `calls` and `restarts` of `fit`.
    """
    num_calls = calls_per_round(config)
    looked_at = check_call(num_calls, config.train.steps_per_call)
    return fit(
        key,
        init,
        call,
        train,
        table,
        is_training_view,
        num_calls=num_calls,
        check_call=looked_at,
        label=label,
        **done,
    )


def train_aside(
    config, trainer: Trainer, key, situation: Situation, kind: str, track
) -> TrainState:
    """Trains a field beside the run's own, on the same views for as many steps.

    Raises:
      FloatingPointError: the loss is not finite.
    """
    num_calls, steps = calls_per_round(config), config.train.steps_per_call
    init_key, steps_key = jax.random.split(jax.random.fold_in(key, 0))
    state = trainer.init(init_key)
    with track(num_calls * steps, f"{situation.label}: train {kind}", "steps") as bar:
        for fitted in fit_field(
            config,
            trainer.init,
            trainer.call,
            steps_key,
            state,
            situation.table,
            situation.is_training_view,
            label=f"{kind} field",
        ):
            state = fitted.train
            bar.advance(steps, loss=float(fitted.info.loss))
            if fitted.calls == 0:
                warn(
                    f"{situation.label}: the {kind} field is stuck: trained anew with another key "
                    f"({fitted.restarts})"
                )
    return state
