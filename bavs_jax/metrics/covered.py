"""What a clean-up leaves and what it is worth: PSNR over covered pixels, and how many there are.

A pixel is *covered* where the accumulated opacity of the render is at least `MIN_OPACITY`. A pixel
is *empty in truth* where the scene has a known background and the true colour is that background
within `SAME_COLOUR` in every channel; a part of the object that has just this colour counts as
empty too. A covered pixel that is empty in truth is a floater (or a grown silhouette).

Everything is by threshold on the uncertainty, ascending, the last `+inf`: the untouched render.
Pixels are pooled over all views, so that a view with few covered pixels weighs little.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bavs_jax.metrics.image import quantise_uint8

MIN_OPACITY = 0.5
SAME_COLOUR = 2.5 / 255.0  # two steps of 8 bits, for what compression and resizing do


class Sweep(NamedTuple):
    """Measures of the same views for T thresholds; NaN where no pixel counts."""

    thresholds: np.ndarray  # [T] ascending, the last +inf
    content_kept: np.ndarray  # [T] share of the untouched render's weight that is kept
    opacity_kept: np.ndarray  # [T] opacity of the cleaned render, over that of the untouched one
    psnr: np.ndarray  # [T] dB, all pixels
    psnr_covered: np.ndarray  # [T] dB, over the pixels that the cleaned render covers
    psnr_covered_before: np.ndarray  # [T] dB, the untouched render over these same pixels
    share_covered: np.ndarray  # [T] covered, of the pixels that are not empty in truth
    share_floating: np.ndarray  # [T] covered, of the pixels that are empty in truth


class PixelSums(NamedTuple):
    """Sums over pixels from which a sweep follows, each [T] float64; views add up."""

    pixels: np.ndarray
    content: np.ndarray
    opacity: np.ndarray
    square: np.ndarray  # squared error, mean of the channels
    covered: np.ndarray
    covered_square: np.ndarray
    covered_square_before: np.ndarray
    full: np.ndarray  # pixels that are not empty in truth
    full_covered: np.ndarray


def is_empty(truth: np.ndarray, background) -> np.ndarray:
    """Which true pixels [..., 3] show nothing but the background, [...] bool; none without one."""
    if background is None:
        return np.zeros(truth.shape[:-1], bool)
    return (np.abs(truth - np.asarray(background)) <= SAME_COLOUR).all(-1)


def pixel_sums(
    images: dict[str, np.ndarray], truth: np.ndarray, *, background, min_opacity=MIN_OPACITY
) -> PixelSums:
    """Sums over N pixels of any views.

    Args:
      images: "rgb" [N, T, 3], "opacity" and "content" [N, T], by ascending threshold, the last
        `+inf`.
      truth: [N, 3] sRGB in [0, 1].
      background: see `is_empty`.
      min_opacity: from which on a pixel is covered, in (0, 1].
    """
    rgb = np.asarray(quantise_uint8(images["rgb"]), np.float64)
    square = np.square(rgb - truth[:, None]).mean(-1)
    covered = images["opacity"] >= min_opacity
    full = ~is_empty(truth, background)[:, None]
    each = (
        np.ones_like(square),
        images["content"],
        images["opacity"],
        square,
        covered,
        np.where(covered, square, 0.0),
        np.where(covered, square[:, -1:], 0.0),
        np.broadcast_to(full, square.shape),
        covered & full,
    )
    return PixelSums(*(x.sum(0, dtype=np.float64) for x in each))


def sweep_of(thresholds: np.ndarray, views: Sequence[PixelSums]) -> Sweep:
    """The measures of all views together.

    Raises:
      ValueError: no views, or thresholds that are not ascending up to `+inf`.
    """
    thresholds = np.asarray(thresholds)
    if not views:
        raise ValueError("views: there are none to measure")
    if not (np.diff(thresholds) > 0).all() or not np.isposinf(thresholds[-1]):
        raise ValueError(f"thresholds: {thresholds} must ascend and end in inf")
    s = PixelSums(*(np.sum(x, axis=0) for x in zip(*views)))
    floating, empty = s.covered - s.full_covered, s.pixels - s.full
    return Sweep(
        thresholds=thresholds,
        content_kept=_ratio(s.content, s.content[-1]),
        opacity_kept=_ratio(s.opacity, s.opacity[-1]),
        psnr=_psnr(_ratio(s.square, s.pixels)),
        psnr_covered=_psnr(_ratio(s.covered_square, s.covered)),
        psnr_covered_before=_psnr(_ratio(s.covered_square_before, s.covered)),
        share_covered=_ratio(s.full_covered, s.full),
        share_floating=_ratio(floating, empty),
    )


def _ratio(numerator, denominator) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(denominator > 0, numerator / denominator, np.nan)


def _psnr(mse: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return -10.0 * np.log10(mse)
