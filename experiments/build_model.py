"""From a config and a scene to a field, its sampler, the model of both, and how it is trained."""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from functools import partial

import jax
import numpy as np
from jax.sharding import Mesh

from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields import flow_field, hash_grid, nerf_mlp
from bavs_jax.fields.base import Field
from bavs_jax.fields.flow_field import FlowField, FlowOptions
from bavs_jax.fields.hash_grid import HashGridOptions
from bavs_jax.fields.nerf_mlp import NerfMlpOptions
from bavs_jax.fields.positional import PIXEL_TO_RADIUS
from bavs_jax.models import objectives
from bavs_jax.models.ray_field import RayField, RayTraining
from bavs_jax.pixel_table import PixelTable
from bavs_jax.rendering.coarse_to_fine import make_coarse_to_fine_sampler
from bavs_jax.rendering.proposals import make_proposal_sampler
from bavs_jax.rendering.samplers import Sampler, make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.rendering.spacing import box_intervals, open_intervals
from bavs_jax.scenes import Scene
from bavs_jax.training.fit import Fitted, Trainer, check_call, fit
from bavs_jax.training.train import TrainState, init_train_state, make_optimiser, make_train_fn
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE, Acquired
from experiments.runtime import ConfigError, warn
from experiments.runtime import track as show_progress

KINDS = (RECONSTRUCTION, VARIANCE, FLOW)
RENDER_CHUNK = 4096  # rays of one compiled rendering call
RENDER_CAPACITY = 2 * RENDER_CHUNK  # samples of one of its passes: rays of a trained field need 3
SHARES = (0.5, 1.0)  # of the sample buffer, for steps with fewer samples; each compiles once more
SPARE = 1.1  # times the places that one batch needs are enough for the next ones
YOUNG = 256  # steps, in which a field changes too fast to say what the next ones need
THIN_SHARE = 1 / 15  # of the optical depth before training, in a room that cameras stand in
# What can sample each kind of field; the first that suits the scene is the default.
SAMPLERS = {
    "hash_grid": ("occupancy", "proposal"),
    "nerf_mlp": ("coarse_to_fine", "proposal", "occupancy"),
    "mip_mlp": ("proposal",),
}
LEARNING_RATES = {"hash_grid": 1e-2, "nerf_mlp": 1e-3, "mip_mlp": 1e-3}


def only(options, *names: str) -> dict:
    """Some options of a group, as keyword arguments of the same names."""
    return {name: options[name] for name in names}


# --- fields ----------------------------------------------------------------------------------


def build_field(
    config, scene: Scene, num_views: int, *, learned_variance: bool = False
) -> tuple[Field, Sampler]:
    """The radiance field that a config names, and how rays are sampled for it.

    An unbounded scene is contracted, and sampled by proposals. `num_views` are those of the pixel
    table. Raises ConfigError for kinds that do not go together.
    """
    kind, box, contracted = config.field_kind, scene.box, scene.unbounded
    # An occupancy grid ends at the box.
    suitable = [name for name in SAMPLERS[kind] if not (contracted and name == "occupancy")]
    sampler_kind = config.sampler_kind or suitable[0]
    if sampler_kind not in suitable:
        where = "an unbounded scene" if contracted else "a bounded scene"
        raise ConfigError(
            f"config.sampler_kind: {sampler_kind!r} does not go with field_kind {kind!r} in "
            f"{where}; use one of {tuple(suitable)}"
        )
    if kind == "mip_mlp" and contracted:
        raise ConfigError(
            f"config.field_kind: 'mip_mlp' is for bounded scenes, and {scene.name} is not; "
            "use 'hash_grid' or 'nerf_mlp'"
        )
    options = {"contracted": contracted, "learned_variance": learned_variance}
    if kind == "hash_grid":
        grid = _grid_options(config, scene)
        field = hash_grid.make_hash_grid_field(box, grid, num_views=num_views, **options)
    else:
        options["pixel_radius"] = _pixel_radius(scene) if kind == "mip_mlp" else None
        field = nerf_mlp.make_nerf_mlp_field(box, _mlp_options(config), **options)
    return field, _build_sampler(config, scene, sampler_kind)


def _grid_options(config, scene: Scene) -> HashGridOptions:
    options = HashGridOptions(**config.hash_grid)
    if scene.closed:  # nothing lies behind that a fog would have to hide: see `march`
        thin = THIN_SHARE * options.initial_optical_depth
        options = dataclasses.replace(options, initial_optical_depth=thin)
    return options


def _mlp_options(config) -> NerfMlpOptions:
    names = (field.name for field in dataclasses.fields(NerfMlpOptions))
    return NerfMlpOptions(**only(config[config.field_kind], *names))


