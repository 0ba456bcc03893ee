"""Trains fields on few views, or takes up a run, and measures how well uncertainty tells error.

    python -m experiments.evaluate_uncertainty \\
        --config=experiments/configs/uncertainty.py --workdir=runs/uncertainty

Every uncertainty model is measured on test views by AUSE in all its variants, on its own field and
on one common field; and its uncertainty is turned into intervals of colour and depth, calibrated on
views that nothing was trained on and tested on yet others. What is there already in --workdir is
not computed again: one may kill it and start it again. A folder that
`experiments.active_selection` has filled with the same config is taken up where it ended.
"""

from __future__ import annotations

import json
import pathlib
import sys
import time

import numpy as np
from absl import flags
from ml_collections import config_flags

from bavs_jax.uncertainty.conformal_scale import SCALES
from bavs_jax.uncertainty.models import MODELS
from experiments import runtime, workdir
from experiments.build import build_problem
from experiments.build_scene import load_config_scene
from experiments.errors import USER_ERRORS, check_choice
from experiments.machine import device_name, versions
from experiments.uncertain import intervals
from experiments.uncertain.one_seed import measure_seed
from experiments.uncertain.page import write_page
from experiments.uncertain.results import NAME, SCHEMA_VERSION, row_path, save_result

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


def evaluate(config, folder: pathlib.Path, command: str) -> None:
    """All seeds, then the summary and the page."""
    for name in config.evaluation.models:
        check_choice("evaluation.models", name, tuple(MODELS))
    check_choice("evaluation.interval_scale", config.evaluation.interval_scale, SCALES)
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
    write_page(
        folder / "uncertainty.html", result, arrays=arrays, variant=config.evaluation.variant
    )
    print(f"numbers: {folder / NAME}")
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
