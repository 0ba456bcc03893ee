"""Removes floaters from a trained field: density goes where the uncertainty is above a threshold.

    python -m experiments.clean_up --workdir=runs/quickstart
    python -m experiments.clean_up --config=experiments/configs/cleanup.py --workdir=runs/cleanup

The first takes up the runs of a folder; the second trains on few views first. The threshold is
chosen from the training views alone; test views only measure what it is worth. Writes
WORKDIR/cleanup.json, and sweep.png and views.png into WORKDIR/<policy>/seed_<n>/cleanup.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np
from absl import flags
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bavs_jax.fields.deformation import offset_unit
from bavs_jax.metrics.covered import MIN_OPACITY, Sweep, pixel_sums, sweep_of
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.cleanup import (
    RULES,
    choose_threshold,
    even_thresholds,
    make_cleaned_render_fn,
    threshold_sigma,
)
from experiments.build_model import RENDER_CHUNK
from experiments.evaluate import evenly_spaced
from experiments.posthoc import script
from experiments.reporting.pictures import Panel, panel_table, psnr_words
from experiments.reporting.plots import BLUE, GREEN, GREY, ORANGE, VERMILION, save_figure, tidy
from experiments.runtime import track
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
    script.check_flags(
        ("max_loss", FLAGS.max_loss >= 0.0, "give 0 dB or more"),
        ("keep", 0.0 < FLAGS.keep <= 1.0, "give a share above 0 and up to 1"),
        ("num_thresholds", 3 <= FLAGS.num_thresholds <= 1000, "give a number from 3 to 1000"),
        ("min_opacity", 0.0 < FLAGS.min_opacity <= 1.0, "give an opacity above 0 and up to 1"),
        ("num_test", FLAGS.num_test >= 0, "give a count, or 0 for all"),
    )
    script.measure_runs(clean_run, "cleanup.json")


def clean_run(run: TrainedRun) -> dict:
    """One run's numbers; writes its pictures."""
    variance = run_variance(run, run_curvature(run))
    unit = float(offset_unit(run.problem.scene.box))
    thresholds = even_thresholds(variance, FLAGS.num_thresholds, unit)
    cleaned = make_cleaned_chunk_fn(run, variance)
    test_views = evenly_spaced(run.problem.scene.test, FLAGS.num_test)
    train, test = (
        sweep_views(cleaned, run, views, thresholds, f"{len(views)} {name} views")
        for name, views in (("training", run.training_views), ("test", test_views))
    )
    choice = {name: FLAGS[name].value for name in ("rule", "max_loss", "keep")}
    row = choose_threshold(train, **choice)
    threshold = thresholds[row]
    folder = run.folder / "cleanup"
    save_figure(sweep_figure(train, test, row), folder / "sweep.png")
    save_figure(
        views_figure(run, cleaned, evenly_spaced(test_views, NUM_PICTURES), threshold),
        folder / "views.png",
    )
    print(f"pictures: {folder / 'sweep.png'}, {folder / 'views.png'}")
    options = {**choice, "min_opacity": FLAGS.min_opacity, "num_test": len(test_views)}
    laplace = run.setup.laplace
    sweeps = {
        name: {key: [_number(x) for x in values] for key, values in sweep._asdict().items()}
        for name, sweep in (("training", train), ("test", test))
    }
    before, after = (
        {
            name: {key: sweep[key][place] for key in sweep if key != "thresholds"}
            for name, sweep in sweeps.items()
        }
        for place in (-1, row)
    )
    print(in_words(_number(threshold), before["test"], after["test"]))
    return {
        "options": {**options, "variant": laplace.variant, "extent": laplace.extent},
        "chosen": {
            "threshold": _number(threshold),
            "sigma": _number(threshold_sigma(threshold, unit)),  # scene units
        },
        "before": before,
        "after": after,
        "sweep": sweeps,
    }


def _number(value) -> float | None:
    """A number for a result file: null where it is none, such as a measure that no pixel has."""
    return float(value) if np.isfinite(value) else None


def make_cleaned_chunk_fn(run: TrainedRun, variance) -> Callable:
    """Makes `cleaned(thresholds [T]) -> (Rays [chunk] -> dict)` of a run's field."""
    tools, train = run.setup, run.state.train
    options = {"variant": tools.laplace.variant, "extent": tools.laplace.extent}
    render = make_cleaned_render_fn(tools.model, tools.grid, **options)

    def cleaned(thresholds):
        thresholds = jnp.asarray(thresholds, jnp.float32)
        return partial(render, train.model, variance, thresholds)

    return cleaned


