"""Pictures of several sizes in one array, as an `.npz` keeps them."""

from __future__ import annotations

import numpy as np

PICTURES = ("truth", "rgb", "error", "uncertainty", "depth")


def stack_pictures(images: list[np.ndarray]) -> np.ndarray:
    """Images [H_v, W_v, ...] as one array [n, H, W, ...] of the largest size, filled up with 0."""
    height, width = np.max([image.shape[:2] for image in images], axis=0)
    first = images[0]
    stacked = np.zeros((len(images), height, width, *first.shape[2:]), first.dtype)
    for whole, image in zip(stacked, images):
        whole[: image.shape[0], : image.shape[1]] = image
    return stacked


def cut_pictures(arrays: dict) -> dict:
    """The content of a file of pictures, each picture again at its own size.

    Args:
      arrays: `PICTURES` as from `stack_pictures`, and `sizes` [n, 2] (width, height), without
        which all are of one size.

    Returns:
      The same, with a list of [H_v, W_v, ...] in place of each array of `PICTURES`.
    """
    if "sizes" not in arrays:
        return arrays
    sizes, names = arrays["sizes"], [name for name in PICTURES if name in arrays]
    return arrays | {
        name: [image[:height, :width] for image, (width, height) in zip(arrays[name], sizes)]
        for name in names
    }
