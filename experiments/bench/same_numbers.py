"""The same state on two devices: what each makes of it, and how far apart that is."""

import dataclasses

import jax
import numpy as np
import optax

from bavs_jax import active
from bavs_jax.scenes import Scene
from bavs_jax.uncertainty.model import FLOW, RECONSTRUCTION, VARIANCE
from experiments import runtime
from experiments.bench.stages import SEED, Subject
from experiments.build import load_config_scene, run_key, stream_key
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
    **{"image_size": 16, "lpips_net": "", "num_initial": 6, "batch_size": 4},
    **{"train.num_rays": 128, "train.capacity": 4096, "train.num_steps": 96},
    **{"hash_grid.num_levels": 4, "uncertainty.log2_cells": 4, "flow_training.num_draws": 4},
    **{"march.num_steps": 48, "march.num_slots": 16, "march.occupancy_resolution": 16},
    **{"nerf_mlp.depth": 2, "nerf_mlp.skip": 1, "mip_mlp.depth": 2, "mip_mlp.skip": 1},
    "train.steps_per_call": 1,
}
NUM_RAYS, NUM_CANDIDATES, WIDTH = 1024, 16, 8  # that are rendered and scored
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
        subject = Subject(config, scene, config.num_initial, kind)
        problem, table = subject.problem, subject.problem.table
        if trained is None:
            subject.train()
            trained = jax.tree.map(np.asarray, subject.state)
        subject.state = state = jax.device_put(trained, device)
        subject.jac_sq_sum, subject.num_rays = subject.curvature(NUM_RAYS)(), NUM_RAYS
        images, scores = subject.rendering(NUM_RAYS)(), subject.scoring(NUM_CANDIDATES, WIDTH)()
        found = {"colours": images["rgb"], "depths": images["depth"], "scores": scores}
        found["curvature"] = subject.jac_sq_sum
        key, init_key = run_key(SEED), stream_key(SEED, "init")
        whole = active.init(state, table, subject.initial)
        for name in policies:
            acquisition = problem.acquisition(name, subject.initial, "check")
            choice = active.select(active.round_keys(key, 1)[0], whole, acquisition)
            found[f"views, {name}"] = choice.candidates.view_ids[choice.selected]
        # Adam's first mean is a share of the gradient. Last, since the state is given away.
        state = state.replace(opt_state=problem.trainer.init(init_key).opt_state)
        state, info = problem.trainer.call(key, state, table, subject.is_training)
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
        missing = dash(f"not compared for {name}")
        cells = [Cell(f"{row[what]:.1e}") if what in row else missing for what in names]
        rows.append((Cell(name), *cells))
    return Table(("field", *names), tuple(rows))