def build_flow(config, scene: Scene) -> FlowField:
    """The distribution over fields that goes with a config's kind of field."""
    flow, where = FlowOptions(**config.flow), {"contracted": scene.unbounded}
    if config.field_kind == "hash_grid":
        grid = _grid_options(config, scene)
        return flow_field.make_flow_field(scene.box, grid, flow, **where)
    return flow_field.make_flow_mlp_field(scene.box, _mlp_options(config), flow, **where)


def _pixel_radius(scene: Scene) -> float:
    """Radius of a pixel's cone at distance 1, for the scene's median focal length."""
    return PIXEL_TO_RADIUS / float(np.median(scene.cameras.intrinsics[:, :2]))


def _background(scene: Scene) -> np.ndarray | None:
    """What lies behind everything: in an unbounded scene the last sample of each ray."""
    return None if scene.unbounded else np.asarray(scene.background, np.float32)


# --- samplers --------------------------------------------------------------------------------


def _build_sampler(config, scene: Scene, kind: str) -> Sampler:
    near, far, box = scene.near, scene.far, scene.box
    if kind == "occupancy":
        limits = only(config.march, "num_steps", "num_slots")
        march_options = make_march_options(box, near=near, far=far, closed=scene.closed, **limits)
        return make_occupancy_sampler(
            box, march_options, resolution=config.march.occupancy_resolution
        )
    if scene.unbounded:
        unit = float(np.mean(box[1] - box[0]) / 2)
        far = max(config.proposal.far * unit, far)
        interval_fn = partial(open_intervals, near=near, far=far, unit=unit)
    else:
        interval_fn = partial(box_intervals, box=box, near=near, far=far)
    if kind == "coarse_to_fine":
        coarse = nerf_mlp.make_nerf_mlp_field(box, _mlp_options(config), contracted=scene.unbounded)
        return make_coarse_to_fine_sampler(
            coarse, interval_fn, background=_background(scene), **config.coarse_to_fine
        )
    options = config.proposal
    if config.field_kind == "mip_mlp":
        density = nerf_mlp.make_mlp_density(
            box,
            depth=config.mip_mlp.proposal_depth,
            width=config.mip_mlp.proposal_width,
            position_degree=config.mip_mlp.position_degree,
            pixel_radius=_pixel_radius(scene),
        )
        densities = [density] * len(options.num_proposals)
    elif len(options.num_proposals) != len(options.finest):
        raise ConfigError(
            f"config.proposal.finest: has {len(options.finest)} entries for "
            f"{len(options.num_proposals)} in num_proposals; give as many"
        )
    else:
        shape = only(options, "num_levels", "coarsest", "log2_table_size", "width")
        grids = [HashGridOptions(finest=finest, **shape) for finest in options.finest]
        make = partial(hash_grid.make_hash_grid_density, contracted=scene.unbounded)
        densities = [make(box, grid) for grid in grids]
    weights = only(options, "interlevel_weight", "distortion_weight", "penalty_weight")
    counts = only(options, "num_proposals", "num_samples", "anneal_steps")
    return make_proposal_sampler(densities, interval_fn, **counts, **weights)


# --- models and their training ---------------------------------------------------------------


def build_model(
    config, scene: Scene, num_views: int, kind: str, flow: FlowField, mesh: Mesh | None = None
) -> RayField:
    """The model of one of `KINDS`; compiles nothing yet.

    `num_views` are those of the pixel table; the devices of a `mesh` share rays and sample buffer;
    the mean of `flow` is the field of kind FLOW. Raises ConfigError for options that do not go
    together.
    """
    field, sampler = build_field(config, scene, num_views, learned_variance=kind == VARIANCE)
    train = config.train
    capacity = train.capacity // num_shards(mesh)
    if not sampler.dense and capacity < sampler.num_slots:
        raise ConfigError(
            f"config.train.capacity: {capacity} samples of a device cannot hold the "
            f"{sampler.num_slots} of one ray (config.march.num_slots): give more"
        )
    if kind == FLOW:
        field = flow_field.mean_field(flow)
        objective = objectives.make_flow_objective(flow, mesh=mesh, **config.flow_training)
    elif kind == VARIANCE:
        objective = objectives.make_variance_objective(field, mesh=mesh)
    else:
        objective = objectives.make_colour_objective(field, mesh=mesh)
    training = RayTraining(
        objective,
        capacity=capacity,
        rays_per_pixel=config.rays_per_pixel,
        look_ahead=train.look_ahead,
        **only(train, "num_rays", "random_background", "penalty_weight", "roughness_weight"),
    )
    return RayField(
        field,
        sampler,
        background=_background(scene),
        box=None if scene.unbounded else scene.box,
        capacity=RENDER_CAPACITY // num_shards(mesh),
        training=training,
        mesh=mesh,
    )