def sweep_views(cleaned: Callable, run: TrainedRun, view_ids, thresholds, label: str) -> Sweep:
    """Measures of views for all thresholds; pixels that the scene masks do not count.

    Args:
      cleaned: from `make_cleaned_chunk_fn`.
      run: the run.
      view_ids: [n] rows of the pixel table.
      thresholds: [T] ascending, the last +inf.
      label: for progress.
    """
    table, sums = run.state.table, []
    offsets = np.asarray(table.offsets)
    rays_per_pixel = run.config.rays_per_pixel
    total = rays_per_pixel * int(np.diff(offsets)[view_ids].sum())
    chunk_fn = cleaned(thresholds)
    with track(total, f"{run.label}: {label}", "rays") as bar:
        # One view at a time: its images at every threshold are T times as large as the view.
        for view in view_ids:
            (images,) = render_views(
                chunk_fn,
                table.cameras,
                [view],
                chunk=RENDER_CHUNK,
                rays_per_pixel=rays_per_pixel,
                progress_fn=bar.advance,
            )
            mask = run.pixel_mask(view)
            counted = {name: value[mask] for name, value in images.items()}
            options = {"background": run.setup.model.background, "min_opacity": FLAGS.min_opacity}
            sums.append(pixel_sums(counted, run.truth(view)[mask], **options))
    return sweep_of(thresholds, sums)


def in_words(threshold: float | None, before: dict, after: dict) -> str:
    """What the clean-up of a run is worth on test views, in one line."""
    if threshold is None:
        return "nothing was removed: every threshold costs more of the training views than allowed"
    parts = [f"over all {before['psnr']:.2f} -> {after['psnr']:.2f} dB"]
    if after["psnr_covered"] is not None:
        gain = f"{after['psnr_covered_before']:.2f} -> {after['psnr_covered']:.2f} dB"
        parts.insert(0, f"PSNR over still-covered pixels {gain}")
    for name, key in (("covered", "share_covered"), ("empty pixels covered", "share_floating")):
        if before[key] is not None:
            parts.append(f"{name} {before[key]:.1%} -> {after[key]:.1%}")
    return f"threshold {threshold:.3f}: {', '.join(parts)}"


def sweep_figure(train: Sweep, test: Sweep, row: int) -> Figure:
    """PSNR and coverage of test views against the threshold; the chosen one is marked.

    Args:
      train, test: over the same thresholds.
      row: of the chosen one.
    """
    figure = Figure(figsize=(8.6, 5.8))
    quality, share = figure.subplots(2, 1, sharex=True)
    look = {"linewidth": 1.8, "marker": "o", "markersize": 3.0, "zorder": 2}
    chosen = test.thresholds[row]

    def draw(axes, values, colour: str, style: str, label: str) -> None:
        # An exactly right render has no finite PSNR; the curve has a gap there.
        y = np.where(np.isfinite(values), values, np.nan)[:-1]
        axes.plot(test.thresholds[:-1], y, color=colour, linestyle=style, label=label, **look)

    draw(quality, test.psnr_covered, BLUE, "-", "cleaned, covered pixels")
    draw(quality, test.psnr_covered_before, VERMILION, "--", "untouched, the same pixels")
    draw(quality, test.psnr, GREEN, ":", "cleaned, all pixels")
    everything = {"color": GREY, "linewidth": 0.9, "linestyle": "-.", "zorder": 1}
    quality.axhline(test.psnr_covered[-1], label="untouched, all that it covers", **everything)
    quality.set_title("PSNR of test views (dB, pixels pooled)")
    for values, colour, style, label in (
        (test.share_covered, BLUE, "-", "covered, of the pixels with matter (test)"),
        (test.share_floating, VERMILION, "--", "covered, of the empty pixels (test)"),
        (train.content_kept, ORANGE, "-.", "content kept (training)"),
    ):
        if np.isfinite(values).any():
            draw(share, values, colour, style, label)
    share.set_title("Shares")
    share.set_ylim(-0.03, 1.03)
    share.yaxis.set_major_formatter(PercentFormatter(1.0))
    share.set_xlabel("threshold on the uncertainty in [0, 1]; above it density is removed")
    for axes in (quality, share):
        if np.isfinite(chosen):
            axes.axvline(chosen, color=GREY, linewidth=1.2, zorder=1, label="chosen threshold")
        tidy(axes, "y")
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def views_figure(run: TrainedRun, cleaned: Callable, view_ids, threshold) -> Figure:
    """Test views before and after, and the opacity that went."""
    cameras, names = run.state.table.cameras, run.problem.scene.names
    images = render_views(
        cleaned([threshold, np.inf]),
        cameras,
        view_ids,
        chunk=RENDER_CHUNK,
        rays_per_pixel=run.config.rays_per_pixel,
    )
    rows = []
    for view, image in zip(view_ids, images):
        truth = run.truth(view)
        after, before = np.moveaxis(image["rgb"], 2, 0).clip(0.0, 1.0)
        lost = image["opacity"][:, :, 1] - image["opacity"][:, :, 0]
        panels = [
            Panel("truth", truth),
            Panel(f"before, {psnr_words(255.0 * before, 255.0 * truth)}", before),
            Panel(f"after, {psnr_words(255.0 * after, 255.0 * truth)}", after),
            Panel(f"opacity removed, mean {lost.mean():.3f}", lost),
        ]
        rows.append((names[view], panels))
    return panel_table(rows, scale_label="opacity removed")


if __name__ == "__main__":
    script.run_on_trained(clean_up)
