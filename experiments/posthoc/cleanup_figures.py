"""Figures of a clean-up: the sweep over thresholds, and views before and after."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bavs_jax.metrics.covered import Sweep
from experiments.report.panels import Panel, panel_table
from experiments.report.plots import BLUE, GREEN, GREY, ORANGE, VERMILION, tidy


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
