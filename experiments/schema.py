"""What every option of experiments/configs/base.py may be, checked before any work is done."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from typing import NamedTuple

from absl import flags
from ml_collections import ConfigDict

from bavs_jax.metrics.ause import ERRORS, variant_name
from bavs_jax.metrics.perceptual import NETS
from bavs_jax.scenes import LOADERS
from bavs_jax.scenes.lightfield import SPLITS
from bavs_jax.selection.policies import POLICIES
from bavs_jax.selection.policy import MODES
from bavs_jax.uncertainty.channel import EXTENTS, SCALES, VARIANTS
from bavs_jax.uncertainty.conformal_scale import SCALES as INTERVAL_SCALES
from bavs_jax.uncertainty.curvature import WEIGHTINGS
from bavs_jax.uncertainty.models import MODELS
from experiments.build_field import SAMPLERS
from experiments.errors import ConfigError, one_line, shown

MAX_SEED = 2**32 - 1  # a larger one is the key of another seed, or none
MAX_WIDTH = 8192  # pixels of an image
MAX_COUNT = 10**9
MAX_VALUE = 1e9  # of a number without a natural bound; above it float32 loses what is added
MAX_LOG2_CELLS = 9
GRID_MEMORY = "a grid of 2^9 cells per side takes 1.6 GB for each view's curvature, 2^10 13 GB"


class Option(NamedTuple):
    """What one option may be."""

    wanted: str  # in words, to follow "give"
    fits: Callable  # value -> bool


def whole(low: int, high: int, zero: str = "", *, note: str = "") -> Option:
    """A whole number, and 0 where it has a meaning of its own; the `note` says what limits it."""
    words = f"a whole number from {low:,} to {high:,}" + (f", or 0: {zero}" if zero else "")
    words += f" ({note})" if note else ""
    return Option(words, lambda x: type(x) is int and (low <= x <= high or (x == 0 and bool(zero))))


def number(low: float, high: float, zero: str = "", *, open_low=False, open_high=False) -> Option:
    """A finite number; `open_*` leaves its end out."""
    words = f"a number {'above' if open_low else 'from'} {low:g}"
    words += f" {'below' if open_high else 'to'} {high:g}" + (f", or 0: {zero}" if zero else "")

    def fits(value):
        if type(value) not in (int, float):
            return False
        above = value > low if open_low else value >= low
        below = value < high if open_high else value <= high
        return (above and below) or (value == 0.0 and bool(zero))

    return Option(words, fits)


def positive(high: float, zero: str = "") -> Option:
    """A number above 0."""
    return number(0.0, high, zero, open_low=True)


def choice(*known: str) -> Option:
    """One of some words."""
    words = f"one of {', '.join(map(repr, known))}"
    return Option(words, lambda value: type(value) is str and value in known)


def several(item: Option, least: int, most: int, *, distinct: bool = True) -> Option:
    """A tuple of things."""
    once = ", each once" if distinct else ""

    def fits(values):
        if type(values) is not tuple or not least <= len(values) <= most:
            return False
        return all(map(item.fits, values)) and (not distinct or len({*values}) == len(values))

    return Option(f"a tuple of {least:,} to {most:,}{once}: {item.wanted}", fits)


def views(zero: str = "") -> Option:
    """A count of views."""
    return whole(1, 100_000, zero)


def _is_seed_text(value) -> bool:
    digits = type(value) is str and re.fullmatch("[0-9]{1,10}", value)
    return bool(digits) and int(value) <= MAX_SEED


def _is_pool_size(value) -> bool:
    fits = type(value) in (int, float) and 0 <= value <= 100_000
    return fits and (value < 1 or value == int(value))


FLAG = Option("True or False", lambda value: type(value) is bool)
TEXT = Option(
    "up to 1,000 characters that can be printed",
    lambda value: type(value) is str and len(value) <= 1000 and value.isprintable(),
)
RAYS_PER_PIXEL = Option("1, 4 or 9", lambda value: type(value) is int and value in (1, 4, 9))
SEED = whole(0, MAX_SEED)
SEED_TEXT = Option(
    f"a whole number from 0 to {MAX_SEED:,} as text, or '': each seed its own",
    lambda value: value == "" or _is_seed_text(value),
)
POOL_SIZE = Option(
    "a share above 0 and below 1, a whole count up to 100000, or 0: as the loader sees fit",
    _is_pool_size,
)
WEIGHT = number(0.0, 1e6)
LAYERS, WIDTH, SAMPLES, RESOLUTION = whole(1, 64), whole(1, 4096), whole(1, 4096), whole(1, 65536)
LEVELS, DEGREE, SKIP, DRAWS = whole(1, 32), whole(1, 24), whole(0, 64), whole(2, 1024)
TABLE = whole(1, 24)  # 16 million rows
AUSE_VARIANTS = [
    variant_name(of=of, error=error, pooled=pooled)
    for of, error, pooled in itertools.product(("colour", "depth"), ERRORS, (False, True))
]

SCHEMA = {
    "loader": choice(*LOADERS, "auto"),
    "data_dir": TEXT,
    "scene": TEXT,
    "image_size": whole(1, MAX_WIDTH, "as the files are"),
    "load.strict": FLAG,
    "load.downscale": whole(1, 1024, "as the loader sees fit"),
    "load.pool_size": POOL_SIZE,
    "load.test_every": whole(2, 100_000, "as the loader sees fit"),
    "load.seed": SEED,
    "load.split": choice("", *SPLITS),
    "policies": several(choice(*POLICIES), 1, len(POLICIES)),
    "seeds": several(SEED, 1, 10_000),
    "num_initial": views("all of the pool"),
    "view_seed": SEED_TEXT,
    "batch_size": views(),
    "num_rounds": whole(0, 10_000),
    "from_scratch": FLAG,
    "num_test": views("all"),
    "num_test_final": views("all"),
    "num_pictures": views("all"),
    "lpips_net": choice("", *NETS),
    "checkpoint_seconds": number(0.0, MAX_VALUE),
    "field_kind": choice(*SAMPLERS),
    "sampler_kind": choice("", *sorted({*itertools.chain(*SAMPLERS.values())})),
    "rays_per_pixel": RAYS_PER_PIXEL,
    "hash_grid.num_levels": LEVELS,
    "hash_grid.coarsest": RESOLUTION,
    "hash_grid.finest": RESOLUTION,
    "hash_grid.features": whole(1, 64),
    "hash_grid.log2_table_size": TABLE,
    "hash_grid.width": WIDTH,
    "hash_grid.geometry_features": WIDTH,
    "hash_grid.initial_optical_depth": number(1e-6, 1e3),
    "hash_grid.direction_degree": whole(1, 4),
    "hash_grid.appearance_features": whole(1, 1024, "none"),
    "nerf_mlp.depth": LAYERS,
    "nerf_mlp.width": WIDTH,
    "nerf_mlp.skip": SKIP,
    "nerf_mlp.position_degree": DEGREE,
    "nerf_mlp.direction_degree": DEGREE,
    "mip_mlp.depth": LAYERS,
    "mip_mlp.width": WIDTH,
    "mip_mlp.skip": SKIP,
    "mip_mlp.position_degree": DEGREE,
    "mip_mlp.direction_degree": DEGREE,
    "mip_mlp.proposal_depth": LAYERS,
    "mip_mlp.proposal_width": WIDTH,
    "flow.condition_features": WIDTH,
    "flow.num_flows": LAYERS,
    "flow_training.num_draws": DRAWS,
    "flow_training.entropy_weight": WEIGHT,
    "flow_training.floor": positive(1e3),
    "coarse_to_fine.num_coarse": SAMPLES,
    "coarse_to_fine.num_fine": SAMPLES,
    "march.num_steps": whole(1, 65536),
    "march.num_slots": SAMPLES,
    "march.occupancy_resolution": whole(1, 512),
    "proposal.num_proposals": several(SAMPLES, 1, 8, distinct=False),
    "proposal.num_samples": SAMPLES,
    "proposal.far": positive(MAX_VALUE),
    "proposal.num_levels": LEVELS,
    "proposal.coarsest": RESOLUTION,
    "proposal.finest": several(RESOLUTION, 1, 8, distinct=False),
    "proposal.log2_table_size": TABLE,
    "proposal.width": WIDTH,
    "proposal.anneal_steps": whole(0, MAX_COUNT),
    "proposal.interlevel_weight": WEIGHT,
    "proposal.distortion_weight": WEIGHT,
    "proposal.penalty_weight": WEIGHT,
    "train.num_steps": whole(1, 10_000_000),
    "train.num_rays": whole(1, 1 << 20),
    "train.capacity": whole(1, 1 << 24),
    "train.one_ray_share": number(0.0, 1.0),
    "train.look_ahead": whole(0, 64),
    "train.learning_rate": positive(1.0, "what suits the field kind"),
    "train.final_share": positive(1.0),
    "train.warmup_steps": whole(0, 10_000_000),
    "train.max_grad_norm": positive(MAX_VALUE, "never cut"),
    "train.adam_b2": number(0.0, 1.0, open_high=True),
    "train.adam_eps": positive(1.0),
    "train.penalty_weight": WEIGHT,
    "train.roughness_weight": number(0.0, MAX_VALUE),
    "train.average_age": positive(0.5, "the last parameters"),
    "train.random_background": FLAG,
    "train.steps_per_call": whole(1, 100_000),
    "uncertainty.log2_cells": whole(1, MAX_LOG2_CELLS, note=GRID_MEMORY),
    "uncertainty.prior_weight": positive(1e6, "1e-4 / (2^L)^3"),
    "uncertainty.weighting": choice(*WEIGHTINGS),
    "uncertainty.variant": choice(*VARIANTS),
    "uncertainty.scale": choice(*SCALES),
    "uncertainty.extent": choice(*EXTENTS),
    "uncertainty.offset_cells": positive(1e3),
    "uncertainty.flow_draws": DRAWS,
    "uncertainty.ensemble_size": whole(2, 64),
    "uncertainty.max_rays": whole(1, MAX_COUNT, "all"),
    "evaluation.models": several(choice(*MODELS), 1, len(MODELS)),
    "evaluation.num_views": views("all"),
    "evaluation.scale_depth": FLAG,
    "evaluation.variant": choice(*AUSE_VARIANTS),
    "evaluation.num_interval_views": views("all"),
    "evaluation.num_interval_pixels": whole(1, MAX_COUNT, "all"),
    "evaluation.interval_scale": choice(*INTERVAL_SCALES),
    "candidates.source": choice("dataset", "hemisphere"),
    "candidates.hemisphere_draws": views(),
    "candidates.image_scale": positive(1.0),
    "candidates.mode": choice("", *MODES),
    "candidates.min_train_distance": number(0.0, MAX_VALUE),
    "candidates.min_candidate_distance": number(0.0, MAX_VALUE),
}


def given_config(example: str = "") -> ConfigDict | None:
    """The config that the flags give, checked; None if they give none and no `example` is due.

    Raises:
      ConfigError: it is missing, cannot be read, or holds an option that cannot be used.
    """
    config = flags.FLAGS.config
    if config is None:
        if example:
            raise ConfigError(f"--config: is missing; try --config={example}")
        return None
    try:
        return check_config(config)
    except OSError as error:  # the config file is only read when it is first used
        raise ConfigError(f"--config: {one_line(error)}") from None


# What options were called, and what is read in place of it.
OLD_VALUES = {
    "uncertainty.weighting": {
        "eq13": "gauss_newton",
        "eq11": "residual_weighted",
        "empirical": "empirical_fisher",
    }
}


def check_config(config: ConfigDict, *more: str, name: str = "config") -> ConfigDict:
    """The config itself, once every option is of its type, within its range and fits the others.

    Old names of values are replaced.

    Args:
      config: from `experiments.configs`, with what flags have changed.
      more: counts of views that a script adds to the options of base.py, 0 allowed.
      name: what errors call it.

    Raises:
      ConfigError: the first option that cannot be used.
    """
    _use_new_names(config)
    values = check_options(config, SCHEMA | {option: views("none") for option in more}, name)
    _check_together(values, name)
    return config


def _use_new_names(config: ConfigDict) -> None:
    for option, names in OLD_VALUES.items():
        group, _, name = option.rpartition(".")
        part = config.get(group) if isinstance(config, ConfigDict) else None
        value = part.get(name) if isinstance(part, ConfigDict) else None
        if isinstance(value, str) and value in names:
            part[name] = names[value]


def check_options(config: ConfigDict, schema: dict[str, Option], name: str) -> dict:
    """The options of a config by their dotted names, each checked by itself.

    Raises:
      ConfigError: one that cannot be used, is missing or is not in the schema.
    """
    if not isinstance(getattr(config, "items", None), Callable):
        raise ConfigError(f"--{name}: get_config() returns {shown(config)}; return a ConfigDict")
    values = leaves(config)
    for option in values:
        if option not in schema:
            raise ConfigError(f"{name}.{option}: is no option; known are {', '.join(schema)}")
    for option, (wanted, fits) in schema.items():
        if option not in values:
            raise ConfigError(f"{name}.{option}: is missing; give {wanted}")
        if not fits(values[option]):
            raise ConfigError(f"{name}.{option}: is {shown(values[option])}; give {wanted}")
    return values


def _check_together(values: dict, name: str) -> None:
    for group in ("hash_grid", "proposal"):
        coarsest, finest = values[f"{group}.coarsest"], values[f"{group}.finest"]
        if min(finest if isinstance(finest, tuple) else (finest,)) < coarsest:
            raise ConfigError(
                f"{name}.{group}.finest: is {finest}; give at least {group}.coarsest, {coarsest}"
            )
    given = [values[f"candidates.min_{what}_distance"] for what in ("train", "candidate")]
    if 0.0 in given and any(given):
        raise ConfigError(
            f"{name}.candidates: give both min_train_distance and min_candidate_distance, "
            "or neither"
        )


def leaves(config, prefix: str = "") -> dict:
    """Every option by its dotted name; a group that is no group counts as an option."""
    found = {}
    for key, value in config.items():
        if isinstance(value, ConfigDict):
            found |= leaves(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
