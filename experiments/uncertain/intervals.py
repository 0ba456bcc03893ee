"""Calibrated intervals of one uncertainty model: which views and pixels, and how well they hold."""

from __future__ import annotations

import itertools
import time
from typing import NamedTuple

import numpy as np

from bavs_jax.cameras import image_pixels
from bavs_jax.rendering.images import render_pixels
from bavs_jax.uncertainty.bands import (
    QUANTITIES,
    RenderCalibration,
    band_errors,
    calibrate_renders,
    has_band,
    render_errors,
)
from bavs_jax.uncertainty.conformal_report import coverage_report, to_json
from bavs_jax.uncertainty.conformal_scale import ViewErrors, ViewGroups, split_views
from experiments.build import RENDER_CHUNK
from experiments.errors import ConfigError
from experiments.evaluate import spread_evenly
from experiments.progress import track

PIXEL_SEED = 0  # the same pixels of a view for every model and seed


class ViewSample(NamedTuple):
    """Some pixels of a view: what a model renders there, and what is true."""

    image: dict[str, np.ndarray]  # [N, ...] as `band_errors` takes it
    colour: np.ndarray  # [N, 3] in 0 .. 1
    depth: np.ndarray | None  # [N] scene units, 0 where unknown
    known: np.ndarray | None  # [N] whether the pixel counts

    def truth(self, quantity: str) -> np.ndarray | None:
        return self.colour if quantity == "colour" else self.depth


def interval_views(scene, is_training_view, num: int) -> np.ndarray:
    """Views that were not trained on: test views first, then unused ones of the pool.

    Args:
      scene: the scene.
      is_training_view: [V or more] bool.
      num: how many, evenly spaced; 0: all.
    """
    test = spread_evenly(scene.test, num)
    unused = np.asarray(scene.pool)[~np.asarray(is_training_view)[scene.pool]]
    if num:
        missing = num - len(test)
        unused = spread_evenly(unused, missing) if missing else unused[:0]
    return np.concatenate([test, unused])


def split(scene, is_training_view, num: int, seed: int) -> ViewGroups:
    """Views to fit the scale, to calibrate and to test, drawn at random.

    Raises:
      ConfigError: too few views were not trained on.
    """
    views = interval_views(scene, is_training_view, num)
    try:
        return split_views(views, seed=seed)
    except ValueError as error:
        raise ConfigError(f"config.evaluation.num_interval_views: {error}") from None


def pixel_rule(num: int) -> str:
    """Which pixels of a view count, in words."""
    drawn = f"{num} pixels of each view, drawn uniformly without replacement" if num else "all"
    return (
        f"{drawn}; of these the ones with a known truth whose ray meets something (opacity of at "
        "least 1/255) and whose uncertainty is finite"
    )


def sample_views(scene, render_fn, view_ids, num: int, label: str) -> tuple[dict, float]:
    """Renders at most `num` pixels of each view, drawn uniformly without replacement; 0: all.

    Args:
      scene: the scene.
      render_fn: rays [chunk] -> images.
      view_ids: which views.
      num: pixels of a view.
      label: for progress.

    Returns:
      `ViewSample` by view, and the seconds that rendering took.
    """
    start = time.perf_counter()
    rows, pixels = [], []
    for view in view_ids:
        size = int(np.diff(scene.offsets)[view])
        chosen = np.arange(size)
        if 0 < num < size:
            rng = np.random.default_rng((PIXEL_SEED, int(view)))
            chosen = np.sort(rng.choice(size, num, replace=False))
        rows.append(chosen)
        pixels.append(image_pixels(*(int(n) for n in scene.cameras.sizes[view]))[chosen])
    sizes = [len(chosen) for chosen in rows]
    with track(sum(sizes), f"{label}: pixels of {len(sizes)} views", "rays") as bar:
        images = render_pixels(
            render_fn,
            scene.cameras,
            np.repeat(np.asarray(view_ids, np.int32), sizes),
            np.concatenate(pixels),
            chunk=RENDER_CHUNK,
            progress_fn=bar.advance,
        )
    seconds = time.perf_counter() - start
    found, first = {}, 0
    for view, chosen in zip(view_ids, rows):
        at = int(scene.offsets[view]) + chosen
        part = slice(first, first + len(chosen))
        first = part.stop
        found[int(view)] = ViewSample(
            {name: values[part] for name, values in images.items()},
            scene.pixels[at] / 255.0,
            None if scene.depth is None else scene.depth[at],
            None if scene.pixel_mask is None else scene.pixel_mask[at],
        )
    return found, seconds


