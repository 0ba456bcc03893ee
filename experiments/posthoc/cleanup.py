"""Clean-up of a field: the sweep over thresholds, its results and their figures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bavs_jax.fields.deformation import offset_unit
from bavs_jax.metrics.covered import Sweep, pixel_sums, sweep_of
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.cleanup import make_cleaned_render_fn, threshold_sigma
from experiments.build import RENDER_CHUNK
from experiments.progress import track
from experiments.report.panels import Panel, panel_table
from experiments.report.plots import BLUE, GREEN, GREY, ORANGE, VERMILION, tidy
from experiments.trained import TrainedRun


def make_cleaned_chunk_fn(run: TrainedRun, variance) -> Callable:
    """Makes `cleaned(thresholds [T]) -> (Rays [chunk] -> dict)` of a run's field."""
    tools = run.toolbox
    render = make_cleaned_render_fn(
        tools.model,
        tools.grid,
        variant=tools.laplace.variant,
        extent=tools.laplace.extent,
    )
    train = run.state.train

    def cleaned(thresholds):
        thresholds = jnp.asarray(thresholds, jnp.float32)
        return partial(render, train.model, variance, thresholds)

    return cleaned


def sweep_views(
    cleaned: Callable, run: TrainedRun, view_ids, thresholds, *, min_opacity: float, label: str
) -> Sweep:
    """Measures of views for all thresholds; pixels that the scene masks do not count.

    Args:
      cleaned: from `make_cleaned_chunk_fn`.
      run: the run.
      view_ids: [n] rows of the pixel table.
      thresholds: [T] ascending, the last +inf.
      min_opacity: from which on a pixel is covered.
      label: for progress.
    """
    table, sums = run.state.table, []
    offsets = np.asarray(table.offsets)
    total = int(np.diff(offsets)[view_ids].sum())
    chunk_fn = cleaned(thresholds)
    with track(total, f"{run.label}: {label}", "rays") as bar:
        # One view at a time: its images at every threshold are T times as large as the view.
        for view in view_ids:
            (images,) = render_views(
                chunk_fn, table.cameras, [view], chunk=RENDER_CHUNK, progress_fn=bar.advance
            )
            mask = run.pixel_mask(view)
            counted = {name: value[mask] for name, value in images.items()}
            sums.append(
                pixel_sums(
                    counted,
                    run.truth(view)[mask],
                    background=run.toolbox.model.background,
                    min_opacity=min_opacity,
                )
            )
    return sweep_of(thresholds, sums)


def summary(run: TrainedRun, sweeps: dict[str, Sweep], row: int, options: dict) -> dict:
    """What one run reports; a measure that no pixel has is null, and so is `+inf`.

    Args:
      run: the run that was cleaned.
      sweeps: "training" and "test".
      row: of the chosen threshold.
      options: of the choice and the measures.
    """
    thresholds = sweeps["test"].thresholds
    laplace, unit = run.toolbox.laplace, float(offset_unit(run.problem.scene.box))
    return {
        "options": {**options, "variant": laplace.variant, "extent": laplace.extent},
        "chosen": {
            "threshold": _number(thresholds[row]),
            "sigma": _number(threshold_sigma(thresholds[row], unit)),  # scene units
        },
        "before": {name: _measures(sweep, -1) for name, sweep in sweeps.items()},
        "after": {name: _measures(sweep, row) for name, sweep in sweeps.items()},
        "sweep": {
            name: {key: [_number(x) for x in value] for key, value in sweep._asdict().items()}
            for name, sweep in sweeps.items()
        },
    }


def in_words(row: dict) -> str:
    """What the clean-up of a run is worth on test views, in one line."""
    if row["chosen"]["threshold"] is None:
        return "nothing was removed: every threshold costs more of the training views than allowed"
    before, after = row["before"]["test"], row["after"]["test"]
    parts = []
    if after["psnr_covered"] is not None:
        parts.append(
            f"PSNR over still-covered pixels {after['psnr_covered_before']:.2f} -> "
            f"{after['psnr_covered']:.2f} dB"
        )
    parts.append(f"over all {before['psnr']:.2f} -> {after['psnr']:.2f} dB")
    shares = (("covered", "share_covered"), ("empty pixels covered", "share_floating"))
    parts += [
        f"{name} {before[key]:.1%} -> {after[key]:.1%}"
        for name, key in shares
        if before[key] is not None
    ]
    return f"threshold {row['chosen']['threshold']:.3f}: {', '.join(parts)}"


