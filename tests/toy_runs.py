"""A configuration of the real script that is small enough for tests."""

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
    "field.num_levels": 2,
    "field.finest": 32,
    "field.width": 16,
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
