"""From a config to the parts of a run. With `build_*` beside it, the only reader of configs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax import active
from bavs_jax.devices import num_shards, put_on_all
from bavs_jax.fields.deformation import DeformationGrid, offset_unit
from bavs_jax.metrics.perceptual import make_lpips_fn
from bavs_jax.scenes import Scene
from bavs_jax.selection.distances import Radii
from bavs_jax.selection.policies import get_policy
from bavs_jax.sources import SourceOptions, make_sources_fn
from bavs_jax.training.batches import PixelTable, make_pixel_table, num_training_pixels
from bavs_jax.training.fit import check_call, colour_spread, is_stuck
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.measures import make_true_error_fn
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, LaplaceOptions, Toolbox
from bavs_jax.uncertainty.models import MODELS
from bavs_jax.uncertainty.models.laplace import laplace_variance
from bavs_jax.uncertainty.posterior import default_prior_weight
from bavs_jax.uncertainty.scoring import make_render_chunk_fn
from bavs_jax.uncertainty.streaming import curvature_group_size, make_curvature_fn
from experiments.build_field import field_background
from experiments.build_scene import make_source
from experiments.build_trainer import KINDS, build_trainer, calls_per_round, train_aside
from experiments.errors import ConfigError

RENDER_CHUNK = 4096  # rays of one compiled rendering call


class Problem(NamedTuple):
    """One scene with everything that is compiled for it; shared by all policies and seeds."""

    scene: Scene
    kind: str  # of the field that is trained and measured
    table: PixelTable
    init_train: Callable  # key -> TrainState
    train_call: Callable  # see `make_train_fn`
    make_step: Callable  # (policy name, initial views, track, label) -> an active step
    render: Callable  # (TrainState, jac_sq_sum or None, num_rays) -> (Rays [chunk] -> dict)
    density: Callable  # (TrainState, positions [K, 3]) -> density [K], 0 where nothing is rendered
    make_toolbox: Callable  # track -> Toolbox
    model_fns: Callable  # (name of an uncertainty model, track) -> ModelFns
    sources: Callable  # track -> what `make_sources_fn` makes
    lpips_fn: Callable | None
    lpips_reason: str | None
    calls_per_round: int
    is_stuck: Callable  # (TrainInfo, ActiveState) -> bool: the last of a round has learnt nothing
    has_empty_views: bool  # whether the table has room for pictures taken on the way
    first_empty_row: int  # of the pixel table
    num_devices: int  # that share the rays


def build_problem(
    config, scene: Scene, kind: str = RECONSTRUCTION, mesh: Mesh | None = None
) -> Problem:
    """Puts fields, renderer, training, curvature and selection together.

    Args:
      config: see `experiments/configs/base.py`; `check_config` has seen it.
      scene: the scene.
      kind: of the field that the run trains and is measured on, one of `KINDS`.
      mesh: devices that share the work, from `make_mesh`.

    Raises:
      ConfigError: an option that cannot be used.
    """
    check_shards(config, mesh)
    capacity = 8 * RENDER_CHUNK // num_shards(mesh)
    source, table = make_source(config, scene, make_pixel_table(scene))
    table = put_on_all(table, mesh)
    trainers = {k: build_trainer(config, scene, len(table.cameras), k, mesh) for k in KINDS}
    trainer = trainers[kind]
    field, sampler = trainer.field, trainer.sampler
    background = field_background(scene)
    laplace, grid = _laplace_options(config, scene), _deformation_grid(config, scene)
    group_size = curvature_group_size(grid.num_vertices, len(table.cameras))

    @cache
    def curvature_fn(weighting: str):
        return make_curvature_fn(
            field, sampler, grid, background=background, weighting=weighting, mesh=mesh
        )

    render_chunk = make_render_chunk_fn(
        field,
        sampler,
        grid,
        background=background,
        capacity=capacity,
        variant=laplace.variant,
        scale=laplace.scale,
        extent=laplace.extent,
        mesh=mesh,
    )

    def render(state: TrainState, jac_sq_sum=None, num_rays: int = 0):
        if jac_sq_sum is None:
            return partial(render_chunk, state.params, state.sampler_state, None)
        variance = laplace_variance(jac_sq_sum, num_rays, laplace)
        return partial(render_chunk, state.params, state.sampler_state, variance)

    @jax.jit
    def density(state: TrainState, positions):
        density = field.density(state.params["field"], positions)
        if scene.unbounded:
            return density
        # Outside of its box a field reads the nearest face, but the renderer never looks there.
        lower, upper = jnp.asarray(scene.box)
        return jnp.where(((positions >= lower) & (positions <= upper)).all(-1), density, 0.0)

    def restart(key, state: TrainState) -> TrainState:
        fresh = trainer.init(key)
        if config.from_scratch:
            return fresh
        params = jax.tree.map(jnp.copy, state.params)  # training donates both of them
        return fresh.replace(
            params=state.params, last_params=params, sampler_state=state.sampler_state
        )

    def make_toolbox(track: Callable) -> Toolbox:
        def tracked_curvature(state, rays, label, *, weighting, group_ids=None, **of_rays):
            quiet = contextlib.nullcontext(None)
            with quiet if label is None else track(len(rays.origins), label, "rays") as task:
                sums = curvature_fn(weighting)(
                    state.params,
                    state.sampler_state,
                    rays,
                    progress_fn=task and task.advance,
                    group_ids=group_ids,
                    num_groups=group_size,  # in both cases, so that they share compilations
                    **of_rays,
                )
            return sums[0] if group_ids is None else sums

        def train(kind, key, situation):
            return train_aside(config, trainers[kind], key, situation, kind, track)

        return Toolbox(
            fields={name: (t.field, t.sampler) for name, t in trainers.items()},
            flow=trainers[FLOW].flow,
            kind=kind,
            background=background,
            capacity=capacity,
            grid=grid,
            laplace=laplace,
            group_size=group_size,
            curvature=tracked_curvature,
            train=train,
            image_scale=config.candidates.image_scale,
            chunk=RENDER_CHUNK,
            ensemble_size=config.uncertainty.ensemble_size,
            num_draws=config.uncertainty.flow_draws,
            mesh=mesh,
        )

    @cache
    def model_fns(name: str, track: Callable):
        return MODELS[name].make_fns(make_toolbox(track))

    true_error_fn = None
    if not _has_empty_views(scene, table):
        true_error_fn = make_true_error_fn(
            lambda state: partial(render_chunk, state.params, state.sampler_state, None),
            scene,
            image_scale=config.candidates.image_scale,
            chunk=RENDER_CHUNK,
        )

    @cache
    def sources_fn(track: Callable):
        return make_sources_fn(
            make_toolbox(track),
            {name: partial(model_fns, name, track) for name in MODELS},
            SourceOptions(image_scale=config.candidates.image_scale, chunk=RENDER_CHUNK),
            track=track,
            true_error_fn=true_error_fn,
        )

    def is_stuck_at_end(info, state) -> bool:
        if check_call(calls_per_round(config), config.train.steps_per_call) is None:
            return False  # too short a round to have learnt anything
        return is_stuck(info, colour_spread(state.table, state.is_training_view))

    def make_step(policy_name: str, initial, track: Callable, label: str):
        return active.make_active_step(
            get_policy(policy_name),
            active.Stages(trainer.call, trainer.init, restart, sources_fn(track)),
            source,
            centre=scene.centre,
            batch_size=config.batch_size,
            calls_per_round=calls_per_round(config),
            check_call=check_call(calls_per_round(config), config.train.steps_per_call),
            num_rays=int(num_training_pixels(scene, np.asarray(initial)).sum()),
            radii=_radii(config),
            mode=config.candidates.mode or None,
            label=label,
        )

    lpips_fn, lpips_reason = (None, "switched off: config.lpips_net is empty")
    if config.lpips_net:
        lpips_fn, lpips_reason = make_lpips_fn(config.lpips_net)
    return Problem(
        scene=scene,
        kind=kind,
        table=table,
        init_train=trainer.init,
        train_call=trainer.call,
        make_step=make_step,
        render=render,
        density=density,
        make_toolbox=make_toolbox,
        model_fns=model_fns,
        sources=sources_fn,
        lpips_fn=lpips_fn,
        lpips_reason=lpips_reason,
        calls_per_round=calls_per_round(config),
        is_stuck=is_stuck_at_end,
        has_empty_views=_has_empty_views(scene, table),
        first_empty_row=int(scene.offsets[-1]),
        num_devices=num_shards(mesh),
    )


def check_shards(config, mesh: Mesh | None) -> None:
    """Raises ConfigError if rays cannot be spread evenly over the devices of a mesh."""
    for name, num in (("config.train.num_rays", config.train.num_rays), ("images", RENDER_CHUNK)):
        if num % num_shards(mesh):
            raise ConfigError(
                f"{name}: {num} rays at once cannot be spread over {num_shards(mesh)} devices: "
                "take a number of --devices that divides them"
            )


def _has_empty_views(scene: Scene, table: PixelTable) -> bool:
    return len(table.cameras) > scene.num_views


def _deformation_grid(config, scene: Scene) -> DeformationGrid:
    cells = config.uncertainty.log2_cells
    return DeformationGrid(jnp.asarray(scene.box), cells, contracted=scene.unbounded)


def _laplace_options(config, scene: Scene) -> LaplaceOptions:
    options = config.uncertainty
    prior_weight = options.prior_weight or default_prior_weight(options.log2_cells)
    return LaplaceOptions(
        prior_weight=prior_weight / float(offset_unit(scene.box)) ** 2,
        weighting=options.weighting,
        variant=options.variant,
        scale=options.scale,
        extent=options.extent,
        max_rays=options.max_rays or None,
        offset_cells=options.offset_cells,
    )


def _radii(config) -> Radii | None:
    given = (config.candidates.min_train_distance, config.candidates.min_candidate_distance)
    return Radii(*given) if any(given) else None
