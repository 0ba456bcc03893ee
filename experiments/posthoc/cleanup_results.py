"""What a clean-up reports, as a file and in a line."""

from __future__ import annotations

import numpy as np

from bavs_jax.fields.deformation import offset_unit
from bavs_jax.metrics.covered import Sweep
from bavs_jax.uncertainty.cleanup import threshold_sigma
from experiments.trained import TrainedRun


def summary(run: TrainedRun, sweeps: dict[str, Sweep], row: int, options: dict) -> dict:
    """What one run reports; a measure that no pixel has is null, and so is `+inf`.

    Args:
      run: the run that was cleaned.
      sweeps: "training" and "test".
      row: of the chosen threshold.
      options: of the choice and the measures.
    """
    thresholds = sweeps["test"].thresholds
    laplace, unit = run.toolbox.laplace, float(offset_unit(run.problem.scene.box))
    return {
        "options": {**options, "variant": laplace.variant, "extent": laplace.extent},
        "chosen": {
            "threshold": _number(thresholds[row]),
            "sigma": _number(threshold_sigma(thresholds[row], unit)),  # scene units
        },
        "before": {name: _measures(sweep, -1) for name, sweep in sweeps.items()},
        "after": {name: _measures(sweep, row) for name, sweep in sweeps.items()},
        "sweep": {
            name: {key: [_number(x) for x in value] for key, value in sweep._asdict().items()}
            for name, sweep in sweeps.items()
        },
    }


def in_words(row: dict) -> str:
    """What the clean-up of a run is worth on test views, in one line."""
    if row["chosen"]["threshold"] is None:
        return "nothing was removed: every threshold costs more of the training views than allowed"
    before, after = row["before"]["test"], row["after"]["test"]
    parts = []
    if after["psnr_covered"] is not None:
        parts.append(
            f"PSNR over still-covered pixels {after['psnr_covered_before']:.2f} -> "
            f"{after['psnr_covered']:.2f} dB"
        )
    parts.append(f"over all {before['psnr']:.2f} -> {after['psnr']:.2f} dB")
    shares = (("covered", "share_covered"), ("empty pixels covered", "share_floating"))
    parts += [
        f"{name} {before[key]:.1%} -> {after[key]:.1%}"
        for name, key in shares
        if before[key] is not None
    ]
    return f"threshold {row['chosen']['threshold']:.3f}: {', '.join(parts)}"


def _measures(sweep: Sweep, row: int) -> dict[str, float | None]:
    names = [name for name in Sweep._fields if name != "thresholds"]
    return {name: _number(getattr(sweep, name)[row]) for name in names}


def _number(value) -> float | None:
    return float(value) if np.isfinite(value) else None
