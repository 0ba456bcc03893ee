"""One seed of `evaluate_uncertainty`: its field, and every model that has no result yet.

Each step leaves a file and is not done again: the run's checkpoints, the renders of the common
field, and of each model the numbers, curves and intervals. The numbers come last.
"""

from __future__ import annotations

import pathlib
from functools import partial

import numpy as np

from bavs_jax.rendering.images import render_views
from experiments.build import RENDER_CHUNK, Problem
from experiments.evaluate import mean_quality, spread_evenly
from experiments.files import read_arrays, read_json, write_arrays, write_json
from experiments.keys import stream_key
from experiments.runtime import code_commit
from experiments.trained import FIRST_ROUND, train_run
from experiments.uncertain import intervals, measure
from experiments.uncertain.files import calibration_path, load_images, save_calibration, save_images
from experiments.uncertain.plots import band_arrays
from experiments.uncertain.results import ROW_VERSION, row_path

COMMON_MODEL = "entropy"  # fits nothing: what it renders is the run's own field


def trained_situation(config, problem: Problem, folder: pathlib.Path, seed: int, command: str):
    """The field of a seed at the end of its run of the config's first policy."""
    policy = config.policies[0] if config.num_rounds else FIRST_ROUND
    run = train_run(config, problem, folder, policy, seed, command)
    return run.situation._replace(label=f"seed {seed}")


def measure_seed(config, problem: Problem, folder: pathlib.Path, seed: int, command: str) -> None:
    """Measures every model that has no result yet."""
    missing = [
        name for name in config.evaluation.models if not is_done(row_path(folder, name, seed))
    ]
    if not missing:
        return
    commit = code_commit()  # now: files may be edited while it runs
    scene, options = problem.scene, config.evaluation
    situation = trained_situation(config, problem, folder, seed, command)
    view_ids = spread_evenly(scene.test, options.num_views)
    key = stream_key(seed, "evaluation")
    common = _common_images(problem, folder, seed, key, situation, view_ids)
    errors_of = partial(measure.pixel_errors, scene, view_ids, scale_depth=options.scale_depth)
    about_common = errors_of(common.images), mean_quality(scene, view_ids, common.images)
    for name in missing:
        fitted = measure.fit_model(problem, name, key, situation)
        label = f"{situation.label}: {name}"
        rendered = common
        if name != COMMON_MODEL:
            rendered = measure.render_model(scene, fitted, view_ids, label)
        path = row_path(folder, name, seed)
        arrays, numbers = _sparsification(
            config, scene, view_ids, rendered.images, errors_of(rendered.images), *about_common
        )
        more_arrays, more_numbers, seconds = _intervals(
            config, scene, fitted, situation, calibration_path(folder, name, seed), seed, label
        )
        write_arrays(path.with_suffix(".npz"), **arrays, **more_arrays)
        row = {
            "row_version": ROW_VERSION,
            "model": name,
            "seed": seed,
            "num_views": int(np.sum(situation.is_training_view)),
            "num_test_views": len(view_ids),
            **numbers,
            **more_numbers,
            "seconds": {"fit": fitted.seconds, "render": rendered.seconds, "intervals": seconds},
            "commit": commit,
        }
        write_json(path, row)


def is_done(path: pathlib.Path) -> bool:
    """Whether a row is there with its arrays, made by this version."""
    row = read_json(path)
    is_current = row is not None and row.get("row_version") == ROW_VERSION
    return is_current and read_arrays(path.with_suffix(".npz")) is not None


def _common_images(problem, folder, seed, key, situation, view_ids) -> measure.ModelImages:
    """Renders of the run's own field with the entropy of its rays, from file if they are there."""
    path = folder / "uncertainty" / "common" / f"seed_{seed}.npz"
    if (kept := load_images(path)) is not None:
        return measure.ModelImages(*kept)
    fitted = measure.fit_model(problem, COMMON_MODEL, key, situation)
    label = f"{situation.label}: {COMMON_MODEL}"
    rendered = measure.render_model(problem.scene, fitted, view_ids, label)
    save_images(path, *rendered)
    return rendered


def _sparsification(config, scene, view_ids, images, own_errors, common_errors, common_quality):
    """Curves and pictures as arrays, and both AUSE of every variant as numbers."""
    own, common = (measure.all_ause(errors, images) for errors in (own_errors, common_errors))
    quality = mean_quality(scene, view_ids, images)
    arrays = measure.curve_arrays(own, "own") | measure.curve_arrays(common, "common")
    shown = spread_evenly(np.arange(len(view_ids)), config.num_pictures)
    if config.num_pictures:
        arrays |= measure.picture_arrays(scene, view_ids, images, shown)
    numbers = {
        "psnr": quality["psnr"],
        "ssim": quality["ssim"],
        "psnr_common": common_quality["psnr"],
        "own": measure.ause_numbers(own),
        "common": measure.ause_numbers(common),
    }
    return arrays, numbers


def _intervals(config, scene, fitted, situation, path: pathlib.Path, seed: int, label: str):
    """Calibrates intervals, writes them to `path`, and measures and shows them on test views."""
    options = config.evaluation
    groups = intervals.split(scene, situation.is_training_view, options.num_interval_views, seed)
    samples, seconds = intervals.sample_views(
        scene, fitted.render, np.concatenate(groups), options.num_interval_pixels, label
    )
    calibration, numbers = intervals.calibrate_samples(
        groups, samples, scale=options.interval_scale, scale_depth=options.scale_depth
    )
    about = {
        "scene": scene.name,
        "model": path.parent.name,
        "seed": seed,
        "views": {
            name: [scene.names[view] for view in views] for name, views in groups._asdict().items()
        },
        "pixels_per_view": options.num_interval_pixels,
    }
    save_calibration(path, calibration, about)
    shown = groups.test[:1]
    image = render_views(fitted.render, scene.cameras, shown, chunk=RENDER_CHUNK)[0]
    arrays = band_arrays(scene, calibration, int(shown[0]), image)
    split = {name: views.tolist() for name, views in groups._asdict().items()}
    return arrays, {"intervals": numbers, "interval_views": split}, seconds
