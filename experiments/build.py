"""From a config to the parts of a run. The only reader of configs."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax import active
from bavs_jax.cameras import take
from bavs_jax.candidates import (
    CandidateSource,
    captured_candidates,
    dataset_candidates,
    with_empty_views,
)
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.metrics.perceptual import make_lpips_fn
from bavs_jax.scenes import Scene, SceneError, load_scene
from bavs_jax.scenes.procedural import capture
from bavs_jax.selection.distances import Radii
from bavs_jax.selection.policies import get_policy
from bavs_jax.selection.policy import MODES
from bavs_jax.training.batches import PixelTable, make_pixel_table
from bavs_jax.training.train import (
    TrainState,
    init_train_state,
    make_optimiser,
    make_train_fn,
)
from bavs_jax.uncertainty.channel import SCALES, VARIANTS, vertex_variance
from bavs_jax.uncertainty.curvature import WEIGHTINGS
from bavs_jax.uncertainty.posterior import default_prior_weight
from bavs_jax.uncertainty.scoring import make_render_chunk_fn, mean_uncertainty, reduced_cameras
from bavs_jax.uncertainty.streaming import make_curvature_fn
from experiments.build_field import build_field, field_background, learning_rate
from experiments.errors import ConfigError, check_choice

RENDER_CHUNK = 4096  # rays of one compiled rendering call


class Problem(NamedTuple):
    """One scene with everything that is compiled for it; shared by all policies and seeds."""

    scene: Scene
    table: PixelTable
    init_train: Callable  # key -> TrainState
    make_step: Callable  # (policy name, initial views, track, label) -> an active step
    render: Callable  # (TrainState, jac_sq_sum or None, num_rays) -> (Rays [chunk] -> dict)
    curvature: Callable  # (TrainState, table, view_ids, within, progress_fn) -> jac_sq_sum
    density: Callable  # (TrainState, positions [K, 3]) -> density [K], 0 where nothing is rendered
    lpips_fn: Callable | None
    lpips_reason: str | None
    calls_per_round: int
    has_empty_views: bool  # whether the table has room for pictures taken on the way
    first_empty_row: int  # of the pixel table


def load_config_scene(config, *, cache_dir: str | None) -> Scene:
    """The scene that a config names, from its `data_dir` or from $BAVS_DATA.

    Raises:
      SceneError: neither is given, or the scene's files cannot be used.
    """
    if config.loader == "procedural":
        return load_scene("procedural", image_size=config.image_size, cache_dir=cache_dir)
    folder = config.data_dir
    if not folder:
        if not os.environ.get("BAVS_DATA"):
            raise SceneError(
                "config.data_dir: is empty and BAVS_DATA is not set: "
                "pass --config.data_dir=FOLDER_OF_SCENES"
            )
        folder = os.path.join(os.environ["BAVS_DATA"], config.loader)
    root = os.path.join(folder, config.scene)
    options = {name: value for name, value in config.load.items() if value}
    if options.get("pool_size", 0.0) >= 1:
        options["pool_size"] = int(options["pool_size"])
    return load_scene(config.loader, root=root, image_size=config.image_size, **options)


def initial_views(scene: Scene, seed: int, num: int) -> np.ndarray:
    """Which views a run starts with: a function of seed and scene alone, never of the policy.

    A `num` of 0 takes all of the pool.
    """
    num = num or len(scene.pool)
    if not 1 <= num <= len(scene.pool):
        raise SceneError(
            f"{scene.name}: num_initial is {num}, but the pool has {len(scene.pool)} views: "
            "give a number between 1 and that"
        )
    return np.random.default_rng(seed).permutation(np.asarray(scene.pool))[:num]


def check_choices(config) -> None:
    """Raises ConfigError for an option that is not one of its choices."""
    for name, kind in (("policies", str), ("seeds", int)):
        values = config[name]
        if not isinstance(values, tuple) or not all(isinstance(v, kind) for v in values):
            raise ConfigError(
                f"config.{name}: is {values!r}; give a tuple of {kind.__name__}, "
                f"such as {(kind(1), kind(2))}"
            )
    options = config.uncertainty
    for name, value, known in (
        ("uncertainty.weighting", options.weighting, WEIGHTINGS),
        ("uncertainty.variant", options.variant, VARIANTS),
        ("uncertainty.scale", options.scale, SCALES),
        ("candidates.source", config.candidates.source, ("dataset", "hemisphere")),
        ("candidates.mode", config.candidates.mode, ("", *MODES)),
    ):
        check_choice(name, value, known)


def build_problem(config, scene: Scene) -> Problem:
    """Puts fields, renderer, training, curvature and selection together.

    Raises:
      ConfigError: an option that cannot be used.
    """
    check_choices(config)
    table = make_pixel_table(scene)
    source, table = _make_source(config, scene, table)
    field, sampler = build_field(config, scene, num_views=len(table.cameras))
    background = field_background(scene)
    train = config.train
    optimiser, schedule = make_optimiser(
        learning_rate=learning_rate(config),
        final_share=train.final_share,
        num_steps=train.num_steps,
    )
    train_call = make_train_fn(
        field,
        sampler,
        optimiser,
        schedule,
        background=background,
        num_rays=train.num_rays,
        capacity=train.capacity,
        penalty_weight=train.penalty_weight,
        steps_per_call=train.steps_per_call,
    )
    init_train = jax.jit(
        partial(init_train_state, field=field, sampler=sampler, optimiser=optimiser)
    )

    options = config.uncertainty
    grid = DeformationGrid(jnp.asarray(scene.box), options.log2_cells, contracted=scene.unbounded)
    prior_weight = options.prior_weight or default_prior_weight(options.log2_cells)
    curvature_fn = make_curvature_fn(
        field, sampler, grid, background=background, weighting=options.weighting
    )
    render_chunk = make_render_chunk_fn(
        field,
        sampler,
        grid,
        background=background,
        capacity=8 * RENDER_CHUNK,
        variant=options.variant,
        scale=options.scale,
    )

    def curvature(state: TrainState, table, view_ids, within, progress_fn=None):
        return curvature_fn(
            state.params, state.sampler_state, table, view_ids, within, progress_fn=progress_fn
        )

    def render(state: TrainState, jac_sq_sum=None, num_rays: int = 0):
        if jac_sq_sum is None:
            return partial(render_chunk, state.params, state.sampler_state, None)
        variance = vertex_variance(
            jac_sq_sum,
            num_rays=num_rays,
            prior_weight=prior_weight,
            weighting=options.weighting,
            variant=options.variant,
        )
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
        fresh = init_train(key)
        if config.from_scratch:
            return fresh
        return fresh.replace(params=state.params, sampler_state=state.sampler_state)

    calls_per_round = -(-train.num_steps // train.steps_per_call)
    lpips_fn, lpips_reason = (None, "switched off: config.lpips_net is empty")
    if config.lpips_net:
        lpips_fn, lpips_reason = make_lpips_fn(config.lpips_net)

    def make_step(policy_name: str, initial, track: Callable, label: str):
        num_rays = _count_pixels(scene, initial)

        def make_score_fn(state, jac_sq_sum, cameras):
            chunk_fn = render(state, jac_sq_sum, num_rays)

            def score(indices):
                scale = config.candidates.image_scale
                small = reduced_cameras(take(cameras, indices), scale)
                num_rays = int(np.prod(np.asarray(small.sizes), axis=-1).sum())
                with track(num_rays, f"{label}: score {len(indices)} views", "rays") as task:
                    return mean_uncertainty(
                        chunk_fn, small, chunk=RENDER_CHUNK, progress_fn=task.advance
                    )

            return score

        def tracked_curvature(state, table, view_ids, within):
            with track(len(view_ids), f"{label}: curvature", "rays") as task:
                return curvature(state, table, view_ids, within, progress_fn=task.advance)

        stages = active.Stages(train_call, restart, tracked_curvature, make_score_fn)
        return active.make_active_step(
            get_policy(policy_name),
            stages,
            source,
            centre=scene.centre,
            batch_size=config.batch_size,
            calls_per_round=calls_per_round,
            max_curvature_rays=options.max_rays or None,
            radii=_radii(config),
            mode=config.candidates.mode or None,
        )

    return Problem(
        scene=scene,
        table=table,
        init_train=init_train,
        make_step=make_step,
        render=render,
        curvature=curvature,
        density=density,
        lpips_fn=lpips_fn,
        lpips_reason=lpips_reason,
        calls_per_round=calls_per_round,
        has_empty_views=len(table.cameras) > scene.num_views,
        first_empty_row=int(scene.offsets[-1]),
    )


def _count_pixels(scene: Scene, view_ids) -> int:
    return int(np.diff(scene.offsets)[np.asarray(view_ids)].sum())


def _radii(config) -> Radii | None:
    given = (config.candidates.min_train_distance, config.candidates.min_candidate_distance)
    if given == (0.0, 0.0):
        return None
    if 0.0 in given:
        raise ConfigError(
            "config.candidates: give both min_train_distance and min_candidate_distance, or neither"
        )
    return Radii(*given)


def _make_source(config, scene: Scene, table: PixelTable) -> tuple[CandidateSource, PixelTable]:
    options = config.candidates
    if options.source == "dataset":
        return dataset_candidates(scene), table
    draws = options.hemisphere_draws
    if config.loader != "procedural":
        return dataset_candidates(scene, hemisphere_draws=draws), table
    first_slot = len(table.cameras)
    table = with_empty_views(table, config.num_rounds * config.batch_size)
    source = captured_candidates(
        scene,
        lambda cameras: capture(cameras)[0],
        num_candidates=draws,
        first_slot=first_slot,
    )
    return source, table


def run_key(seed: int) -> jax.Array:
    """The key from which all of a run's randomness comes."""
    return jax.random.key(seed)
