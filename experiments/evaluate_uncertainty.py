"""Trains fields on few views, or takes up a run, and measures how well uncertainty tells error.

    python -m experiments.evaluate_uncertainty \\
        --config=experiments/configs/uncertainty.py --workdir=runs/uncertainty

Every uncertainty model is measured on test views by AUSE in all its variants, on its own field and
on one common field. What is there already in --workdir is not computed again; a folder that
`experiments.active_selection` has filled with the same config is taken up where it ended.
"""

from __future__ import annotations

import json
import pathlib
import sys
import time

import jax
import numpy as np
from absl import flags
from ml_collections import config_flags

from bavs_jax.uncertainty.models import MODELS
from experiments import runtime, workdir
from experiments.build import Problem, build_problem, run_key
from experiments.build_scene import load_config_scene
from experiments.errors import USER_ERRORS, check_choice
from experiments.evaluate import mean_quality, spread_evenly
from experiments.files import write_arrays, write_json
from experiments.machine import device_name
from experiments.trained import FIRST_ROUND, train_run
from experiments.uncertain import measure
from experiments.uncertain.page import write_page
from experiments.uncertain.results import row_path

FLAGS = flags.FLAGS
config_flags.DEFINE_config_file(
    "config",
    None,
    "What to measure, such as experiments/configs/uncertainty.py; every option is explained in "
    "experiments/configs/base.py and can be set as --config.name=value.",
    lock_config=True,
)
flags.DEFINE_string("workdir", None, "Folder for fields, uncertainty.json and uncertainty.html.")
flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")

SCHEMA_VERSION = 1


def trained_situation(config, problem: Problem, folder: pathlib.Path, seed: int, command: str):
    """The field of a seed at the end of its run of the config's first policy."""
    policy = config.policies[0] if config.num_rounds else FIRST_ROUND
    run = train_run(config, problem, folder, policy, seed, command)
    return run.situation._replace(label=f"seed {seed}")


def measure_seed(config, problem: Problem, folder: pathlib.Path, seed: int, command: str) -> None:
    """Every model that has no result yet."""
    paths = {name: row_path(folder, name, seed) for name in config.evaluation.models}
    if all(path.exists() for path in paths.values()):
        return
    scene, options = problem.scene, config.evaluation
    situation = trained_situation(config, problem, folder, seed, command)
    view_ids = spread_evenly(scene.test, options.num_views)
    key = jax.random.fold_in(run_key(seed), 2**31 - 3)
    common = measure.render_model(problem, "entropy", key, situation, view_ids).images
    common_errors = measure.pixel_errors(scene, view_ids, common, scale_depth=options.scale_depth)
    for name, path in paths.items():
        if path.exists():
            continue
        model = measure.render_model(problem, name, key, situation, view_ids)
        own_errors = measure.pixel_errors(
            scene, view_ids, model.images, scale_depth=options.scale_depth
        )
        own = measure.all_ause(own_errors, model.images)
        shared = measure.all_ause(common_errors, model.images)
        quality = mean_quality(scene, view_ids, model.images)
        arrays = measure.curve_arrays(own, "own") | measure.curve_arrays(shared, "common")
        shown = np.arange(min(config.num_pictures, len(view_ids))) * len(view_ids)
        shown = shown // max(config.num_pictures, 1)
        arrays |= measure.picture_arrays(scene, view_ids, model.images, shown)
        write_arrays(path.with_suffix(".npz"), **arrays)
        row = {
            "model": name,
            "seed": seed,
            "num_views": int(np.sum(situation.is_training_view)),
            "num_test_views": len(view_ids),
            "psnr": quality["psnr"],
            "ssim": quality["ssim"],
            "seconds": {"fit": model.fit_seconds, "render": model.render_seconds},
            "own": measure.ause_numbers(own),
            "common": measure.ause_numbers(shared),
        }
        write_json(path, row)


def evaluate(config, folder: pathlib.Path, command: str) -> None:
    """All seeds, then the summary and the page."""
    for name in config.evaluation.models:
        check_choice("evaluation.models", name, tuple(MODELS))
    start = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    workdir.claim(folder, config)
    scene = load_config_scene(config, cache_dir=str(runtime.cache_folder() / "scenes"))
    problem = build_problem(config, scene)
    for seed in config.seeds:
        measure_seed(config, problem, folder, seed, command)

    models, seeds = config.evaluation.models, config.seeds
    paths = [row_path(folder, model, seed) for model in models for seed in seeds]
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    result = {
        "schema_version": SCHEMA_VERSION,
        "scene": scene.name,
        "kind": config.loader,
        "command": command,
        "config": config.to_dict(),
        "device": device_name(),
        "rows": rows,
    }
    write_json(folder / "uncertainty.json", result)
    arrays = {
        model: [dict(np.load(row_path(folder, model, s).with_suffix(".npz"))) for s in seeds]
        for model in models
    }
    write_page(
        folder / "uncertainty.html",
        title=f"{scene.name}, {rows[0]['num_views']} training views",
        command=command,
        rows=rows,
        curves=arrays,
        pictures={model: found[0] for model, found in arrays.items()},
        variant=config.evaluation.variant,
    )
    print(f"numbers: {folder / 'uncertainty.json'}")
    print(f"page:    {folder / 'uncertainty.html'}  ({time.monotonic() - start:.0f} s in all)")


def main() -> None:
    if FLAGS.config is None:
        sys.exit("error: --config: is missing; try --config=experiments/configs/uncertainty.py")
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name a folder for the results")
    if FLAGS.compilation_cache:
        runtime.use_compilation_cache(runtime.cache_folder() / "compiled")
    try:
        evaluate(FLAGS.config, pathlib.Path(FLAGS.workdir), runtime.command_line())
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
