"""Rendered views in one file."""

from __future__ import annotations

import pathlib

import numpy as np

from experiments.files import read_arrays, write_arrays


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
