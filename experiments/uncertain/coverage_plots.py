"""How well calibrated intervals hold, and how wide they are, as inline SVG."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator

from experiments.report import plots
from experiments.uncertain.results import interval_values, known_quantities, models_of

SPREAD = 0.62  # of the distance between two levels that the models of one level fill
LABEL = {"fontsize": 10, "color": "#374151"}


def coverage_plot(rows: list[dict]) -> str:
    """Coverage less the nominal level, with two standard errors over test views; a panel each."""
    figure, panels = _panels(rows, 1)
    for (axes,), quantity in zip(panels.T, known_quantities(rows)):
        levels = rows[0]["intervals"][quantity]["levels"]
        num_views = rows[0]["intervals"][quantity]["num_calibration_views"]
        axes.axhline(0.0, color=plots.BLACK, linewidth=1.2, linestyle="--")
        axes.axhspan(-2.0, 2.0, color="#f1f5f9", zorder=0)
        for model, colour, marker, x in _positions(rows, levels):
            shares, errors = (
                interval_values(rows, model, quantity, key)
                for key in ("coverage", "coverage_stderr")
            )
            axes.errorbar(
                *(x, 100.0 * (shares.mean(0) - levels)),
                yerr=200.0 * np.nan_to_num(errors.mean(0)),
                color=colour,
                marker=marker,
                markersize=5.5,
                linestyle="none",
                elinewidth=1.4,
                capsize=2.5,
                label=model,
            )
        axes.set_title(f"{quantity}: coverage from {num_views} views", fontsize=10.5, loc="left")
        axes.set_xlabel("nominal level", **LABEL)
        _level_axis(axes, levels)
    panels[0, 0].set_ylabel("coverage − nominal (percentage points)", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="coverage", label="Coverage against the nominal level")


def width_plot(rows: list[dict]) -> str:
    """Mean width and interval score as shares of those of one width for all pixels."""
    figure, panels = _panels(rows, 2)
    names = (("width_ratio", "mean width"), ("score_ratio", "interval score"))
    for column, quantity in zip(panels.T, known_quantities(rows)):
        levels = rows[0]["intervals"][quantity]["levels"]
        for axes, (key, words) in zip(column, names):
            axes.axhline(1.0, color=plots.BLACK, linewidth=1.2, linestyle="--")
            top = 1.0
            for model, colour, marker, x in _positions(rows, levels):
                ratios = interval_values(rows, model, quantity, key)
                axes.plot(*(x, ratios.mean(0)), marker, color=colour, markersize=6, label=model)
                axes.vlines(x, ratios.min(0), ratios.max(0), color=colour, linewidth=1.4)
                top = np.nanmax([top, *ratios.ravel()])
            axes.set_title(f"{quantity}: {words}", fontsize=10.5, loc="left")
            axes.set_ylim(0.0, 1.08 * top)
            _level_axis(axes, levels)
        column[-1].set_xlabel("nominal level", **LABEL)
    for axes in panels[:, 0]:
        axes.set_ylabel("share of constant width's", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="width", label="Widths and interval scores")


def decile_plot(rows: list[dict], level: float) -> str:
    """Coverage at one level in each tenth of the pixels, from the least uncertain up."""
    figure, panels = _panels(rows, 1)
    style, tenths = plots.policy_style(models_of(rows)), np.arange(1, 11)
    for (axes,), quantity in zip(panels.T, known_quantities(rows)):
        row = int(np.argmin(np.abs(np.array(rows[0]["intervals"][quantity]["levels"]) - level)))
        axes.axhline(100.0 * level, color=plots.BLACK, linewidth=1.2, linestyle="--")
        first = models_of(rows)[0]
        constant = interval_values(rows, first, quantity, "constant_decile_coverage")
        axes.plot(
            *(tenths, 100.0 * constant.mean(0)[row]),
            color=plots.GREY,
            linestyle=":",
            linewidth=2.0,
            label=f"constant width, by {first}",
        )
        for model, (colour, marker) in style.items():
            shares = interval_values(rows, model, quantity, "decile_coverage").mean(0)[row]
            axes.plot(
                *(tenths, 100.0 * shares),
                color=colour,
                marker=marker,
                markersize=5,
                markeredgecolor="white",
                linewidth=1.6,
                label=model,
            )
        axes.set_title(
            f"{quantity}: coverage at {level:.0%} by uncertainty", fontsize=10.5, loc="left"
        )
        axes.set_xlabel("tenth of the pixels, least uncertain first", **LABEL)
        axes.xaxis.set_major_locator(FixedLocator(tenths))
        axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
        plots.tidy(axes)
    panels[0, 0].set_ylabel("coverage (%)", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="deciles", label="Coverage in each tenth of the pixels")


def _panels(rows: list[dict], num_rows: int):
    num = len(known_quantities(rows))
    figure = Figure(figsize=(5.3 * num, 0.7 + 3.1 * num_rows), layout="constrained")
    return figure, figure.subplots(num_rows, num, squeeze=False)


def _positions(rows: list[dict], levels):
    """Each model with colour, marker and where it stands beside the others at each level."""
    style = plots.policy_style(models_of(rows))
    for number, (model, (colour, marker)) in enumerate(style.items()):
        offset = SPREAD * ((number + 0.5) / len(style) - 0.5)
        yield model, colour, marker, np.arange(len(levels)) + offset


def _level_axis(axes, levels) -> None:
    axes.xaxis.set_major_locator(FixedLocator(range(len(levels))))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{level:.0%}" for level in levels]))
    axes.set_xlim(-0.5, len(levels) - 0.5)
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)


def _legend(figure, panels) -> None:
    handles, labels = panels[0, 0].get_legend_handles_labels()
    options = {"loc": "outside upper left", "ncols": 6, "frameon": False, "fontsize": 9}
    figure.legend(handles, labels, **options)
