"""One seed of `evaluate_uncertainty`: its field, every model on its test views, and the summary.

Each step leaves a file and is not done again: the run's checkpoints, the renders of the common
field, and of each model the numbers, curves and intervals. The numbers come last.
"""

from __future__ import annotations

import itertools
import json
import pathlib
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from bavs_jax.metrics.ause import ERRORS, Sparsification, mean_sparsification, variant_name
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.bands import uncertainty_of
from bavs_jax.uncertainty.model import Acquired
from experiments.build import Problem, stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.evaluate import evenly_spaced, mean_quality
from experiments.files import read_arrays, read_json, stack_pictures, write_arrays, write_json
from experiments.reporting.uncertainty import write_page
from experiments.reporting.uncertainty_tables import NAME, SCHEMA_VERSION, save_result
from experiments.runtime import code_commit, device_name, track, versions
from experiments.trained import FIRST_ROUND, train_run
from experiments.uncertain import intervals

ROW_VERSION = 2  # of one model and seed; rows of another version are made anew
IMAGES = ("rgb", "depth", "opacity", "uncertainty", "depth_uncertainty")
COMMON_MODEL = "entropy"  # fits nothing: what it renders is the run's own field


def row_path(folder: pathlib.Path, model: str, seed: int) -> pathlib.Path:
    """Where the numbers of one model and seed are kept as soon as they are known."""
    return folder / "uncertainty" / model / f"seed_{seed}.json"


def measure_seed(config, problem: Problem, folder: pathlib.Path, seed: int, command: str) -> None:
    """Measures every model that has no result yet."""
    missing = [m for m in config.evaluation.models if not _is_done(row_path(folder, m, seed))]
    if not missing:
        return
    commit = code_commit()  # now: files may be edited while it runs
    scene, options = problem.scene, config.evaluation
    acquired = trained_views(config, problem, folder, seed, command)
    view_ids = evenly_spaced(scene.test, options.num_views)
    key = stream_key(seed, "evaluation")
    errors_of = partial(pixel_errors, scene, view_ids, scale_depth=options.scale_depth)

    common = folder / "uncertainty" / "common" / f"seed_{seed}.npz"
    if (kept := load_images(common)) is None:
        fitted = fit_model(problem, COMMON_MODEL, key, acquired)
        kept = render_model(scene, fitted, view_ids, f"{acquired.label}: {COMMON_MODEL}")
        save_images(common, *kept)
    common_errors = errors_of(kept[0])
    common_psnr = mean_quality(scene, view_ids, kept[0])["psnr"]

    for name in missing:
        fitted = fit_model(problem, name, key, acquired)
        label = f"{acquired.label}: {name}"
        images, render_seconds = kept
        if name != COMMON_MODEL:
            images, render_seconds = render_model(scene, fitted, view_ids, label)
        ause, arrays = {}, {}
        for field, errors in (("own", errors_of(images)), ("common", common_errors)):
            found = all_ause(errors, images)
            ause[field] = {
                variant: {"ause": one.ause, "unnormalised": one.ause_unnormalised}
                for variant, one in found.items()
            }
            for variant, one in found.items():
                arrays[f"{field}_{variant}_by_uncertainty"] = one.by_uncertainty
                arrays[f"{field}_{variant}_by_error"] = one.by_error
        quality = mean_quality(scene, view_ids, images)
        if config.num_pictures:
            shown = evenly_spaced(np.arange(len(view_ids)), config.num_pictures)
            arrays |= picture_arrays(scene, view_ids, images, shown)
        path = row_path(folder, name, seed)
        band, numbers, interval_seconds = _measure_intervals(
            config, scene, fitted, acquired, folder, name, seed
        )
        seconds = {"fit": fitted.seconds, "render": render_seconds, "intervals": interval_seconds}
        write_arrays(path.with_suffix(".npz"), **arrays, **band)
        row = {
            "row_version": ROW_VERSION,
            "model": name,
            "seed": seed,
            "num_views": int(np.sum(acquired.is_training_view)),
            "num_test_views": len(view_ids),
            "psnr": quality["psnr"],
            "ssim": quality["ssim"],
            "psnr_common": common_psnr,
            **ause,
            **numbers,
            "seconds": seconds,
            "commit": commit,
        }
        write_json(path, row)