def fitting_capacity(needed: int, capacity: int, most_points: int) -> int:
    """The smallest of a few shares of a sample buffer that a training step needs.

    Args:
      needed: places that the samples of one batch take (`RayField.places_needed`).
      capacity: of the whole buffer, which is used where no smaller one is enough.
      most_points: samples of one ray, which any buffer must hold.
    """
    sizes = [round(share * capacity) for share in SHARES]
    enough = max(SPARE * needed, most_points)
    return next((size for size in sizes if size >= enough), capacity)


def build_trainer(config, model: RayField) -> Trainer:
    """How a model is trained in each round of a config.

    At first one ray goes through each pixel, so that a step sees as many pixels as rays; then
    `config.rays_per_pixel`, whose mean is what a photo shows. Work goes with the size of the sample
    buffer, not with what is in it: once few samples are left to evaluate, a smaller one is used.
    Which, is asked of the field before each compiled call, so that training that was stopped goes
    on the same way.
    """
    train = config.train
    learning_rate = train.learning_rate
    if learning_rate is None:
        learning_rate = LEARNING_RATES[config.field_kind]
    optimiser, schedule = make_optimiser(
        learning_rate=learning_rate,
        warmup=train.warmup_steps,
        second_decay=train.adam_b2,
        epsilon=train.adam_eps,
        **only(train, "final_share", "num_steps", "max_grad_norm"),
    )

    @functools.cache
    def looking(rays_per_pixel: int, capacity: int) -> RayField:
        training = {"rays_per_pixel": rays_per_pixel, "capacity": capacity}
        return dataclasses.replace(model, training=model.training._replace(**training))

    @functools.cache
    def steps(rays_per_pixel: int, capacity: int):
        return make_train_fn(
            looking(rays_per_pixel, capacity),
            optimiser,
            schedule,
            mesh=model.mesh,
            **only(train, "average_age", "steps_per_call"),
        )

    @functools.cache
    def places(rays_per_pixel: int):
        return jax.jit(looking(rays_per_pixel, model.training.capacity).places_needed)

    def call(key, state, table, is_training_view):
        one_ray = int(state.step) < train.one_ray_share * train.num_steps
        rays_per_pixel = 1 if one_ray else config.rays_per_pixel
        capacity = model.training.capacity
        if int(state.step) >= YOUNG and not model.sampler.dense:
            needed = places(rays_per_pixel)(key, state.model, table, is_training_view)
            capacity = fitting_capacity(int(needed), capacity, model.most_points)
        return steps(rays_per_pixel, capacity)(key, state, table, is_training_view)

    fresh = jax.jit(partial(init_train_state, model=model, optimiser=optimiser))
    num_calls = -(-train.num_steps // train.steps_per_call)
    return Trainer(
        init=lambda key: put_on_all(fresh(key), model.mesh),
        call=call,
        num_calls=num_calls,
        check_call=check_call(num_calls, train.steps_per_call),
    )


def train_with_bar(
    key,
    trainer: Trainer,
    train: TrainState,
    table: PixelTable,
    is_training_view,
    *,
    steps_per_call: int,
    label: str,
    track: Callable = show_progress,
    calls: int = 0,
    restarts: int = 0,
) -> Iterator[Fitted]:
    """`fit`, with a bar that counts optimiser steps and a warning for each fresh start.

    `track(total, label, unit)` shows progress; see `fit` for all else.
    """
    done = {"calls": calls, "restarts": restarts}
    with track((trainer.num_calls - calls) * steps_per_call, label, "steps") as bar:
        for fitted in fit(key, trainer, train, table, is_training_view, **done, label=label):
            loss, fog = float(fitted.info.loss), float(fitted.info.thinned)
            bar.advance(steps_per_call, loss=loss, psnr=float(-10.0 * np.log10(loss)))
            if fitted.calls == 0:
                warn(
                    f"{label}: the field is stuck (loss {loss:.3g}, {fog:.0%} of the rays full of "
                    f"fog): trained anew with another key ({fitted.restarts})"
                )
            yield fitted


def train_aside(config, trainer: Trainer, key, acquired: Acquired, kind: str, track) -> TrainState:
    """Trains a field beside the run's own, on the same views for as many steps.

    Raises:
      FloatingPointError: the loss is not finite.
    """
    init_key, steps_key = jax.random.split(jax.random.fold_in(key, 0))
    state = trainer.init(init_key)
    for fitted in train_with_bar(
        steps_key,
        trainer,
        state,
        acquired.table,
        acquired.is_training_view,
        steps_per_call=config.train.steps_per_call,
        label=f"{acquired.label}: train {kind}",
        track=track,
    ):
        state = fitted.train
    return state
