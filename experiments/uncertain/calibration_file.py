"""Calibrated intervals in a file, for other scripts and new views of the same field."""

from __future__ import annotations

import pathlib

from bavs_jax.uncertainty.bands import (
    RenderCalibration,
    calibration_from_json,
    calibration_to_json,
)
from experiments.errors import WorkdirError
from experiments.files import write_json
from experiments.versioned import read_versioned

SCHEMA_VERSION = 1


def calibration_path(folder: pathlib.Path, model: str, seed: int) -> pathlib.Path:
    """Where the intervals of one model and seed are kept."""
    return folder / "uncertainty" / model / f"seed_{seed}_calibration.json"


def save_calibration(path: pathlib.Path, calibration: RenderCalibration, about: dict) -> None:
    """Writes intervals, with what they are of.

    Args:
      path: where to.
      calibration: the intervals.
      about: anything that JSON can hold, such as scene, model, seed and views.
    """
    values = {"schema_version": SCHEMA_VERSION, **about}
    write_json(path, values | {"calibration": calibration_to_json(calibration)})


def load_calibration(path: pathlib.Path) -> RenderCalibration:
    """What `save_calibration` wrote; put it around renders with `bands.add_bands`.

    Raises:
      WorkdirError: the file is missing or broken, or of another version.
    """
    values = read_versioned(
        path,
        SCHEMA_VERSION,
        error=WorkdirError,
        absent="run experiments.evaluate_uncertainty",
        fix="make it anew",
    )
    try:
        return calibration_from_json(values.get("calibration") or {})
    except ValueError as error:
        raise WorkdirError(f"{path}: {error}") from None