def trained_views(config, problem: Problem, folder: pathlib.Path, seed: int, command: str):
    """The field of a seed at the end of its run of the config's first policy."""
    policy = config.policies[0] if config.num_rounds else FIRST_ROUND
    run = train_run(config, problem, folder, policy, seed, command)
    return run.acquired._replace(label=f"seed {seed}")


def _is_done(path: pathlib.Path) -> bool:
    """Whether a row is there with its arrays, made by this version."""
    row = read_json(path)
    is_current = row is not None and row.get("row_version") == ROW_VERSION
    return is_current and read_arrays(path.with_suffix(".npz")) is not None


def _measure_intervals(config, scene, fitted, acquired, folder, name: str, seed: int) -> tuple:
    """Calibrates intervals, writes their file, and measures and shows them on test views."""
    options = config.evaluation
    groups = intervals.split(scene, acquired.is_training_view, options.num_interval_views, seed)
    label = f"{acquired.label}: {name}"
    samples, seconds = intervals.sample_views(
        scene,
        fitted.render,
        np.concatenate(groups),
        options.num_interval_pixels,
        label,
        rays_per_pixel=fitted.rays_per_pixel,
    )
    calibration, numbers = intervals.calibrate_samples(
        groups, samples, scale=options.interval_scale, scale_depth=options.scale_depth
    )
    views = {part: [int(view) for view in group] for part, group in groups._asdict().items()}
    about = {
        "scene": scene.name,
        "model": name,
        "seed": seed,
        "views": {part: [scene.names[view] for view in group] for part, group in views.items()},
        "pixels_per_view": options.num_interval_pixels,
    }
    path = intervals.calibration_path(folder, name, seed)
    intervals.save_calibration(path, calibration, about)
    shown = groups.test[:1]
    image = render_views(
        fitted.render,
        scene.cameras,
        shown,
        chunk=RENDER_CHUNK,
        rays_per_pixel=fitted.rays_per_pixel,
    )[0]
    arrays = intervals.band_arrays(scene, calibration, int(shown[0]), image)
    return arrays, {"intervals": numbers, "interval_views": views}, seconds


def write_summary(config, scene, folder: pathlib.Path, command: str) -> tuple:
    """Collects the rows of all models and seeds into one result file and one page.

    Args:
      config: see `experiments/configs/base.py`.
      scene: the scene.
      folder: where the rows are.
      command: that made them.

    Returns:
      the paths of both files.
    """
    models, seeds = config.evaluation.models, config.seeds
    paths = [row_path(folder, model, seed) for model in models for seed in seeds]
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    # The same for all models of a seed.
    interval_views = {str(row["seed"]): row.pop("interval_views") for row in rows}
    result = {
        "schema_version": SCHEMA_VERSION,
        "scene": scene.name,
        "kind": config.loader,
        "image_size": np.asarray(scene.cameras.sizes).max(axis=0).tolist(),
        "seeds": list(seeds),
        "command": command,
        "config": config.to_dict(),
        "device": device_name(),
        "versions": versions(),
        "pixel_rule": intervals.pixel_rule(config.evaluation.num_interval_pixels),
        "interval_views": interval_views,
        "rows": rows,
    }
    save_result(folder, result)
    arrays = {
        model: [dict(np.load(row_path(folder, model, s).with_suffix(".npz"))) for s in seeds]
        for model in models
    }
    page = folder / "uncertainty.html"
    write_page(page, result, arrays=arrays, variant=config.evaluation.variant)
    return folder / NAME, page


# --- a model on whole views ---


class FittedModel(NamedTuple):
    """A model that is ready to render."""

    render: Callable  # rays [chunk] -> images, those of `IMAGES` that the model has
    seconds: float  # that it took to fit
    rays_per_pixel: int = 1  # see `render_views`


def fit_model(problem: Problem, name: str, key, acquired: Acquired) -> FittedModel:
    """Fits a model to the training views of a acquired."""
    fns = problem.model_fns(name)
    start = time.perf_counter()
    fitted = jax.block_until_ready(fns.fit(key, acquired))
    seconds = time.perf_counter() - start

    def render(rays):
        rendered = fns.render(fitted, acquired.train, rays)
        return {k: rendered[k] for k in IMAGES if k in rendered}

    return FittedModel(render, seconds, problem.config.rays_per_pixel)


