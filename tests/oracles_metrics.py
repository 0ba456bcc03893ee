"""Slow float64 references of the measures: one window, one pixel at a time."""

from __future__ import annotations

import numpy as np


def ssim_by_windows(prediction, truth) -> float:
    """SSIM of one image [H, W, 3]: every 11 x 11 window by itself, as in Wang et al. 2004."""
    prediction, truth = np.asarray(prediction, np.float64), np.asarray(truth, np.float64)
    line = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    weights = np.outer(line, line) / line.sum() ** 2
    height, width, channels = truth.shape
    values = []
    for row in range(height - 10):
        for column in range(width - 10):
            for channel in range(channels):
                x = prediction[row : row + 11, column : column + 11, channel]
                y = truth[row : row + 11, column : column + 11, channel]
                mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
                var_x = (weights * (x - mean_x) ** 2).sum()
                var_y = (weights * (y - mean_y) ** 2).sum()
                cov = (weights * (x - mean_x) * (y - mean_y)).sum()
                luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
                values.append(luminance * (2 * cov + 9e-4) / (var_x + var_y + 9e-4))
    return float(np.mean(values))


def depth_mae_by_pixels(depth, true_depth) -> float:
    """Mean absolute depth error of one image [H, W], pixel by pixel."""
    errors = [
        abs(float(d) - float(t)) for d, t in zip(np.ravel(depth), np.ravel(true_depth)) if t > 0
    ]
    return float(np.mean(errors)) if errors else float("nan")
