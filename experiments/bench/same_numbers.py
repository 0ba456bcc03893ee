"""The same state on two devices: what each makes of it, and how far apart that is."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import optax

from bavs_jax import active
from bavs_jax.active import round_keys
from bavs_jax.cameras import take
from bavs_jax.pixel_table import training_pixels, view_mask
from bavs_jax.rendering.images import render_views
from bavs_jax.scenes import Scene
from bavs_jax.uncertainty.channel import mean_uncertainty
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE
from bavs_jax.uncertainty.streaming import table_rays
from experiments import runtime
from experiments.build import Problem, initial_views, load_config_scene, run_key, stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.configs import base
from experiments.reporting.tables import Cell, Table, dash

DEVICE_FILE = "check_device.json"

# Fields of each kind: options of the config, whether the scene has no bounds, and what is trained.
FIELDS = {
    "hash_grid": ({}, False, RECONSTRUCTION),
    "proposals": ({"sampler_kind": "proposal"}, False, RECONSTRUCTION),
    "unbounded": ({"hash_grid.appearance_features": 2}, True, RECONSTRUCTION),
    "nerf_mlp": ({"field_kind": "nerf_mlp"}, False, RECONSTRUCTION),
    "mip_mlp": ({"field_kind": "mip_mlp"}, False, RECONSTRUCTION),
    "learned_variance": ({}, False, VARIANCE),
    "flow": ({}, False, FLOW),
}
SMALL = {
    "image_size": 16,
    "lpips_net": "",
    "train.num_rays": 128,
    "train.capacity": 4096,
    "hash_grid.num_levels": 4,
    "march.num_steps": 48,
    "march.num_slots": 16,
    "march.occupancy_resolution": 16,
    "nerf_mlp.depth": 2,
    "nerf_mlp.skip": 1,
    "mip_mlp.depth": 2,
    "mip_mlp.skip": 1,
    "train.steps_per_call": 1,
    "train.num_steps": 1,
    "num_initial": 6,
    "batch_size": 4,
    "uncertainty.log2_cells": 4,
    "flow_training.num_draws": 4,
}
NUM_STEPS, SEED = 96, 0
POLICIES = ("bavs", "bavs_spread")


def numbers_on(
    device, config, scene: Scene, kind: str, policies: tuple[str, ...], trained=None
) -> tuple[dict, dict]:
    """What a device makes of a state.

    Args:
      device: one of JAX's.
      config, scene, kind: see `Problem`.
      policies: that choose a batch.
      trained: the state in numpy's arrays; None: trained here.

    Returns:
      the state, and by name arrays to compare; those named `views, ...` hold whole numbers.
    """
    with jax.default_device(device):
        problem = Problem(config, scene, kind)
        table, train_call = problem.table, problem.trainer.call
        initial = initial_views(scene, SEED, config.num_initial)
        is_training = view_mask(table, initial)
        init_key, key = stream_key(SEED, "init"), run_key(SEED)
        if trained is None:
            state = problem.trainer.init(init_key)
            for number in range(NUM_STEPS):
                state, _ = train_call(jax.random.fold_in(key, number), state, table, is_training)
            trained = jax.tree.map(np.asarray, state)
        state = jax.device_put(trained, device)

        view_ids, pixel_ids = training_pixels(table, is_training)
        setup = problem.setup
        weighting = setup.laplace.weighting
        jac_sq_sum = setup.curvature(
            state.model,
            label=None,
            weighting=weighting,
            **table_rays(table, view_ids, pixel_ids, weighting),
        )
        image = render_views(
            problem.render(state), scene.cameras, scene.test[:1], chunk=RENDER_CHUNK
        )[0]
        found = {"colours": image["rgb"], "depths": image["depth"], "curvature": jac_sq_sum}
        found["scores"] = mean_uncertainty(
            problem.render(state, jac_sq_sum, len(view_ids)),
            take(scene.cameras, np.setdiff1d(scene.pool, initial)),
            chunk=RENDER_CHUNK,
        )
        whole = active.init(state, table, initial)
        for name in policies:
            acquisition = problem.acquisition(name, initial, "check")
            choice = active.select(round_keys(key, 1)[0], whole, acquisition)
            found[f"views, {name}"] = choice.candidates.view_ids[choice.selected]
        # Adam's first mean is a share of the gradient. Last, since the state is given away.
        state = state.replace(opt_state=problem.trainer.init(init_key).opt_state)
        state, info = train_call(jax.random.fold_in(key, NUM_STEPS), state, table, is_training)
        moments = jax.tree.leaves(optax.tree_utils.tree_get(state.opt_state, "mu"))
        found["loss"] = info.loss
        found["gradient"] = np.concatenate([np.ravel(moment) for moment in moments])
        return trained, {name: np.asarray(value) for name, value in found.items()}


def difference(value: np.ndarray, wanted: np.ndarray) -> float:
    """`|value - wanted| / |wanted|`, Euclidean; for whole numbers the share that differs."""
    if np.issubdtype(wanted.dtype, np.integer):
        return float(np.mean(value != wanted))
    value, wanted = value.astype(np.float64), wanted.astype(np.float64)
    return float(np.linalg.norm(value - wanted) / np.linalg.norm(wanted))


def check_field(name: str, device, reference) -> dict[str, float]:
    """Differences between two devices, by what is compared; `name` is one of `FIELDS`."""
    options, unbounded, kind = FIELDS[name]
    config = base.get_config()
    config.update_from_flattened_dict({**SMALL, **options})
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    scene = dataclasses.replace(scene, unbounded=unbounded)
    policies = () if options or kind != RECONSTRUCTION else POLICIES
    trained, wanted = numbers_on(reference, config, scene, kind, policies)
    _, numbers = numbers_on(device, config, scene, kind, policies, trained)
    return {key: difference(numbers[key], wanted[key]) for key in wanted}


def too_large(differences: dict[str, dict[str, float]], tolerance: float) -> list[str]:
    """`field: what` of all that is above the tolerance; of views, none may differ."""
    return [
        f"{name}: {what}"
        for name, row in differences.items()
        for what, value in row.items()
        if not value <= (0.0 if what.startswith("views") else tolerance)
    ]


def differences_table(differences: dict[str, dict[str, float]]) -> Table:
    """A row for each field, a column for each thing that was compared."""
    names = list(dict.fromkeys(what for row in differences.values() for what in row))
    rows = []
    for name, row in differences.items():
        cells = [
            Cell(f"{row[what]:.1e}") if what in row else dash(f"not compared for {name}")
            for what in names
        ]
        rows.append((Cell(name), *cells))
    return Table(("field", *names), tuple(rows))
