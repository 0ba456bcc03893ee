"""Files beside a result: calibrations that can be put around new renders, and images."""

from __future__ import annotations

import pathlib

import numpy as np

from bavs_jax.uncertainty.bands import RenderCalibration, calibration_from_json, calibration_to_json
from experiments.errors import WorkdirError
from experiments.files import read_arrays, read_versioned, write_arrays, write_json

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


def save_images(path: pathlib.Path, images: list[dict[str, np.ndarray]], seconds: float) -> None:
    """Writes the images of each view, whatever their sizes, and how long they took."""
    arrays = {f"{i}/{name}": x for i, image in enumerate(images) for name, x in image.items()}
    write_arrays(path, **arrays, seconds=np.float64(seconds))


def load_images(path: pathlib.Path) -> tuple[list[dict[str, np.ndarray]], float] | None:
    """The inverse of `save_images`; None where there is no file or a damaged one."""
    arrays = read_arrays(path, "seconds")
    if arrays is None:
        return None
    seconds = float(arrays.pop("seconds"))
    images = [{} for _ in {key.split("/")[0] for key in arrays}]
    for key, values in arrays.items():
        number, name = key.split("/")
        images[int(number)][name] = values
    return images, seconds
