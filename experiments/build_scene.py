"""From a config to the scene, the views a run starts with and the candidates."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np

from bavs_jax.candidates import (
    CandidateSource,
    captured_candidates,
    dataset_candidates,
    with_empty_views,
)
from bavs_jax.pixel_table import PixelTable
from bavs_jax.scenes import Scene, SceneError, load_scene, sculpture
from bavs_jax.scenes.procedural import capture
from experiments.errors import ConfigError

MAX_NEW_PIXELS = 1 << 30  # of pictures taken on the way, for which room is made at the start


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
    return load_scene(config.loader, root=root, image_size=config.image_size or None, **options)


def true_surface(config) -> Callable | None:
    """Signed distance to the surface of a config's scene, where it is known: [..., 3] -> [...]."""
    return sculpture.signed_distance if config.loader == "procedural" else None


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


def check_views(config, scene: Scene) -> None:
    """Whether a scene has as many views as a config's rounds ask for, before any is trained.

    Raises:
      SceneError: the pool has fewer than `num_initial`.
      ConfigError: it has fewer than all batches take, or a batch more than its candidates.
    """
    pool, batch, options = len(scene.pool), config.batch_size, config.candidates
    left = pool - len(initial_views(scene, 0, config.num_initial))
    taken = config.num_rounds * batch
    drawn = options.source == "hemisphere"
    if drawn and config.num_rounds and batch > options.hemisphere_draws:
        raise ConfigError(
            f"config.batch_size: is {batch}; give at most candidates.hemisphere_draws, "
            f"{options.hemisphere_draws}"
        )
    if not (drawn and config.loader == "procedural"):
        if taken > left:
            raise ConfigError(
                f"config.batch_size: {config.num_rounds} rounds of {batch} take {taken} views, but "
                f"{scene.name} has {left} in the pool beside the initial ones; give fewer"
            )
    elif taken * int(np.diff(scene.offsets).max()) > MAX_NEW_PIXELS:
        raise ConfigError(
            f"config.batch_size: {config.num_rounds} rounds of {batch} take {taken} pictures, more "
            f"than {MAX_NEW_PIXELS:,} pixels; give fewer, or a smaller image_size"
        )


def make_source(config, scene: Scene, table: PixelTable) -> tuple[CandidateSource, PixelTable]:
    """Where candidates come from, and the table with room for pictures taken on the way."""
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
        lambda cameras: capture(cameras)[:2],
        num_candidates=draws,
        first_slot=first_slot,
    )
    return source, table
