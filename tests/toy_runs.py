"""A configuration of the real script that is small enough for tests."""

import json
import pathlib

import numpy as np

from experiments.configs import quickstart

OVERRIDES = {
    "image_size": 16,
    "num_rounds": 2,
    "num_test": 2,
    "num_test_final": 3,
    "num_pictures": 1,
    "batch_size": 2,
    "num_initial": 2,
    "lpips_net": "",
    "checkpoint_seconds": 0.0,
    "rays_per_pixel": 1,
    "hash_grid.num_levels": 2,
    "hash_grid.finest": 32,
    "hash_grid.width": 16,
    "hash_grid.initial_optical_depth": 2.0,  # learns in a few steps
    "march.num_steps": 48,
    "march.num_slots": 32,
    "march.occupancy_resolution": 16,
    "train.num_steps": 24,
    "train.steps_per_call": 4,
    "train.num_rays": 128,
    "train.capacity": 2048,
    "uncertainty.log2_cells": 3,
    "uncertainty.ensemble_size": 2,
    "flow.num_flows": 2,
    "uncertainty.flow_draws": 3,
    "flow_training.num_draws": 2,
}

# Networks and samplers of other kinds, made tiny; overrides of `toy_config`.
SMALL_NETWORKS = {
    "nerf_mlp__depth": 2,
    "nerf_mlp__width": 16,
    "nerf_mlp__skip": 1,
    "mip_mlp__depth": 2,
    "mip_mlp__width": 16,
    "mip_mlp__proposal_width": 8,
    "coarse_to_fine__num_coarse": 8,
    "coarse_to_fine__num_fine": 8,
    "proposal__num_proposals": (12, 8),
    "proposal__num_samples": 8,
    "proposal__log2_table_size": 10,
    "proposal__num_levels": 1,
}


def toy_config(**overrides):
    """The quickstart config made tiny; overrides are given with `__` for a dot."""
    config = quickstart.get_config()
    config.update_from_flattened_dict(OVERRIDES)
    config.update_from_flattened_dict({k.replace("__", "."): v for k, v in overrides.items()})
    return config


def toy_flags(**overrides) -> list[str]:
    """The same as command-line flags."""
    values = OVERRIDES | {k.replace("__", "."): v for k, v in overrides.items()}
    options = [f"--config.{name}={value}" for name, value in values.items()]
    return ["--config=experiments/configs/quickstart.py", *options]


# Of the least length that has rounds, checkpoints within them and a choice.
TINY = {"num_rounds": 1, "train__num_steps": 8, "num_test": 1, "num_test_final": 1}


def same_results(folder, other):
    """Asserts that two runs came to the same end: files, choices and measures, but for times."""
    kept = ("result.json", "acquisition.npz", "pictures.npz", "transforms.json", "report.html")
    names = [
        sorted(str(p.relative_to(f)) for p in f.rglob("*") if p.name in (*kept, "config.json"))
        for f in (folder, other)
    ]
    assert names[0] == names[1] and len(names[0]) >= 5
    runs, wanted = (json.loads((f / "summary.json").read_text())["runs"] for f in (folder, other))
    assert len(runs) == len(wanted) > 0
    for got, want in zip(runs, wanted):
        path = pathlib.Path(got["policy"], f"seed_{got['seed']}")
        assert got == json.loads((folder / path / "result.json").read_text())
        assert (got["policy"], got["seed"], got["completed"]) == (
            *(want["policy"], want["seed"]),
            True,
        )
        for a, b in zip(got["rounds"], want["rounds"], strict=True):
            assert (a["selected"], a["num_views"]) == (b["selected"], b["num_views"])
            # Threads of the CPU may add up in another order.
            for name in ("psnr", "ssim", "depth_mae"):
                np.testing.assert_allclose(a[name], b[name], atol=1e-3)
        with (
            np.load(folder / path / "acquisition.npz") as a,
            np.load(other / path / "acquisition.npz") as b,
        ):
            for name in ("selected", "initial", "survivors"):
                np.testing.assert_array_equal(a[name], b[name])
            np.testing.assert_allclose(a["scores"], b["scores"], atol=1e-3)
