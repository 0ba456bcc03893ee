"""What every option of experiments/configs/base.py may be, checked before any work is done."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from absl import flags
from ml_collections import ConfigDict

from bavs_jax.metrics.ause import ERRORS, variant_name
from bavs_jax.metrics.perceptual import NETS
from bavs_jax.pools import KINDS as POOLS
from bavs_jax.scenes import LOADERS
from bavs_jax.scenes.lightfield import SPLITS
from bavs_jax.scenes.procedural import SUBJECTS
from bavs_jax.selection.policies import POLICIES
from bavs_jax.selection.policy import MODES
from bavs_jax.uncertainty.channel import EXTENTS, SCALES, VARIANTS
from bavs_jax.uncertainty.conformal_scale import SCALES as INTERVAL_SCALES
from bavs_jax.uncertainty.curvature import WEIGHTINGS
from bavs_jax.uncertainty.models import MODELS
from experiments.build import TARGET_KINDS
from experiments.build_model import SAMPLERS
from experiments.files import leaves, modern_value
from experiments.runtime import ConfigError, one_line, shown

MAX_SEED = 2**32 - 1  # a larger one is the key of another seed, or none
MAX_LENGTH = 1e9  # of places, user units
MAX_WIDTH = 8192  # pixels of an image
MAX_COUNT = 10**9
MAX_VALUE = 1e9  # of a number without a natural bound; above it float32 loses what is added
MAX_LOG2_CELLS = 9
GRID_MEMORY = "a grid of 2^9 cells per side takes 1.6 GB for each view's curvature, 2^10 13 GB"

# --- kinds of options ------------------------------------------------------------------------


class Option(NamedTuple):
    """What one option may be."""

    wanted: str  # in words, to follow "give"
    fits: Callable  # value -> bool


def number(low, high, zero: str = "", *, types=(int, float), above=False, note="") -> Option:
    """A finite number, and 0 where that has a meaning of its own.

    `above` leaves the low end out; the `note` says what limits the number.
    """
    form = "," if types == (int,) else "g"
    words = "a whole number" if types == (int,) else "a number"
    words += f" {'above' if above else 'from'} {low:{form}} to {high:{form}}"
    words += (f", or 0: {zero}" if zero else "") + (f" ({note})" if note else "")

    def fits(value):
        if type(value) not in types:
            return False
        inside = low < value <= high if above else low <= value <= high
        return inside or (value == 0 and bool(zero))

    return Option(words, fits)


whole = partial(number, types=(int,))
positive = partial(number, 0.0, above=True)
views = partial(whole, 1, 100_000)


def choice(*known: str) -> Option:
    """One of some words."""
    words = f"one of {', '.join(map(repr, known))}"
    return Option(words, lambda value: type(value) is str and value in known)


def several(item: Option, least: int, most: int, *, distinct: bool = True) -> Option:
    """A tuple of things."""

    def fits(values):
        if type(values) is not tuple or not least <= len(values) <= most:
            return False
        return all(map(item.fits, values)) and (not distinct or len({*values}) == len(values))

    once = ", each once" if distinct else ""
    return Option(f"a tuple of {least:,} to {most:,}{once}: {item.wanted}", fits)


def default(option: Option, meaning: str) -> Option:
    """The option or None, which stands for what is best by default."""
    wanted = f"{option.wanted}, or None: {meaning}"
    return Option(wanted, lambda value: value is None or option.fits(value))


def _is_pool_size(value) -> bool:
    fits = type(value) in (int, float) and 0 < value <= 100_000
    return fits and (value < 1 or value == int(value))


FLAG = Option("True or False", lambda value: type(value) is bool)
TEXT = Option(
    "up to 1,000 characters that can be printed",
    lambda value: type(value) is str and len(value) <= 1000 and value.isprintable(),
)
SEED = whole(0, MAX_SEED)
COUNT = whole(1, MAX_COUNT, "all")
AS_LOADED = "as the loader sees fit"
SHARE = Option("a number from 1/3 to below 1", lambda x: type(x) is float and 1 / 3 <= x < 1)
BELOW_1 = Option("a number from 0 to below 1", lambda x: type(x) in (int, float) and 0 <= x < 1)
AUSE_VARIANTS = [
    variant_name(of=of, error=error, pooled=pooled)
    for of, error, pooled in itertools.product(("colour", "depth"), ERRORS, (False, True))
]

# --- the options -----------------------------------------------------------------------------

_OPTIONS_OF_A_KIND = {
    "load.strict from_scratch train.random_background evaluation.scale_depth": FLAG,
    "scene": TEXT,
    "data_dir": default(TEXT, "$BAVS_DATA/<loader>"),
    "targets.poses_file": default(TEXT, "no file"),
    # words
    "loader": choice(*LOADERS, "auto"),
    "load.split": default(choice(*SPLITS), AS_LOADED),
    "lpips_net": choice("", *NETS),
    "field_kind": choice(*SAMPLERS),
    "sampler_kind": default(
        choice(*sorted({*itertools.chain(*SAMPLERS.values())})), "what suits field and scene"
    ),
    "uncertainty.weighting": choice(*WEIGHTINGS),
    "uncertainty.variant": choice(*VARIANTS),
    "uncertainty.scale": choice(*SCALES),
    "uncertainty.extent": choice(*EXTENTS),
    "targets.kind": choice(*TARGET_KINDS),
    "evaluation.variant": choice(*AUSE_VARIANTS),
    "evaluation.interval_scale": choice(*INTERVAL_SCALES),
    "candidates.source": choice("dataset", "hemisphere", "free"),
    "pool.kind": choice(*POOLS),
    "candidates.mode": default(choice(*MODES), "the policy's own"),
    "view_seed": default(SEED, "each seed its own"),
    # tuples
    "policies": several(choice(*POLICIES), 1, len(POLICIES)),
    "seeds": several(SEED, 1, 10_000),
    "evaluation.models": several(choice(*MODELS), 1, len(MODELS)),
    "proposal.num_proposals": several(whole(1, 4096), 1, 8, distinct=False),
    "proposal.finest": several(whole(1, 65536), 1, 8, distinct=False),
    # counts of views, pixels and steps
    "load.pool_size": default(
        Option("a share above 0 and below 1, a whole count up to 100000", _is_pool_size), AS_LOADED
    ),
    "load.test_every": default(whole(2, 100_000), AS_LOADED),
    "load.downscale": default(whole(1, 1024), AS_LOADED),
    "load.seed pool.seed": SEED,
    "pool.share": SHARE,
    "pool.degrees": positive(360.0),
    "pool.num_nearest": views(),
    "pool.factor": number(1.0, 100.0, above=True),
    "image_size": whole(1, MAX_WIDTH, "as the files are"),
    "num_initial": views("all of the pool"),
    "batch_size candidates.hemisphere_draws": views(),
    "targets.num": default(views(), "as the policy sees fit"),
    "num_rounds": whole(0, 10_000),
    "num_test num_test_final num_pictures": views("all"),
    "evaluation.num_views evaluation.num_interval_views": views("all"),
    "evaluation.num_interval_pixels uncertainty.max_rays": COUNT,
    "rays_per_pixel": Option("1, 4 or 9", lambda x: type(x) is int and x in (1, 4, 9)),
    "train.num_rays": whole(1, 1 << 20),
    "train.capacity": whole(1, 1 << 24),
    "train.num_steps": whole(1, 10_000_000),
    "train.warmup_steps": whole(0, 10_000_000),
    "train.steps_per_call": whole(1, 100_000),
    "train.look_ahead nerf_mlp.skip mip_mlp.skip": whole(0, 64),
    "proposal.anneal_steps": whole(0, MAX_COUNT),
    # sizes of fields and samplers
    "hash_grid.num_levels proposal.num_levels": whole(1, 32),
    "hash_grid.coarsest hash_grid.finest proposal.coarsest march.num_steps": whole(1, 65536),
    "hash_grid.log2_table_size proposal.log2_table_size": whole(1, 24),  # 16 million rows
    """hash_grid.features hash_grid.geometry_features hash_grid.width nerf_mlp.width mip_mlp.width
    mip_mlp.proposal_width proposal.width flow.condition_features march.num_slots
    coarse_to_fine.num_coarse coarse_to_fine.num_fine proposal.num_samples""": whole(1, 4096),
    "hash_grid.direction_degree": whole(1, 4),
    "hash_grid.appearance_features": whole(1, 1024, "none"),
    "nerf_mlp.depth mip_mlp.depth mip_mlp.proposal_depth flow.num_flows": whole(1, 64),
    """nerf_mlp.position_degree nerf_mlp.direction_degree mip_mlp.position_degree
    mip_mlp.direction_degree""": whole(1, 24),
    "flow_training.num_draws uncertainty.flow_draws": whole(2, 1024),
    "march.occupancy_resolution": whole(1, 512),
    "uncertainty.log2_cells": whole(1, MAX_LOG2_CELLS, note=GRID_MEMORY),
    "uncertainty.ensemble_size": whole(2, 64),
    # numbers
    "checkpoint_seconds train.roughness_weight": number(0.0, MAX_VALUE),
    "candidates.min_train_distance candidates.min_candidate_distance": default(
        positive(MAX_VALUE), "those that leave candidates.survivors"
    ),
    "candidates.image_scale candidates.survivors train.final_share train.adam_eps": positive(1.0),
    "hash_grid.initial_optical_depth": number(1e-6, 1e3),
    """flow_training.entropy_weight train.penalty_weight proposal.interlevel_weight
    proposal.distortion_weight proposal.penalty_weight""": number(0.0, 1e6),
    "flow_training.floor uncertainty.offset_cells": positive(1e3),
    "proposal.far": positive(MAX_VALUE),
    "train.one_ray_share": number(0.0, 1.0),
    "train.learning_rate": default(positive(1.0), "what suits the field kind"),
    "train.max_grad_norm": positive(MAX_VALUE, "never cut"),
    "train.adam_b2": BELOW_1,
    "train.average_age": positive(0.5, "the last parameters"),
    "uncertainty.prior_weight": default(positive(1e6), "1e-4 / (2^L)^3"),
}
SCHEMA: dict[str, Option] = {
    name: option for names, option in _OPTIONS_OF_A_KIND.items() for name in names.split()
}

# --- checks ----------------------------------------------------------------------------------


def given_config(example: str = "") -> ConfigDict | None:
    """The config that the flags give, checked; None if they give none and no `example` is due."""
    config = flags.FLAGS.config
    if config is None and example:
        raise ConfigError(f"--config: is missing; try --config={example}")
    try:
        return None if config is None else check_config(config)
    except OSError as error:  # the config file is only read when it is first used
        raise ConfigError(f"--config: {one_line(error)}") from None


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
    schema = SCHEMA | {option: views("none") for option in more}
    values = check_options(config, schema, name)
    for group in ("hash_grid", "proposal"):
        coarsest, finest = values[f"{group}.coarsest"], values[f"{group}.finest"]
        if min(finest if isinstance(finest, tuple) else (finest,)) < coarsest:
            raise ConfigError(
                f"{name}.{group}.finest: is {finest}; give at least {group}.coarsest, {coarsest}"
            )
    given = [values[f"candidates.min_{what}_distance"] for what in ("train", "candidate")]
    if given.count(None) == 1:
        raise ConfigError(
            f"{name}.candidates: give both min_train_distance and min_candidate_distance, "
            "or neither"
        )
    _check_scene(values, name)
    _check_pool(values, name)
    if (values["targets.kind"] == "file") != bool(values["targets.poses_file"]):
        raise ConfigError(
            f"{name}.targets.poses_file: goes with {name}.targets.kind='file'; give both or neither"
        )
    return config


def _check_pool(values: dict, name: str) -> None:
    """Raises ConfigError where the kind of pool does not go with the other options."""
    kind, batch = values["pool.kind"], values["batch_size"]
    if kind == "reachable" and values["num_rounds"] and batch != 1:
        raise ConfigError(
            f"{name}.batch_size: is {batch}, but in a pool of kind 'reachable' each view is "
            "reached from the one before: give 1, and more num_rounds, as configs/reachable.py does"
        )
    source = values["candidates.source"]
    is_free = values["loader"] == "procedural" and source != "dataset"
    if is_free and kind in ("unbalanced", "zoom"):
        raise ConfigError(
            f"{name}.candidates.source: is {source!r}, whose free poses are of no pool, but "
            f"pool.kind is {kind!r}: give candidates.source 'dataset', or pool.kind 'even'"
        )


def _check_scene(values: dict, name: str) -> None:
    """Raises ConfigError for a procedural scene that there is not, and where cameras cannot go."""
    loader, scene, source = (values[o] for o in ("loader", "scene", "candidates.source"))
    if loader != "procedural":
        if source == "free":
            raise ConfigError(
                f"{name}.candidates.source: is 'free', which takes pictures on the way, and "
                f"{name}.loader is {shown(loader)}; give 'dataset', 'hemisphere', or the loader "
                "'procedural'"
            )
    elif scene not in SUBJECTS:
        known = ", ".join(map(repr, SUBJECTS))
        raise ConfigError(f"{name}.scene: is {shown(scene)}; the loader has {known}: give one")
    elif source == "hemisphere" and SUBJECTS[scene].closed:
        raise ConfigError(
            f"{name}.candidates.source: is 'hemisphere', which lies beyond the walls of {scene!r}; "
            "give 'dataset' or 'free'"
        )


def check_options(config: ConfigDict, schema: dict[str, Option], name: str) -> dict:
    """The options of a config by their dotted names, each checked by itself.

    `name` is what errors call the config. What earlier versions called a value is replaced by what
    this one does. Raises ConfigError for an option that cannot be used, is missing or is not in the
    schema.
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
        value = modern_value(option, values[option])
        if value is not values[option]:
            values[option] = value
            config.update_from_flattened_dict({option: value})
        if not fits(value):
            raise ConfigError(f"{name}.{option}: is {shown(value)}; give {wanted}")
    return values


def parse_numbers(text: str, shape: tuple[int, ...], flag: str) -> np.ndarray | None:
    """Numbers with commas between them; None for an empty text.

    Raises:
      ConfigError: another count of numbers, or one that cannot be used.
    """
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
        if not (abs(values) <= MAX_LENGTH).all():
            raise ValueError("too large, or not a number")
        return values.reshape(shape)
    except ValueError as error:
        wanted = f"give {np.prod(shape)} numbers of at most 1e9 with commas"
        raise ConfigError(f"--{flag}: {shown(text)} cannot be used ({error}): {wanted}") from None
