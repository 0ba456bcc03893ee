"""Removes floaters from a trained field: density goes where the uncertainty is above a threshold.

    python -m experiments.clean_up --workdir=runs/quickstart
    python -m experiments.clean_up --config=experiments/configs/cleanup.py --workdir=runs/cleanup

The first takes up the runs of a folder; the second trains on few views first. The threshold is
chosen from the training views alone; test views only measure what it is worth. Writes
WORKDIR/cleanup.json, with the measures at every threshold that was tried, and test views before and
after into WORKDIR/<policy>/seed_<n>/cleanup/views.png.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np
from absl import flags
from matplotlib.figure import Figure

from bavs_jax.fields.deformation import offset_unit
from bavs_jax.metrics.covered import MIN_OPACITY, Sweep, pixel_sums, sweep_of
from bavs_jax.uncertainty.cleanup import (
    RULES,
    choose_threshold,
    even_thresholds,
    make_cleaned_render_fn,
    threshold_sigma,
)
from experiments import posthoc, runtime
from experiments.evaluate import evenly_spaced
from experiments.reporting.pictures import Panel, panel_table, psnr_words
from experiments.reporting.plots import save_figure
from experiments.trained import TrainedRun

NUM_PICTURES = 4

FLAGS = flags.FLAGS
posthoc.define_flags()
flags.DEFINE_enum("rule", RULES[0], RULES, "How the threshold is chosen from the training views.")
flags.DEFINE_float("max_loss", 0.1, "Rule quality: dB that the training views may lose.", 0.0)
flags.DEFINE_float("keep", 0.99, "Rule keep: share of their content that stays.", 1e-6, 1.0)
flags.DEFINE_integer("num_thresholds", 20, "Thresholds of the sweep.", 3, 1000)
flags.DEFINE_float("min_opacity", MIN_OPACITY, "Least one of a covered pixel.", 1e-6, 1.0)
flags.DEFINE_integer("num_test", 50, "Test views, evenly spaced; 0: all.", 0)


def clean_run(run: TrainedRun) -> dict:
    """One run's numbers; writes its picture."""
    setup, unit = run.problem.setup, float(offset_unit(run.problem.scene.box))
    variance = run.variance()
    look = {"variant": setup.laplace.variant, "extent": setup.laplace.extent}
    render = make_cleaned_render_fn(setup.model, setup.grid, **look)

    def cleaned(thresholds) -> Callable:
        return partial(render, run.state.train.model, variance, jnp.asarray(thresholds))

    thresholds = even_thresholds(variance, FLAGS.num_thresholds, unit)
    test_views = evenly_spaced(run.problem.scene.test, FLAGS.num_test)
    views = {"training": run.training_views, "test": test_views}
    sweeps = {
        name: sweep_views(run, cleaned(thresholds), ids, thresholds, f"{len(ids)} {name} views")
        for name, ids in views.items()
    }
    choice = {name: FLAGS[name].value for name in ("rule", "max_loss", "keep")}
    row = choose_threshold(sweeps["training"], **choice)
    path = run.folder / "cleanup" / "views.png"
    shown = evenly_spaced(test_views, NUM_PICTURES)
    save_figure(views_figure(run, cleaned([thresholds[row], np.inf]), shown), path)
    print(f"picture: {path}")
    numbers = {
        name: {key: [*map(_number, values)] for key, values in sweep._asdict().items()}
        for name, sweep in sweeps.items()
    }
    before, after = (
        {
            name: {key: values[place] for key, values in sweep.items() if key != "thresholds"}
            for name, sweep in numbers.items()
        }
        for place in (-1, row)
    )
    sigma = threshold_sigma(thresholds[row], unit)  # scene units
    options = {**choice, "min_opacity": FLAGS.min_opacity, "num_test": len(test_views), **look}
    return {
        "options": options,
        "chosen": {"threshold": _number(thresholds[row]), "sigma": _number(sigma)},
        "before": before,
        "after": after,
        "sweep": numbers,
    }


def _number(value) -> float | None:
    """A number for a result file: null where it is none, such as a measure that no pixel has."""
    return float(value) if np.isfinite(value) else None


def sweep_views(run: TrainedRun, cleaned_fn: Callable, view_ids, thresholds, label: str) -> Sweep:
    """Measures of views, rendered by `cleaned_fn` for thresholds [T]; without masked pixels."""
    options = {"background": run.problem.model.background, "min_opacity": FLAGS.min_opacity}
    sums = []
    with run.track(view_ids, label) as bar:
        # One view at a time: its images at every threshold are T times as large as the view.
        for view in view_ids:
            (images,) = run.render(cleaned_fn, [view], bar.advance)
            truth, mask = run.photo(view)
            counted = {name: value[mask] for name, value in images.items()}
            sums.append(pixel_sums(counted, truth[mask], **options))
    return sweep_of(thresholds, sums)


def views_figure(run: TrainedRun, cleaned_fn: Callable, view_ids) -> Figure:
    """Views after the clean-up and before, in the order of its two thresholds; and what went."""
    rows = []
    for view, image in zip(view_ids, run.render(cleaned_fn, view_ids)):
        truth, _ = run.photo(view)
        after, before = np.moveaxis(image["rgb"], 2, 0).clip(0.0, 1.0)
        lost = image["opacity"][:, :, 1] - image["opacity"][:, :, 0]
        panels = [
            Panel("truth", truth),
            Panel(f"before, {psnr_words(255.0 * before, 255.0 * truth)}", before),
            Panel(f"after, {psnr_words(255.0 * after, 255.0 * truth)}", after),
            Panel(f"opacity removed, mean {lost.mean():.3f}", lost),
        ]
        rows.append((run.problem.scene.names[view], panels))
    return panel_table(rows, scale_label="opacity removed")


def main() -> None:
    posthoc.measure_runs(clean_run, "cleanup.json")


if __name__ == "__main__":
    runtime.run_script(main)
