"""From a config and a scene to the field and its sampler."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np

from bavs_jax.fields.base import DensityField, Field
from bavs_jax.fields.flow_field import FlowField, FlowOptions, make_flow_field, make_flow_mlp_field
from bavs_jax.fields.hash_grid import (
    HashGridOptions,
    make_hash_grid_density,
    make_hash_grid_field,
)
from bavs_jax.fields.nerf_mlp import NerfMlpOptions, make_mlp_density, make_nerf_mlp_field
from bavs_jax.fields.positional import PIXEL_TO_RADIUS
from bavs_jax.rendering.coarse_to_fine import make_coarse_to_fine_sampler
from bavs_jax.rendering.proposals import make_proposal_sampler
from bavs_jax.rendering.samplers import Sampler, make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.rendering.spacing import box_intervals, open_intervals
from bavs_jax.scenes import Scene
from experiments.errors import ConfigError

# What can sample each kind of field; the first that suits the scene is the default.
SAMPLERS = {
    "hash_grid": ("occupancy", "proposal"),
    "nerf_mlp": ("coarse_to_fine", "proposal", "occupancy"),
    "mip_mlp": ("proposal",),
}
LEARNING_RATES = {"hash_grid": 1e-2, "nerf_mlp": 1e-3, "mip_mlp": 1e-3}


def build_field(
    config, scene: Scene, num_views: int, *, learned_variance: bool = False
) -> tuple[Field, Sampler]:
    """The radiance field that a config names, and how rays are sampled for it.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene; an unbounded one is contracted, and sampled by proposals.
      num_views: views of the pixel table, some of them possibly still empty.
      learned_variance: whether the field also learns a variance of its colours.

    Raises:
      ConfigError: kinds that do not go together.
    """
    field_kind = config.field_kind
    # An occupancy grid ends at the box.
    suitable = [k for k in SAMPLERS[field_kind] if not (scene.unbounded and k == "occupancy")]
    sampler_kind = config.sampler_kind or suitable[0]
    if sampler_kind not in suitable:
        where = "an unbounded scene" if scene.unbounded else "a bounded scene"
        raise ConfigError(
            f"config.sampler_kind: {sampler_kind!r} does not go with field_kind {field_kind!r} in "
            f"{where}; use one of {tuple(suitable)}"
        )
    if field_kind == "mip_mlp" and scene.unbounded:
        raise ConfigError(
            f"config.field_kind: 'mip_mlp' is for bounded scenes, and {scene.name} is not; "
            "use 'hash_grid' or 'nerf_mlp'"
        )
    if sampler_kind == "occupancy":
        sampler = _occupancy_sampler(config.march, scene)
    elif sampler_kind == "proposal":
        sampler = _proposal_sampler(config, scene)
    else:
        sampler = _coarse_to_fine_sampler(config, scene)
    return _make_field(config, scene, num_views, learned_variance), sampler


def _make_field(config, scene: Scene, num_views: int, learned_variance: bool) -> Field:
    if config.field_kind == "hash_grid":
        return make_hash_grid_field(
            scene.box,
            HashGridOptions(**config.hash_grid),
            contracted=scene.unbounded,
            num_views=num_views,
            learned_variance=learned_variance,
        )
    return make_nerf_mlp_field(
        scene.box,
        _mlp_options(config),
        contracted=scene.unbounded,
        pixel_radius=_pixel_radius(scene) if config.field_kind == "mip_mlp" else None,
        learned_variance=learned_variance,
    )


def _mlp_options(config) -> NerfMlpOptions:
    options = config[config.field_kind]
    names = [field.name for field in dataclasses.fields(NerfMlpOptions)]
    return NerfMlpOptions(**{name: options[name] for name in names})


def build_flow(config, scene: Scene) -> FlowField:
    """The distribution over fields that goes with a config's kind of field."""
    flow = FlowOptions(**config.flow)
    if config.field_kind == "hash_grid":
        grid = HashGridOptions(**config.hash_grid)
        return make_flow_field(scene.box, grid, flow, contracted=scene.unbounded)
    return make_flow_mlp_field(scene.box, _mlp_options(config), flow, contracted=scene.unbounded)


def _pixel_radius(scene: Scene) -> float:
    """Radius of a pixel's cone at distance 1, for the scene's median focal length."""
    return PIXEL_TO_RADIUS / float(np.median(scene.cameras.intrinsics[:, :2]))


def learning_rate(config) -> float:
    """The config's learning rate, or what suits the kind of field."""
    return config.train.learning_rate or LEARNING_RATES[config.field_kind]


def field_background(scene: Scene) -> np.ndarray | None:
    """What lies behind everything: in an unbounded scene the last sample of each ray."""
    return None if scene.unbounded else np.asarray(scene.background, np.float32)


def _interval_fn(scene: Scene, far: float):
    if not scene.unbounded:
        return partial(box_intervals, box=scene.box, near=scene.near, far=scene.far)
    unit = float(np.mean(scene.box[1] - scene.box[0]) / 2)
    return partial(open_intervals, near=scene.near, far=max(far * unit, scene.far), unit=unit)


def _occupancy_sampler(options, scene: Scene) -> Sampler:
    march_options = make_march_options(
        scene.box,
        near=scene.near,
        far=scene.far,
        num_steps=options.num_steps,
        num_slots=options.num_slots,
    )
    return make_occupancy_sampler(scene.box, march_options, resolution=options.occupancy_resolution)


def _coarse_to_fine_sampler(config, scene: Scene) -> Sampler:
    options = config.coarse_to_fine
    return make_coarse_to_fine_sampler(
        make_nerf_mlp_field(scene.box, _mlp_options(config), contracted=scene.unbounded),
        _interval_fn(scene, config.proposal.far),
        background=field_background(scene),
        num_coarse=options.num_coarse,
        num_fine=options.num_fine,
    )


def _proposal_fields(config, scene: Scene) -> list[DensityField]:
    options = config.proposal
    if config.field_kind == "mip_mlp":
        proposal = make_mlp_density(
            scene.box,
            depth=config.mip_mlp.proposal_depth,
            width=config.mip_mlp.proposal_width,
            position_degree=config.mip_mlp.position_degree,
            pixel_radius=_pixel_radius(scene),
        )
        return [proposal] * len(options.num_proposals)
    if len(options.num_proposals) != len(options.finest):
        raise ConfigError(
            f"config.proposal.finest: has {len(options.finest)} entries for "
            f"{len(options.num_proposals)} in num_proposals; give as many"
        )
    return [
        make_hash_grid_density(
            scene.box,
            HashGridOptions(
                num_levels=options.num_levels,
                coarsest=options.coarsest,
                finest=finest,
                log2_table_size=options.log2_table_size,
                width=options.width,
            ),
            contracted=scene.unbounded,
        )
        for finest in options.finest
    ]


def _proposal_sampler(config, scene: Scene) -> Sampler:
    options = config.proposal
    return make_proposal_sampler(
        _proposal_fields(config, scene),
        _interval_fn(scene, options.far),
        num_proposals=tuple(options.num_proposals),
        num_samples=options.num_samples,
        anneal_steps=options.anneal_steps,
        interlevel_weight=options.interlevel_weight,
        distortion_weight=options.distortion_weight,
        penalty_weight=options.penalty_weight,
    )
