"""Figures of a suggestion: a plan of the place, and what is left to gain after each pick."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter

from bavs_jax.selection.worth import Worth
from experiments.reporting import plots
from experiments.reporting.camera_map import SCORE_MAP

PHOTO = "#6b7280"


def levelled_axes(up, photo_positions, focus) -> np.ndarray:
    """Rows right, ahead, up [3, 3]: ahead is where the photos look in the mean, levelled."""
    up = np.asarray(up, np.float64)
    ahead = focus - np.asarray(photo_positions, np.float64).mean(axis=0)
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.eye(3)[np.argmin(np.abs(up))]
        ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead, up])


def place_plot(*, axes, unit, focus, photos, candidates, scores, selected, order, start) -> str:
    """The place from above and from the side.

    Args:
      axes: [3, 3] from `levelled_axes`.
      unit: user units per scene unit.
      focus: [3] the origin of the plot.
      photos: [V, 3, 4] poses, scene units.
      candidates: [C, 3, 4].
      scores: [C].
      selected: [k] candidates in the order of the files.
      order: whether to draw the route through them.
      start: [3] scene units, where the route begins, or None.
    """
    figure = Figure(figsize=(10.6, 4.9), layout="constrained")
    above, side = figure.subplots(1, 2)
    norm = Normalize(*np.percentile(scores, [1.0, 99.0]))
    for panel, rows, title in (
        (above, axes[:2], "From above"),
        (side, axes[[0, 2]], "From behind the photos"),
    ):

        def flat(points, rows=rows):
            return unit * (np.asarray(points, np.float64) - focus) @ rows.T

        _draw_place(panel, flat, rows, photos, candidates, scores, selected, norm)
        if order:
            stops = candidates[selected][:, :, 3]
            stops = stops if start is None else np.concatenate([np.asarray(start)[None], stops])
            panel.plot(*flat(stops).T, color=plots.VERMILION, linewidth=1.0, zorder=4, alpha=0.7)
            panel.scatter(*flat(stops[:1]).T, marker="s", s=40, color=plots.BLACK, zorder=5)
        panel.set_title(title, fontsize=10, loc="left")
        panel.set_aspect("equal", adjustable="datalim")
        plots.tidy(panel)
    above.set_xlabel("to the right (user units)", fontsize=9)
    above.set_ylabel("away from the photos", fontsize=9)
    side.set_xlabel("to the right (user units)", fontsize=9)
    side.set_ylabel("up", fontsize=9)
    bar = figure.colorbar(ScalarMappable(norm, SCORE_MAP), ax=[above, side], shrink=0.8, pad=0.01)
    bar.set_label("score: mean uncertainty of the render", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    _legend(figure, order)
    return plots.to_svg(figure, salt="place", label="Photos, candidates and chosen poses")


def _draw_place(panel: Axes, flat, rows, photos, candidates, scores, selected, norm) -> None:
    panel.scatter(
        *flat(candidates[:, :, 3]).T,
        c=scores,
        cmap=SCORE_MAP,
        norm=norm,
        s=15,
        alpha=0.75,
        linewidths=0,
        zorder=2,
    )
    points = flat(photos[:, :, 3])
    panel.scatter(*points.T, marker="^", s=22, color=PHOTO, linewidths=0, zorder=3)
    gaze = -photos[:, :, 2] @ rows.T
    panel.quiver(
        *points.T,
        *gaze.T,
        color=PHOTO,
        alpha=0.35,
        scale=26,
        width=0.0022,
        headwidth=0,
        headlength=0,
        headaxislength=0,
        zorder=1.5,
    )
    panel.scatter(0.0, 0.0, marker="+", s=90, color=plots.BLACK, linewidths=1.4, zorder=3)
    chosen = candidates[selected]
    points, gaze = flat(chosen[:, :, 3]), -chosen[:, :, 2] @ rows.T
    panel.quiver(
        *points.T,
        *gaze.T,
        color=plots.VERMILION,
        scale=17,
        width=0.0045,
        headwidth=3.4,
        zorder=5,
    )
    panel.scatter(
        *points.T,
        s=150,
        c="white",
        edgecolors=plots.VERMILION,
        linewidths=1.6,
        zorder=6,
    )
    for number, (x, y) in enumerate(points, start=1):
        panel.text(
            x,
            y,
            str(number),
            fontsize=8,
            fontweight="bold",
            color=plots.VERMILION,
            ha="center",
            va="center_baseline",
            zorder=7,
        )


def _legend(figure: Figure, order: bool) -> None:
    def mark(label, **style):
        return Line2D([], [], linestyle="none", markeredgecolor="none", label=label, **style)

    ring = {"marker": "o", "markerfacecolor": "white", "markersize": 9}
    marks = [
        mark("photo, and where it looks", marker="^", markerfacecolor=PHOTO, markersize=6),
        mark("candidate", marker="o", markerfacecolor="#35b779", markersize=5),
        Line2D(
            [],
            [],
            linestyle="none",
            markeredgecolor=plots.VERMILION,
            markeredgewidth=1.6,
            label="chosen pose, in the order of the files",
            **ring,
        ),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="+",
            markersize=9,
            color=plots.BLACK,
            label="what the photos look at",
        ),
    ]
    if order:
        marks.append(Line2D([], [], color=plots.VERMILION, linewidth=1.0, label="route"))
    figure.legend(
        handles=marks,
        loc="outside lower left",
        ncols=len(marks),
        frameon=False,
        fontsize=8.5,
        handletextpad=0.5,
    )


def worth_plot(worth: Worth, photo_gain: float) -> str:
    """What each pick and the best candidate left tell, as shares of the best one's at first."""
    first = float(worth.best_left[0])
    figure = Figure(figsize=(6.4, 3.7), layout="constrained")
    axes = figure.add_subplot()
    num = len(worth.picked)
    curve = {"markersize": 5, "markeredgecolor": "white"}
    axes.plot(
        np.arange(num + 1),
        worth.best_left / first,
        **{**curve, "color": plots.BLUE, "marker": "o", "linewidth": 2.0},
        label="best candidate left after that many picks",
    )
    axes.plot(
        np.arange(1, num + 1),
        worth.picked / first,
        **{**curve, "color": plots.VERMILION, "marker": "s", "linewidth": 1.2},
        label="each pick, after those before",
    )
    axes.axhline(
        photo_gain / first,
        color=plots.GREY,
        linewidth=1.2,
        linestyle="--",
        label="another photo from where there is one",
    )
    axes.set_xlabel("picks", fontsize=10, color="#374151")
    axes.set_title(
        "Information, as a share of the best candidate's at first", fontsize=10.5, loc="left"
    )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    axes.set_ylim(0.0, None)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8.5, loc="lower left")
    return plots.to_svg(figure, salt="worth", label="Worth of the best candidate left")