def _measures(sweep: Sweep, row: int) -> dict[str, float | None]:
    names = [name for name in Sweep._fields if name != "thresholds"]
    return {name: _number(getattr(sweep, name)[row]) for name in names}


def _number(value) -> float | None:
    return float(value) if np.isfinite(value) else None


def sweep_figure(train: Sweep, test: Sweep, row: int) -> Figure:
    """PSNR and coverage of test views against the threshold; the chosen one is marked.

    Args:
      train, test: over the same thresholds.
      row: of the chosen one.
    """
    figure = Figure(figsize=(8.6, 5.8), layout="constrained")
    quality, share = figure.subplots(2, 1, sharex=True)
    finite = test.thresholds[:-1]
    for values, colour, style, label in (
        (test.psnr_covered, BLUE, "-", "cleaned, covered pixels"),
        (test.psnr_covered_before, VERMILION, "--", "untouched, the same pixels"),
        (test.psnr, GREEN, ":", "cleaned, all pixels"),
    ):
        _curve(quality, finite, values[:-1], colour, style, label)
    everything = {"color": GREY, "linewidth": 0.9, "linestyle": "-.", "zorder": 1}
    quality.axhline(test.psnr_covered[-1], label="untouched, all that it covers", **everything)
    quality.set_title("PSNR of test views (dB, pixels pooled)", fontsize=10.5, loc="left")
    for values, colour, style, label in (
        (test.share_covered, BLUE, "-", "covered, of the pixels with matter (test)"),
        (test.share_floating, VERMILION, "--", "covered, of the empty pixels (test)"),
        (train.content_kept, ORANGE, "-.", "content kept (training)"),
    ):
        if np.isfinite(values).any():
            _curve(share, finite, values[:-1], colour, style, label)
    share.set_title("Shares", fontsize=10.5, loc="left")
    share.set_ylim(-0.03, 1.03)
    share.yaxis.set_major_formatter(PercentFormatter(1.0))
    share.set_xlabel("threshold on the uncertainty in [0, 1]; above it density is removed")
    for axes in (quality, share):
        chosen = test.thresholds[row]
        if np.isfinite(chosen):
            axes.axvline(chosen, color=GREY, linewidth=1.2, zorder=1, label="chosen threshold")
        axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
        tidy(axes)
        axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _curve(axes: Axes, x, y, colour: str, style: str, label: str) -> None:
    # An exactly right render has no finite PSNR; the curve has a gap there.
    y = np.where(np.isfinite(y), y, np.nan)
    options = {"linewidth": 1.8, "marker": "o", "markersize": 3.0, "zorder": 2}
    axes.plot(x, y, color=colour, linestyle=style, label=label, **options)


def views_figure(views: list[dict]) -> Figure:
    """Test views before and after, and the opacity that went.

    Args:
      views: of each, its `name`, `truth` [H, W, 3], and `rgb` [H, W, 2, 3] and `opacity`
        [H, W, 2] at the chosen threshold and untouched.
    """
    rows = []
    for view in views:
        after, before = view["rgb"][:, :, 0], view["rgb"][:, :, 1]
        lost = view["opacity"][:, :, 1] - view["opacity"][:, :, 0]
        panels = [
            Panel("truth", view["truth"]),
            Panel(f"before, {_psnr(before, view['truth'])}", before),
            Panel(f"after, {_psnr(after, view['truth'])}", after),
            Panel(f"opacity removed, mean {lost.mean():.3f}", lost),
        ]
        rows.append((view["name"], panels))
    return panel_table(rows, scale_label="opacity removed")


def _psnr(rgb: np.ndarray, truth: np.ndarray) -> str:
    mse = np.square(np.clip(rgb, 0.0, 1.0) - truth).mean()
    return "identical" if mse == 0.0 else f"{-10.0 * np.log10(mse):.2f} dB"
