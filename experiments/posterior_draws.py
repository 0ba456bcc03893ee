"""Scenes that the photos allow (Fig 3): draws offsets from a posterior and renders them.

    python -m experiments.posterior_draws --workdir=runs/quickstart
    python -m experiments.posterior_draws --config=experiments/configs/quickstart.py --workdir=NEW

The first takes up the runs of a folder; the second trains first. What the photos show stays where
it is, and what they do not settle moves: WORKDIR/draws.json says how far pixels move in training
views and in test views, and WORKDIR/<policy>/seed_<n>/draws/draws.png shows it.
"""

import numpy as np
from absl import flags
from matplotlib.figure import Figure

from bavs_jax.fields.deformation import cell_sides
from bavs_jax.uncertainty.draws import colour_deviation
from experiments import posthoc, runtime
from experiments.evaluate import evenly_spaced
from experiments.posthoc import draw_views, farthest_view, spread_measures
from experiments.reporting.pictures import Panel, panel_table
from experiments.reporting.plots import save_figure
from experiments.trained import TrainedRun

NUM_SHOWN = 3  # draws in the picture

FLAGS = flags.FLAGS
posthoc.define_flags()
flags.DEFINE_integer("num_draws", 16, "Offsets drawn from the posterior.", 2, 1024)
flags.DEFINE_integer("num_views", 8, "Rendered training views, and as many test views.", 1)
SCALE = "Temperature of the draws; 0: what the training views' error says of the noise."
flags.DEFINE_float("scale", 0.0, SCALE, 0.0, 1e9)
# The posterior is that of small offsets: a vertex in empty space has no curvature, but far offsets
# would bring matter there.
flags.DEFINE_float("limit", 1.0, "Largest offset, in cells of the grid.", 1e-6, 1e6)


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
        scale=FLAGS.scale,
        limit=FLAGS.limit * cell_sides(run.problem.grid),
    )
    split = {"training": views[: len(seen)], "test": views[len(seen) :]}
    split["farthest"] = [view for view in split["test"] if view["view_id"] == far]
    path = run.folder / "draws" / "draws.png"
    save_figure(draws_figure(run, split["training"][0], *split["farthest"]), path)
    print(f"picture: {path}")
    return {
        "options": {"num_draws": FLAGS.num_draws, "scale": scale, "limit": FLAGS.limit},
        "farthest_test_view": far,
        **{name: spread_measures(part) for name, part in split.items()},
    }


def draws_figure(run: TrainedRun, training_view: dict, far_view: dict) -> Figure:
    """A training view and the test view farthest from all of them, under some draws."""
    shown = {"training view": training_view, "far test view": far_view}
    spreads = [np.asarray(colour_deviation(view["draws"])) for view in shown.values()]
    spread_top = max(float(np.percentile(spread, 99.5)) for spread in spreads) or 1.0
    top = max(float(view["uncertainty"].max()) for view in shown.values()) or 1.0
    rows = []
    for (name, view), spread in zip(shown.items(), spreads):
        panels = [
            Panel("truth", run.photo(view["view_id"])[0]),
            Panel("render", view["rgb"]),
            *(Panel(f"draw {i + 1}", image) for i, image in enumerate(view["draws"][:NUM_SHOWN])),
            Panel("rendered uncertainty", view["uncertainty"], "cividis", (0.0, top)),
            Panel("spread over draws", spread, "magma", (0.0, spread_top)),
        ]
        rows.append((name, panels))
    return panel_table(rows, scale_label="spread over draws (colours in [0, 1])")


def main() -> None:
    posthoc.measure_runs(draw_run, "draws.json")


if __name__ == "__main__":
    runtime.run_script(main)