def render_model(scene, fitted: FittedModel, view_ids, label: str) -> tuple[list[dict], float]:
    """Renders whole views with a fitted model: the images of each, and the seconds it took."""
    start = time.perf_counter()
    num_rays = fitted.rays_per_pixel * int(np.diff(scene.offsets)[view_ids].sum())
    with track(num_rays, f"{label} on {len(view_ids)} views", "rays") as bar:
        rendered = render_views(
            fitted.render,
            scene.cameras,
            view_ids,
            chunk=RENDER_CHUNK,
            rays_per_pixel=fitted.rays_per_pixel,
            progress_fn=bar.advance,
        )
    return rendered, time.perf_counter() - start


def pixel_errors(scene, view_ids, images: list[dict], *, scale_depth: bool) -> dict[str, list]:
    """Absolute errors of each view by what they are of, in the order of its pixels.

    Args:
      scene: holds the true images, and true depth where it is known.
      view_ids: [n] which views.
      images: of each view "rgb" and "depth".
      scale_depth: whether depth has a scale of its own: one factor, the least-squares one over all
        pixels, is taken out before.

    Returns:
      {"colour": [...], "depth": [...]}, each a list of (errors [N], which pixels [H * W] bool);
      without "depth" if no view has a true one. Colour errors are means over the channels; depth
      errors are shares of the largest true depth.
    """
    colour, known, pairs = [], [], []
    for view, image in zip(view_ids, images):
        truth = scene.image(view).astype(np.float64) / 255.0
        mask = scene.mask_image(view)
        counts = np.ones(truth.shape[:2], bool) if mask is None else mask
        error = np.abs(np.clip(image["rgb"], 0.0, 1.0) - truth).mean(-1)
        colour.append((error[counts], counts.ravel()))
        true_depth = scene.depth_image(view)
        if true_depth is not None and (true_depth > 0.0).any():
            has_depth = counts & (true_depth > 0.0)
            known.append(has_depth.ravel())
            pairs.append((image["depth"][has_depth], true_depth[has_depth]))
        else:
            known.append(np.zeros(counts.size, bool))
            pairs.append((np.zeros(0), np.zeros(0)))
    if not any(k.any() for k in known):
        return {"colour": colour}
    rendered, true = (np.concatenate([p[i] for p in pairs]).astype(np.float64) for i in (0, 1))
    factor = (rendered @ true) / max(rendered @ rendered, 1e-12) if scale_depth else 1.0
    largest = true.max()
    depth = [(np.abs(factor * r - t) / largest, k) for (r, t), k in zip(pairs, known)]
    return {"colour": colour, "depth": depth}


def all_ause(errors: dict[str, list], images: list[dict]) -> dict[str, Sparsification]:
    """Every variant of AUSE of one model, by its name.

    Args:
      errors: from `pixel_errors`; maybe those of another field than the model's own.
      images: of each view "uncertainty", and "depth_uncertainty" where the model has one for depth.
    """
    found = {}
    for (of, parts), error, pooled in itertools.product(errors.items(), ERRORS, (False, True)):
        pick = partial(uncertainty_of, of)
        pairs = [(e, pick(image).ravel()[k]) for (e, k), image in zip(parts, images) if len(e)]
        name = variant_name(of=of, error=error, pooled=pooled)
        found[name] = mean_sparsification(pairs, error=error, pooled=pooled)
    return found


def picture_arrays(scene, view_ids, images: list[dict], shown) -> dict[str, np.ndarray]:
    """Truth, render, colour error and uncertainty of the views at places `shown`."""
    views = [int(view_ids[i]) for i in shown]
    truth = stack_pictures([scene.image(v) for v in views])
    rgb = stack_pictures([np.clip(images[i]["rgb"], 0.0, 1.0) for i in shown])
    return {
        "names": np.array([scene.names[v] for v in views]),
        "sizes": np.asarray(scene.cameras.sizes)[views],
        "truth": truth,
        "rgb": np.round(255.0 * rgb).astype(np.uint8),
        "error": np.abs(rgb - truth / 255.0).mean(-1).astype(np.float32),
        "uncertainty": stack_pictures([images[i]["uncertainty"] for i in shown]),
    }


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
