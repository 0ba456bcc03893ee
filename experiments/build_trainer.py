"""From a config to the models of a scene and how they are trained."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
from jax.sharding import Mesh

from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields.flow_field import FlowField, mean_field
from bavs_jax.models.objectives import (
    make_colour_objective,
    make_flow_objective,
    make_variance_objective,
)
from bavs_jax.models.ray_field import RayField, RayTraining
from bavs_jax.scenes import Scene
from bavs_jax.training.fit import Trainer, check_call, fit
from bavs_jax.training.train import (
    TrainCall,
    TrainState,
    init_train_state,
    make_optimiser,
    make_train_fn,
)
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE, Acquired
from experiments.build_field import build_field, field_background, learning_rate
from experiments.errors import ConfigError
from experiments.runtime import warn

KINDS = (RECONSTRUCTION, VARIANCE, FLOW)
RENDER_CHUNK = 4096  # rays of one compiled rendering call


def build_model(
    config, scene: Scene, num_views: int, kind: str, flow: FlowField, mesh: Mesh | None = None
) -> RayField:
    """The model of one kind; compiles nothing yet.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene.
      num_views: views of the pixel table.
      kind: one of `KINDS`.
      flow: the distribution over fields whose mean is the field of kind FLOW.
      mesh: devices that share the rays and the sample buffer.

    Raises:
      ConfigError: options that do not go together.
    """
    field, sampler = build_field(config, scene, num_views, learned_variance=kind == VARIANCE)
    train = config.train
    capacity = train.capacity // num_shards(mesh)
    if not sampler.dense and capacity < sampler.num_slots:
        raise ConfigError(
            f"config.train.capacity: {capacity} samples of a device cannot hold the "
            f"{sampler.num_slots} of one ray (config.march.num_slots): give more"
        )
    buffer = {"capacity": capacity, "mesh": mesh}
    if kind == FLOW:
        field = mean_field(flow)
        objective = make_flow_objective(flow, **buffer, **config.flow_training)
    elif kind == VARIANCE:
        objective = make_variance_objective(field, **buffer)
    else:
        objective = make_colour_objective(field, **buffer)
    training = RayTraining(
        objective,
        num_rays=train.num_rays,
        rays_per_pixel=config.rays_per_pixel,
        random_background=train.random_background,
        penalty_weight=train.penalty_weight,
        roughness_weight=train.roughness_weight,
        capacity_before_hiding=train.look_ahead * capacity,
    )
    return RayField(
        field,
        sampler,
        background=field_background(scene),
        box=None if scene.unbounded else scene.box,
        capacity=8 * RENDER_CHUNK // num_shards(mesh),
        training=training,
        mesh=mesh,
    )


def build_trainer(config, model: RayField) -> Trainer:
    """How a model is trained in each round of a config.

    At first one ray goes through each pixel, so that a step sees as many pixels as rays; then
    `config.rays_per_pixel`, whose mean is what a photo shows.
    """
    train = config.train
    optimiser, schedule = make_optimiser(
        learning_rate=learning_rate(config),
        final_share=train.final_share,
        num_steps=train.num_steps,
        warmup=train.warmup_steps,
        max_grad_norm=train.max_grad_norm,
        second_decay=train.adam_b2,
        epsilon=train.adam_eps,
    )

    def call_of(rays_per_pixel: int) -> TrainCall:
        training = model.training._replace(rays_per_pixel=rays_per_pixel)
        return make_train_fn(
            dataclasses.replace(model, training=training),
            optimiser,
            schedule,
            average_age=train.average_age,
            steps_per_call=train.steps_per_call,
            mesh=model.mesh,
        )

    call = later = call_of(config.rays_per_pixel)
    if config.rays_per_pixel > 1:
        first, num_first = call_of(1), train.one_ray_share * train.num_steps

        def call(key, state, table, is_training_view):
            this = first if int(state.step) < num_first else later
            return this(key, state, table, is_training_view)

    fresh = jax.jit(partial(init_train_state, model=model, optimiser=optimiser))
    num_calls = -(-train.num_steps // train.steps_per_call)
    return Trainer(
        init=lambda key: put_on_all(fresh(key), model.mesh),
        call=call,
        num_calls=num_calls,
        check_call=check_call(num_calls, train.steps_per_call),
    )


def train_aside(config, trainer: Trainer, key, acquired: Acquired, kind: str, track) -> TrainState:
    """Trains a field beside the run's own, on the same views for as many steps.

    Raises:
      FloatingPointError: the loss is not finite.
    """
    steps = config.train.steps_per_call
    init_key, steps_key = jax.random.split(jax.random.fold_in(key, 0))
    state = trainer.init(init_key)
    table, mask = acquired.table, acquired.is_training_view
    with track(trainer.num_calls * steps, f"{acquired.label}: train {kind}", "steps") as bar:
        for fitted in fit(steps_key, trainer, state, table, mask, label=f"{kind} field"):
            state = fitted.train
            bar.advance(steps, loss=float(fitted.info.loss))
            if fitted.calls == 0:
                warn(
                    f"{acquired.label}: the {kind} field is stuck: trained anew with another key "
                    f"({fitted.restarts})"
                )
    return state
