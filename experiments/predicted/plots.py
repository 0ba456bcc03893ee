"""Predicted against realised gains as inline SVG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.predicted.analysis import fit_line
from experiments.predicted.cases import PREDICTORS, Case, known
from experiments.report import plots


def gain_plot(cases: Sequence[Case], name: str) -> str:
    """Each batch as a point, scenes by colour, rounds by marker, and the line through all.

    Args:
      cases: the batches.
      name: a key of `PREDICTORS`.
    """
    words, unit = PREDICTORS[name]
    rest, predicted, realised = known(cases, name)
    scenes = list(dict.fromkeys(case.scene for case in rest))
    rounds = sorted({case.round for case in rest})
    colours = dict(zip(scenes, (plots.POLICY_COLOURS * len(scenes))[: len(scenes)]))
    markers = dict(zip(rounds, (plots.POLICY_MARKERS * len(rounds))[: len(rounds)]))
    figure = Figure(figsize=(5.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for scene in scenes:
        for number in rounds:
            mine = [i for i, c in enumerate(rest) if (c.scene, c.round) == (scene, number)]
            axes.scatter(
                *(predicted[mine], realised[mine]),
                color=colours[scene],
                marker=markers[number],
                s=34,
                alpha=0.8,
                edgecolor="white",
                linewidth=0.6,
                zorder=3,
            )
    intercept, slope = fit_line(predicted, realised)
    ends = np.array([predicted.min(), predicted.max()])
    axes.plot(ends, intercept + slope * ends, color=plots.GREY, linewidth=1.2, zorder=2)
    axes.axhline(0.0, color=plots.PALE, linewidth=0.8, zorder=1)
    axes.set_xlabel(f"predicted ({unit})", fontsize=10, color="#374151")
    axes.set_ylabel("realised, PSNR of test views (dB)", fontsize=10, color="#374151")
    axes.set_title(words, fontsize=10.5, loc="left")
    axes.grid(color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    point = {"linestyle": "none", "markeredgecolor": "white", "markersize": 7}
    handles = [Line2D([], [], color=colours[s], marker="o", label=s, **point) for s in scenes]
    handles += [
        Line2D([], [], color=plots.GREY, marker=markers[n], label=f"batch {n}", **point)
        for n in rounds
    ]
    axes.legend(handles=handles, frameon=False, fontsize=8.5)
    return plots.to_svg(figure, salt=f"gain-{name}", label=f"Realised gain against {words}")
