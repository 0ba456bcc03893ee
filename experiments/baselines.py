"""What can be had without a field: the mean colour, and the nearest photograph."""

from __future__ import annotations

import numpy as np
from PIL import Image


def image_psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """PSNR of 8-bit images [H, W, 3] in dB, over the pixels of a mask [H, W] where there is one.

    Equal images count as one level off in all (48 dB), so that means stay finite.
    """
    squared = np.square(image.astype(np.float64) - truth).mean(-1)
    error = squared.mean() if mask is None else squared[mask].mean()
    return float(10.0 * np.log10(255.0**2 / max(error, 1.0)))


def measure_baselines(scene, training_views, test_views) -> dict[str, float]:
    """Mean PSNR over test views of the two pictures that anyone would guess.

    Args:
      scene: the scene.
      training_views: [n] view ids that are trained on.
      test_views: [m] view ids.

    Returns:
      `mean_colour_psnr`, of the mean colour of all training pixels, and `nearest_image_psnr`, of
      the training view whose camera is closest, stretched to the test view's size; dB.
    """
    training_views = np.asarray(training_views)
    rows = np.concatenate([_kept_pixels(scene, view) for view in training_views])
    mean_colour = np.round(rows.mean(axis=0, dtype=np.float64))
    positions = np.asarray(scene.cameras.positions)
    by_mean, by_nearest = [], []
    for view in test_views:
        truth, mask = scene.image(view), scene.mask_image(view)
        distance = np.linalg.norm(positions[training_views] - positions[view], axis=-1)
        nearest = scene.image(training_views[distance.argmin()])
        if nearest.shape != truth.shape:
            size = (truth.shape[1], truth.shape[0])
            nearest = np.asarray(Image.fromarray(nearest).resize(size, Image.Resampling.BILINEAR))
        by_mean.append(image_psnr(np.broadcast_to(mean_colour, truth.shape), truth, mask))
        by_nearest.append(image_psnr(nearest, truth, mask))
    return {
        "mean_colour_psnr": float(np.mean(by_mean)),
        "nearest_image_psnr": float(np.mean(by_nearest)),
    }


def _kept_pixels(scene, view: int) -> np.ndarray:
    rows = scene.pixels[scene.view_slice(view)]
    return rows if scene.pixel_mask is None else rows[scene.pixel_mask[scene.view_slice(view)]]
