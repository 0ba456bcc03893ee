"""Removes floaters from a trained field: density goes where the uncertainty is above a threshold.

    python -m experiments.clean_up --workdir=runs/quickstart
    python -m experiments.clean_up --config=experiments/configs/cleanup.py --workdir=runs/cleanup

The first takes up the runs of a folder; the second trains on few views first. The threshold is
chosen from the training views alone; test views only measure what it is worth. Writes
WORKDIR/cleanup.json, and sweep.png and views.png into WORKDIR/<policy>/seed_<n>/cleanup.
"""

from __future__ import annotations

import pathlib
import time

import numpy as np
from absl import flags

from bavs_jax.fields.deformation import offset_unit
from bavs_jax.metrics.covered import MIN_OPACITY
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.cleanup import RULES, choose_threshold, spread_thresholds
from experiments.build import RENDER_CHUNK
from experiments.evaluate import spread_evenly
from experiments.files import write_json
from experiments.posthoc import script
from experiments.posthoc.cleanup import (
    in_words,
    make_cleaned_chunk_fn,
    summary,
    sweep_figure,
    sweep_views,
    views_figure,
)
from experiments.report.panels import save_figure
from experiments.trained import TrainedRun, run_curvature, run_variance

NUM_PICTURES = 4

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(script)
flags.DEFINE_enum("rule", RULES[0], RULES, "How the threshold is chosen from the training views.")
flags.DEFINE_float("max_loss", 0.1, "Rule quality: dB that the training views may lose.")
flags.DEFINE_float("keep", 0.99, "Rule keep: share of the training views' content that must stay.")
flags.DEFINE_integer("num_thresholds", 20, "Thresholds of the sweep.")
flags.DEFINE_float("min_opacity", MIN_OPACITY, "Opacity from which on a pixel is covered.")
flags.DEFINE_integer("num_test", 50, "Test views, evenly spaced; 0: all.")


def clean_up() -> None:
    """Sweeps, chooses, measures and writes, run by run."""
    start = time.monotonic()
    script.check_flags(
        ("max_loss", FLAGS.max_loss >= 0.0, "give 0 dB or more"),
        ("keep", 0.0 < FLAGS.keep <= 1.0, "give a share above 0 and up to 1"),
        ("num_thresholds", 3 <= FLAGS.num_thresholds <= 1000, "give a number from 3 to 1000"),
        ("min_opacity", 0.0 < FLAGS.min_opacity <= 1.0, "give an opacity above 0 and up to 1"),
        ("num_test", FLAGS.num_test >= 0, "give a count, or 0 for all"),
    )
    rows = []
    for run in script.trained_runs():
        rows.append(clean_run(run))
        print(in_words(rows[-1]))
        # Written after each run, so that a command that is stopped leaves what it has measured.
        write_json(pathlib.Path(FLAGS.workdir) / "cleanup.json", script.result_file(run, rows))
    print(f"numbers:  {pathlib.Path(FLAGS.workdir) / 'cleanup.json'}")
    print(f"({time.monotonic() - start:.0f} s in all)")


def clean_run(run: TrainedRun) -> dict:
    """One run's numbers; writes its pictures."""
    start = time.monotonic()
    variance = run_variance(run, run_curvature(run))
    unit = offset_unit(run.problem.scene.box)
    thresholds = spread_thresholds(variance, FLAGS.num_thresholds, unit)
    cleaned = make_cleaned_chunk_fn(run, variance)
    test_views = spread_evenly(run.problem.scene.test, FLAGS.num_test)
    sweeps = {
        name: sweep_views(
            cleaned,
            run,
            views,
            thresholds,
            min_opacity=FLAGS.min_opacity,
            label=f"{len(views)} {name} views",
        )
        for name, views in (("training", run.training_views), ("test", test_views))
    }
    choice = {name: FLAGS[name].value for name in ("rule", "max_loss", "keep")}
    row = choose_threshold(sweeps["training"], **choice)
    folder = run.folder / "cleanup"
    save_figure(sweep_figure(sweeps["training"], sweeps["test"], row), folder / "sweep.png")
    pictures = spread_evenly(test_views, NUM_PICTURES)
    views = before_and_after(cleaned, run, pictures, thresholds[row])
    save_figure(views_figure(views), folder / "views.png")
    print(f"pictures: {folder / 'sweep.png'}, {folder / 'views.png'}")
    options = {**choice, "min_opacity": FLAGS.min_opacity, "num_test": len(test_views)}
    return {
        **script.about_run(run),
        "seconds": time.monotonic() - start,
        **summary(run, sweeps, row, options),
    }


def before_and_after(cleaned, run: TrainedRun, view_ids, threshold) -> list[dict]:
    """Views at the threshold and untouched, for `views_figure`."""
    chunk_fn = cleaned([threshold, np.inf])
    cameras, names = run.state.table.cameras, run.problem.scene.names
    images = render_views(chunk_fn, cameras, view_ids, chunk=RENDER_CHUNK)
    return [
        {"name": names[v], "truth": run.truth(v), "rgb": image["rgb"], "opacity": image["opacity"]}
        for v, image in zip(view_ids, images)
    ]


if __name__ == "__main__":
    script.run_on_trained(clean_up)
