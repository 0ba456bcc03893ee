"""Removes floaters from a finished run: density goes where the uncertainty is above a threshold.

    python -m experiments.clean_up --workdir=runs/quickstart

The threshold is chosen from the training views alone; test views only measure what it is worth.
Writes cleanup.json, sweep.png and views.png into WORKDIR/<policy>/seed_<n>/cleanup.
"""

from __future__ import annotations

import pathlib
import sys
import time

import numpy as np
from absl import flags

from bavs_jax.metrics.covered import MIN_OPACITY
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.cleanup import RULES, choose_threshold, spread_thresholds
from experiments import runtime
from experiments.build import RENDER_CHUNK
from experiments.errors import USER_ERRORS, ConfigError
from experiments.evaluate import spread_evenly
from experiments.files import write_json
from experiments.posthoc.cleanup_figures import sweep_figure, views_figure
from experiments.posthoc.cleanup_results import in_words, summary
from experiments.posthoc.cleanup_sweep import make_cleaned_chunk_fn, sweep_views
from experiments.posthoc.figures import save_png
from experiments.posthoc.trained_run import TrainedRun, load_run, run_variance

NUM_PICTURES = 4

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of a finished run of experiments.active_selection.")
flags.DEFINE_string("policy", "", "Whose field to clean; the first of the run's by default.")
flags.DEFINE_integer("seed", None, "Of the run; its first by default.")
flags.DEFINE_enum("rule", "keep", RULES, "How the threshold is chosen from the training views.")
flags.DEFINE_float("keep", 0.99, "Share of the training views' content that must stay.")
flags.DEFINE_integer("num_thresholds", 20, "Thresholds of the sweep.")
flags.DEFINE_float("min_opacity", MIN_OPACITY, "Opacity from which on a pixel is covered.")
flags.DEFINE_integer("num_test", 50, "Test views, evenly spaced; 0: all.")
flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")


def check_flags() -> None:
    """Raises ConfigError for a flag that cannot be used."""
    for name, good, fix in (
        ("keep", 0.0 < FLAGS.keep <= 1.0, "give a share above 0 and up to 1"),
        ("num_thresholds", FLAGS.num_thresholds >= 3, "give 3 or more"),
        ("min_opacity", 0.0 < FLAGS.min_opacity <= 1.0, "give an opacity above 0 and up to 1"),
        ("num_test", FLAGS.num_test >= 0, "give a count, or 0 for all"),
    ):
        if not good:
            raise ConfigError(f"--{name}: {FLAGS[name].value!r} cannot be used: {fix}")


def clean_up(workdir: pathlib.Path) -> None:
    """Sweeps, chooses, measures and writes."""
    start = time.monotonic()
    check_flags()
    run = load_run(workdir, FLAGS.policy, FLAGS.seed)
    variance = run_variance(run)
    thresholds = spread_thresholds(variance, FLAGS.num_thresholds)
    cleaned = make_cleaned_chunk_fn(run, variance)
    test_views = spread_evenly(run.problem.scene.test, FLAGS.num_test)
    sweeps = {
        name: sweep_views(
            *(cleaned, run, views, thresholds),
            min_opacity=FLAGS.min_opacity,
            label=f"{len(views)} {name} views",
        )
        for name, views in (("training", run.training_views), ("test", test_views))
    }
    row = choose_threshold(sweeps["training"], rule=FLAGS.rule, keep=FLAGS.keep)
    folder = run.folder / "cleanup"
    save_png(sweep_figure(sweeps["training"], sweeps["test"], row), folder / "sweep.png")
    pictures = spread_evenly(test_views, NUM_PICTURES)
    views = before_and_after(cleaned, run, pictures, thresholds[row])
    save_png(views_figure(views), folder / "views.png")
    options = {n: FLAGS[n].value for n in ("rule", "keep", "min_opacity", "num_test")}
    made = {"command": runtime.command_line(), "seconds": time.monotonic() - start}
    write_json(folder / "cleanup.json", summary(run, sweeps, row, options, made))
    print(in_words(sweeps["test"], row))
    print(f"results: {folder}  ({time.monotonic() - start:.0f} s in all)")


def before_and_after(cleaned, run: TrainedRun, view_ids, threshold) -> list[dict]:
    """Views at the threshold and untouched, for `views_figure`."""
    chunk_fn = cleaned([threshold, np.inf])
    cameras, names = run.state.table.cameras, run.problem.scene.names
    images = render_views(chunk_fn, cameras, view_ids, chunk=RENDER_CHUNK)
    return [
        {"name": names[v], "truth": run.truth(v), "rgb": image["rgb"], "opacity": image["opacity"]}
        for v, image in zip(view_ids, images)
    ]


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name the folder of a finished run")
    if FLAGS.compilation_cache:
        runtime.use_compilation_cache(runtime.cache_folder() / "compiled")
    try:
        clean_up(pathlib.Path(FLAGS.workdir))
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
