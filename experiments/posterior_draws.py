"""Scenes that the photos allow (Fig 3): draws offsets from a posterior and renders them.

    python -m experiments.posterior_draws --workdir=runs/quickstart
    python -m experiments.posterior_draws --config=experiments/configs/quickstart.py --workdir=NEW

The first takes up the runs of a folder; the second trains first. What the photos show stays where
it is, and what they do not settle moves: WORKDIR/draws.json says how far pixels move in training
views and in test views, and WORKDIR/<policy>/seed_<n>/draws/draws.png shows it.
"""

from __future__ import annotations

import numpy as np
from absl import flags
from matplotlib.figure import Figure

from experiments.evaluate import evenly_spaced
from experiments.posthoc import script
from experiments.posthoc.draws import (
    ViewDraws,
    draw_views,
    farthest_view,
    largest_offset,
    spread_measures,
)
from experiments.reporting.pictures import Panel, panel_table
from experiments.reporting.plots import save_figure
from experiments.reporting.result_tables import SPLITS
from experiments.trained import TrainedRun

NUM_SHOWN = 3  # draws in the picture

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(script)
flags.DEFINE_integer("num_draws", 16, "Offsets drawn from the posterior.")
flags.DEFINE_integer("num_views", 8, "Training views, and as many test views, that are rendered.")
flags.DEFINE_float(
    "scale", 0.0, "Temperature of the draws; 0: what the training views' error says of the noise."
)
flags.DEFINE_float(
    "limit",
    1.0,
    "Largest offset, in cells of the deformation grid. The posterior is that of small offsets: a "
    "vertex in empty space has no curvature, but far offsets would bring matter there.",
)


def draw_all() -> None:
    """Draws, renders, measures and writes, run by run."""
    script.check_flags(
        ("num_draws", 2 <= FLAGS.num_draws <= 1024, "give a number from 2 to 1024"),
        ("num_views", FLAGS.num_views >= 1, "give 1 or more"),
        ("scale", 0.0 <= FLAGS.scale <= 1e9, "give a number above 0, or 0 for the noise's own"),
        ("limit", 0.0 < FLAGS.limit <= 1e6, "give a number above 0, up to 1e6"),
    )
    script.measure_runs(draw_run, "draws.json")


def draw_run(run: TrainedRun) -> dict:
    """One run's numbers; writes its picture."""
    test = run.problem.scene.test
    far = farthest_view(run, test)
    seen = evenly_spaced(run.training_views, FLAGS.num_views)
    held_out = np.union1d(evenly_spaced(test, FLAGS.num_views), [far])
    views, scale = draw_views(
        run,
        np.concatenate([seen, held_out]),
        num_draws=FLAGS.num_draws,
        scale=FLAGS.scale or None,
        limit=largest_offset(run.setup.grid, FLAGS.limit),
    )
    split = {"training": views[: len(seen)], "test": views[len(seen) :]}
    split["farthest"] = [view for view in split["test"] if view.view_id == far]
    shown = [split["training"][0], *split["farthest"]]
    path = run.folder / "draws" / "draws.png"
    save_figure(draws_figure(run, shown), path)
    print(f"picture:  {path}")
    measures = {name: spread_measures(part) for name, part in split.items()}
    for name, words in SPLITS.items():
        print(f"{words}: {_in_words(measures[name])}")
    return {
        "options": {"num_draws": FLAGS.num_draws, "scale": scale, "limit": FLAGS.limit},
        "farthest_test_view": far,
        **measures,
    }


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
    return panel_table(rows, scale_label="spread over draws (colours in [0, 1])")


def _in_words(measures: dict) -> str:
    if measures["spread"] is None:
        return "no pixel meets matter"
    words = f"colours move by {measures['spread']:.4f} (standard deviation)"
    if measures["rank_correlation"] is None:
        return words
    return f"{words}, rank correlation with uncertainty {measures['rank_correlation']:.2f}"


if __name__ == "__main__":
    script.run_on_trained(draw_all)
