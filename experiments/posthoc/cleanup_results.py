"""What a clean-up reports, as a file and in a line."""

from __future__ import annotations

import numpy as np

from bavs_jax.metrics.covered import Sweep
from bavs_jax.uncertainty.cleanup import threshold_sigma
from experiments.machine import device_name
from experiments.posthoc.trained_run import TrainedRun

SCHEMA_VERSION = 1


def summary(run: TrainedRun, sweeps: dict[str, Sweep], row: int, options: dict, made: dict) -> dict:
    """What `cleanup.json` holds; a measure that no pixel has is null, and so is `+inf`.

    Args:
      run: the run that was cleaned.
      sweeps: "training" and "test".
      row: of the chosen threshold.
      options: of the choice and the measures.
      made: command and seconds.
    """
    thresholds = sweeps["test"].thresholds
    laplace = run.toolbox.laplace
    return {
        "schema_version": SCHEMA_VERSION,
        "scene": run.problem.scene.name,
        "policy": run.policy,
        "seed": run.seed,
        **made,
        "device": device_name(),
        "num_training_views": len(run.training_views),
        "options": {**options, "variant": laplace.variant, "extent": laplace.extent},
        "chosen": {
            "threshold": _number(thresholds[row]),
            "sigma": _number(threshold_sigma(thresholds[row])),  # scene units
        },
        "before": {name: _measures(sweep, -1) for name, sweep in sweeps.items()},
        "after": {name: _measures(sweep, row) for name, sweep in sweeps.items()},
        "sweep": {
            name: {key: [_number(x) for x in value] for key, value in sweep._asdict().items()}
            for name, sweep in sweeps.items()
        },
    }


def in_words(sweep: Sweep, row: int) -> str:
    """What the clean-up is worth on test views, in one line."""
    if row == len(sweep.thresholds) - 1:
        return "nothing was removed: every threshold costs more of the training views than allowed"
    after, before = _measures(sweep, row), _measures(sweep, -1)
    parts = [
        f"{name} {before[key]:.2f} -> {after[key]:.2f} dB"
        for name, key in (("PSNR over covered pixels", "psnr_covered"), ("over all", "psnr"))
        if before[key] is not None and after[key] is not None
    ]
    shares = (("covered", "share_covered"), ("empty pixels covered", "share_floating"))
    parts += [
        f"{name} {before[key]:.1%} -> {after[key]:.1%}"
        for name, key in shares
        if before[key] is not None
    ]
    return f"threshold {sweep.thresholds[row]:.3f}: {', '.join(parts)}"


def _measures(sweep: Sweep, row: int) -> dict[str, float | None]:
    names = [name for name in Sweep._fields if name != "thresholds"]
    return {name: _number(getattr(sweep, name)[row]) for name in names}


def _number(value) -> float | None:
    return float(value) if np.isfinite(value) else None