def calibrate_samples(
    groups: ViewGroups, samples: dict[int, ViewSample], *, scale: str, scale_depth: bool
) -> tuple[RenderCalibration, dict]:
    """Learns intervals on two groups of views and measures them on the third.

    Args:
      groups: the views.
      samples: by view.
      scale: see `fit_scale`.
      scale_depth: whether depth has a scale of its own: the least-squares factor over the fit
        views is then taken out.

    Returns:
      the intervals, and by "colour" and "depth", where it is known, the numbers of
      `coverage_report`, with `share_with_band` of the test pixels whose truth is known, and
      `error_without_band`, the mean error of the others, null of none.
    """
    fit, calibrating, test = ([samples[int(view)] for view in views] for views in groups)
    factor = _depth_factor(fit) if scale_depth else 1.0
    calibration = calibrate_renders(
        *(_group_errors(group, factor) for group in (fit, calibrating)),
        scale=scale,
        depth_factor=factor,
    )
    numbers = {}
    for quantity, errors in _group_errors(test, factor).items():
        calibrated = getattr(calibration, quantity)
        if calibrated is not None and errors:
            measured = to_json(coverage_report(calibrated, errors))
            numbers[quantity] = measured | _without_band(test, quantity, factor)
    return calibration, numbers


def _group_errors(samples: list[ViewSample], factor: float) -> dict[str, list[ViewErrors]]:
    """By quantity, errors of each view that has pixels with a band and a known truth."""
    found = {quantity: [] for quantity in QUANTITIES}
    for quantity, sample in itertools.product(QUANTITIES, samples):
        truth = sample.truth(quantity)
        if truth is None:
            continue
        errors = band_errors(quantity, sample.image, truth, sample.known, depth_factor=factor)
        if errors is not None:
            found[quantity].append(errors)
    return found


def _depth_factor(samples: list[ViewSample]) -> float:
    """Least-squares factor from rendered to true depth; 1 where no depth is known."""
    product, square = 0.0, 0.0
    for sample in samples:
        if sample.depth is None:
            continue
        counts = has_band("depth", sample.image) & (sample.depth > 0.0)
        if sample.known is not None:
            counts &= sample.known
        rendered = sample.image["depth"][counts].astype(np.float64)
        product += rendered @ sample.depth[counts]
        square += rendered @ rendered
    return float(product / square) if square else 1.0


def _without_band(samples: list[ViewSample], quantity: str, factor: float) -> dict:
    """How many pixels have a band where the truth is known, and how wrong the others are."""
    pairs = [_errors_and_bands(sample, quantity, factor) for sample in samples]
    errors, banded = (np.concatenate(parts) for parts in zip(*pairs))
    return {
        "share_with_band": float(banded.mean()),
        "error_without_band": None if banded.all() else float(errors[~banded].mean()),
    }


def _errors_and_bands(sample: ViewSample, quantity: str, factor: float) -> tuple:
    """Of the pixels whose truth is known: errors, and whether they have a band."""
    truth = sample.truth(quantity)
    if truth is None:
        return np.zeros(0), np.zeros(0, bool)
    errors, known = render_errors(quantity, sample.image, truth, sample.known, depth_factor=factor)
    return errors[known], has_band(quantity, sample.image)[known]
