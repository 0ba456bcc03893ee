"""Calibrated intervals of one uncertainty model: of which views and pixels, and how well they hold.

A calibration is kept in a file of its own, so that it can be put around renders of new views.
"""

from __future__ import annotations

import itertools
import pathlib
import time
from typing import NamedTuple

import numpy as np

from bavs_jax.cameras import image_pixels
from bavs_jax.rendering.images import render_pixels
from bavs_jax.uncertainty.bands import (
    QUANTITIES,
    RenderCalibration,
    add_bands,
    band_errors,
    calibrate_renders,
    calibration_from_json,
    calibration_to_json,
    has_band,
    render_errors,
)
from bavs_jax.uncertainty.conformal_report import coverage_report, to_json
from bavs_jax.uncertainty.conformal_scale import ViewErrors, ViewGroups, split_views
from experiments.build_model import RENDER_CHUNK
from experiments.evaluate import evenly_spaced
from experiments.files import read_versioned, write_json
from experiments.reporting.uncertainty import LEVEL
from experiments.runtime import ConfigError, WorkdirError, track

SCHEMA_VERSION = 1  # of a calibration's file
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
    test = evenly_spaced(scene.test, num)
    unused = np.asarray(scene.pool)[~np.asarray(is_training_view)[scene.pool]]
    if num:
        missing = num - len(test)
        unused = evenly_spaced(unused, missing) if missing else unused[:0]
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


def sample_views(
    scene, render_fn, view_ids, num: int, label: str, *, rays_per_pixel: int = 1
) -> tuple[dict, float]:
    """Renders at most `num` pixels of each view, drawn uniformly without replacement; 0: all.

    Args:
      scene: the scene.
      render_fn: rays [chunk] -> images.
      view_ids: which views.
      num: pixels of a view.
      label: for progress.
      rays_per_pixel: see `render_pixels`.

    Returns:
      `ViewSample` by view, and the seconds that rendering took.
    """
    start = time.perf_counter()
    rows = {}
    for view in map(int, view_ids):
        size = int(np.diff(scene.offsets)[view])
        rows[view] = np.arange(size)
        if 0 < num < size:
            rng = np.random.default_rng((PIXEL_SEED, view))
            rows[view] = np.sort(rng.choice(size, num, replace=False))
    sizes = [len(chosen) for chosen in rows.values()]
    pixels = [image_pixels(*map(int, scene.cameras.sizes[v]))[rows[v]] for v in rows]
    num_rays = rays_per_pixel * sum(sizes)
    with track(num_rays, f"{label}: pixels of {len(sizes)} views", "rays") as bar:
        images = render_pixels(
            render_fn,
            scene.cameras,
            np.repeat(np.asarray(view_ids, np.int32), sizes),
            np.concatenate(pixels),
            chunk=RENDER_CHUNK,
            rays_per_pixel=rays_per_pixel,
            progress_fn=bar.advance,
        )
    seconds = time.perf_counter() - start
    found = {}
    for (view, chosen), last in zip(rows.items(), np.cumsum(sizes)):
        at = int(scene.offsets[view]) + chosen
        found[view] = ViewSample(
            {name: values[last - len(chosen) : last] for name, values in images.items()},
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
    errors, banded = [], []
    for sample in samples:
        truth = sample.truth(quantity)
        if truth is not None:
            all_errors, known = render_errors(
                quantity, sample.image, truth, sample.known, depth_factor=factor
            )
            errors.append(all_errors[known])
            banded.append(has_band(quantity, sample.image)[known])
    errors, banded = np.concatenate(errors), np.concatenate(banded)
    return {
        "share_with_band": float(banded.mean()),
        "error_without_band": None if banded.all() else float(errors[~banded].mean()),
    }


def band_arrays(scene, calibration: RenderCalibration, view: int, image: dict) -> dict:
    """What is rendered of a view, the half-width of its band at `LEVEL` and the truth, [H, W] each.

    Of depth if it was calibrated, else of colour: the channel that is farthest off at each pixel.
    NaN where a pixel has no band, or no known truth.
    """
    banded, true_depth = add_bands(calibration, image, LEVEL), scene.depth_image(view)
    if calibration.depth is not None and true_depth is not None and (true_depth > 0.0).any():
        quantity, value, half = "depth", banded["depth"], banded["depth_half"]
        truth = np.where(true_depth > 0.0, true_depth, np.nan)
    else:
        quantity, half = "colour", banded["rgb_half"]
        rgb, true_rgb = np.clip(banded["rgb"], 0.0, 1.0), scene.image(view) / 255.0
        worst = np.abs(rgb - true_rgb).argmax(-1)[..., None]
        value, truth = (np.take_along_axis(x, worst, -1)[..., 0] for x in (rgb, true_rgb))
    mask = scene.mask_image(view)
    if mask is not None:
        truth = np.where(mask, truth, np.nan)
    arrays = {"value": np.where(np.isnan(half), np.nan, value), "half": half, "truth": truth}
    arrays = {f"band_{name}": x.astype(np.float32) for name, x in arrays.items()}
    return arrays | {"band_name": np.array(scene.names[view]), "band_quantity": np.array(quantity)}


# --- files ---


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
