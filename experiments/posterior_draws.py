"""Scenes that the photos allow (Fig 3): draws offsets from a run's posterior and renders them.

    python -m experiments.posterior_draws --workdir=runs/quickstart

What the photos show stays where it is, and what they do not settle moves. Writes draws.json, with
how far pixels move in training views and in test views, and draws.png into
WORKDIR/<policy>/seed_<n>/draws.
"""

from __future__ import annotations

import pathlib
import sys
import time

import numpy as np
from absl import flags
from matplotlib.figure import Figure

from experiments import runtime
from experiments.errors import USER_ERRORS, ConfigError
from experiments.evaluate import spread_evenly
from experiments.files import write_json
from experiments.machine import device_name
from experiments.posthoc.draws import (
    ViewDraws,
    draw_views,
    farthest_view,
    largest_offset,
    spread_measures,
)
from experiments.posthoc.figures import Panel, panel_table, save_png
from experiments.posthoc.trained_run import TrainedRun, load_run

SCHEMA_VERSION = 1
NUM_SHOWN = 3  # draws in the picture

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of a finished run of experiments.active_selection.")
flags.DEFINE_string("policy", "", "Whose field; the first of the run's by default.")
flags.DEFINE_integer("seed", None, "Of the run; its first by default.")
flags.DEFINE_integer("num_draws", 16, "Offsets drawn from the posterior.")
flags.DEFINE_integer("num_views", 8, "Training views, and as many test views, that are rendered.")
flags.DEFINE_float(
    "scale", 0.0, "Temperature of the draws; 0: what the training views' error says of the noise."
)
flags.DEFINE_float("limit", 0.1, "Largest offset, as a share of the sides of the scene box.")
flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")


def check_flags() -> None:
    """Raises ConfigError for a flag that cannot be used."""
    for name, good, fix in (
        ("num_draws", FLAGS.num_draws >= 2, "give 2 or more"),
        ("num_views", FLAGS.num_views >= 1, "give 1 or more"),
        ("scale", FLAGS.scale >= 0.0, "give a number above 0, or 0 for the noise's own"),
        ("limit", 0.0 < FLAGS.limit <= 1.0, "give a share above 0 and up to 1"),
    ):
        if not good:
            raise ConfigError(f"--{name}: {FLAGS[name].value!r} cannot be used: {fix}")


def draw_and_write(workdir: pathlib.Path) -> None:
    """Draws, renders, measures and writes."""
    start = time.monotonic()
    check_flags()
    run = load_run(workdir, FLAGS.policy, FLAGS.seed)
    test = run.problem.scene.test
    far = farthest_view(run, test)
    seen = spread_evenly(run.training_views, FLAGS.num_views)
    held_out = np.union1d(spread_evenly(test, FLAGS.num_views), [far])
    views, scale = draw_views(
        run,
        np.concatenate([seen, held_out]),
        num_draws=FLAGS.num_draws,
        scale=FLAGS.scale or None,
        limit=largest_offset(run, FLAGS.limit),
    )
    split = {"training": views[: len(seen)], "test": views[len(seen) :]}
    measures = {name: spread_measures(part) for name, part in split.items()}
    folder = run.folder / "draws"
    shown = [split["training"][0], next(v for v in split["test"] if v.view_id == far)]
    save_png(draws_figure(run, shown), folder / "draws.png")
    value = {
        "schema_version": SCHEMA_VERSION,
        "scene": run.problem.scene.name,
        "policy": run.policy,
        "seed": run.seed,
        "command": runtime.command_line(),
        "device": device_name(),
        "seconds": time.monotonic() - start,
        "options": {"num_draws": FLAGS.num_draws, "scale": scale, "limit": FLAGS.limit},
        "farthest_test_view": far,
        **measures,
    }
    write_json(folder / "draws.json", value)
    for name, part in measures.items():
        print(f"{name} views: {_in_words(part)}")
    print(f"results: {folder}  ({time.monotonic() - start:.0f} s in all)")


def draws_figure(run: TrainedRun, views: list[ViewDraws]) -> Figure:
    """A training view and the test view farthest from all of them, under some draws."""
    spread_top = max(float(np.percentile(view.spread, 99.5)) for view in views) or 1.0
    uncertainty = np.concatenate([view.uncertainty.ravel() for view in views])
    limits = (0.0, float(uncertainty.max()) or 1.0)
    rows = []
    for name, view in zip(("training view", "far test view"), views):
        panels = [
            Panel("truth", run.truth(view.view_id)),
            Panel("render", view.rgb),
            *(Panel(f"draw {i + 1}", image) for i, image in enumerate(view.draws[:NUM_SHOWN])),
            Panel("rendered uncertainty", view.uncertainty, "cividis", limits),
            Panel("spread over draws", view.spread, "magma", (0.0, spread_top)),
        ]
        rows.append((name, panels))
    return panel_table(rows, scale_label="spread over draws")


def _in_words(measures: dict) -> str:
    if measures["spread"] is None:
        return "no pixel meets matter"
    words = f"colours move by {measures['spread']:.4f} (standard deviation)"
    if measures["rank_correlation"] is None:
        return words
    return f"{words}, rank correlation with uncertainty {measures['rank_correlation']:.2f}"


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name the folder of a finished run")
    if FLAGS.compilation_cache:
        runtime.use_compilation_cache(runtime.cache_folder() / "compiled")
    try:
        draw_and_write(pathlib.Path(FLAGS.workdir))
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
