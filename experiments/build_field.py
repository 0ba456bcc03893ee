"""From a config and a scene to the field and its sampler."""

from __future__ import annotations

from functools import partial

import numpy as np

from bavs_jax.fields.base import Field
from bavs_jax.fields.hash_grid import make_hash_grid_density, make_hash_grid_field
from bavs_jax.rendering.proposals import make_proposal_sampler
from bavs_jax.rendering.samplers import Sampler, make_occupancy_sampler
from bavs_jax.rendering.sampling import make_march_options
from bavs_jax.rendering.spacing import box_intervals, open_intervals
from bavs_jax.scenes import Scene
from experiments.errors import ConfigError, check_choice

# The first sampler of each kind is its default in a bounded scene.
SAMPLERS = {"hash_grid": ("occupancy", "proposal")}
LEARNING_RATES = {"hash_grid": 1e-2}


def build_field(config, scene: Scene, num_views: int) -> tuple[Field, Sampler]:
    """The radiance field that a config names, and how rays are sampled for it.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene; an unbounded one is contracted, and sampled by proposals.
      num_views: views of the pixel table, some of them possibly still empty.

    Raises:
      ConfigError: an unknown kind, or kinds that do not go together.
    """
    check_choice("field_kind", config.field_kind, SAMPLERS)
    kind = config.sampler_kind or _default_sampler(config.field_kind, scene)
    check_choice("sampler_kind", kind, SAMPLERS[config.field_kind])
    if scene.unbounded and kind == "occupancy":
        raise ConfigError(
            f"config.sampler_kind: 'occupancy' ends at the box, but {scene.name} is unbounded; "
            "use 'proposal'"
        )
    field = make_hash_grid_field(
        scene.box, contracted=scene.unbounded, num_views=num_views, **config.field
    )
    if kind == "occupancy":
        return field, _occupancy_sampler(config.march, scene)
    return field, _proposal_sampler(config.proposal, scene)


def learning_rate(config) -> float:
    """The config's learning rate, or what suits the kind of field."""
    return config.train.learning_rate or LEARNING_RATES[config.field_kind]


def field_background(scene: Scene) -> np.ndarray | None:
    """What lies behind everything: in an unbounded scene the last sample of each ray."""
    return None if scene.unbounded else np.asarray(scene.background, np.float32)


def _default_sampler(field_kind: str, scene: Scene) -> str:
    return "proposal" if scene.unbounded else SAMPLERS[field_kind][0]


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


def _proposal_sampler(options, scene: Scene) -> Sampler:
    if len(options.num_proposals) != len(options.finest):
        raise ConfigError(
            f"config.proposal.finest: has {len(options.finest)} entries for "
            f"{len(options.num_proposals)} in num_proposals; give as many"
        )
    proposals = [
        make_hash_grid_density(
            scene.box,
            num_levels=options.num_levels,
            coarsest=options.coarsest,
            finest=finest,
            log2_table_size=options.log2_table_size,
            width=options.width,
            contracted=scene.unbounded,
        )
        for finest in options.finest
    ]
    return make_proposal_sampler(
        proposals,
        _interval_fn(scene, options.far),
        num_proposals=tuple(options.num_proposals),
        num_samples=options.num_samples,
        anneal_steps=options.anneal_steps,
        interlevel_weight=options.interlevel_weight,
        distortion_weight=options.distortion_weight,
        penalty_weight=options.penalty_weight,
    )
