"""Figures of a suggestion: a plan of the place, and what is left to gain after each pick."""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from bavs_jax.selection.worth import Worth
from experiments.report import plots
from experiments.report.camera_map import SCORE_MAP

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


def place_plot(*, axes, unit, focus, photos, candidates, scores, selected, route_start) -> str:
    """The place from above and from the side.

    Args:
      axes: [3, 3] from `levelled_axes`.
      unit: user units per scene unit.
      focus: [3] the origin of the plot.
      photos: [V, 3, 4] poses, scene units.
      candidates: [C, 3, 4].
      scores: [C].
      selected: [k] candidates in the order of the files.
      route_start: [3] scene units, where the route through them begins; None: it is not drawn.
    """
    figure = Figure(figsize=(10.6, 4.9), layout="constrained")
    above, side = figure.subplots(1, 2)
    norm = Normalize(*np.percentile(scores, [1.0, 99.0]))
    for panel, rows, title, upwards in (
        (above, axes[:2], "From above", "away from the photos"),
        (side, axes[[0, 2]], "From behind the photos", "up"),
    ):

        def flat(points, rows=rows):
            return (unit * (np.asarray(points, np.float64) - focus) @ rows.T).T

        places = flat(candidates[:, :, 3])
        panel.scatter(
            *places, c=scores, cmap=SCORE_MAP, norm=norm, s=15, alpha=0.75, lw=0, label="candidate"
        )
        places, gaze = flat(photos[:, :, 3]), -rows @ photos[:, :, 2].T
        seen = "photo, and where it looks"
        panel.scatter(*places, marker="^", s=22, color=PHOTO, lw=0, zorder=3, label=seen)
        line = {"headwidth": 0, "headlength": 0, "headaxislength": 0}
        panel.quiver(*places, *gaze, color=PHOTO, alpha=0.35, scale=26, width=0.0022, **line)
        looked_at = "what the photos look at"
        panel.scatter(0.0, 0.0, marker="+", s=90, color=plots.BLACK, zorder=3, label=looked_at)
        chosen = candidates[selected]
        places, gaze = flat(chosen[:, :, 3]), -rows @ chosen[:, :, 2].T
        red = plots.VERMILION
        panel.quiver(*places, *gaze, color=red, scale=17, width=0.0045, headwidth=3.4, zorder=5)
        label = "chosen pose, in the order of the files"
        ring = {"c": "white", "edgecolors": red, "linewidths": 1.6}
        panel.scatter(*places, s=150, zorder=6, label=label, **ring)
        for number, place in enumerate(places.T, start=1):
            text = {"color": red, "fontsize": 8, "fontweight": "bold", "ha": "center"}
            panel.text(*place, str(number), va="center_baseline", zorder=7, **text)
        if route_start is not None:
            stops = flat(np.concatenate([np.asarray(route_start)[None], chosen[:, :, 3]]))
            panel.plot(*stops, color=red, linewidth=1.0, zorder=4, alpha=0.7, label="route")
            panel.scatter(*stops[:, :1], marker="s", s=40, color=plots.BLACK, zorder=5)
        panel.set_title(title, fontsize=10, loc="left")
        panel.set_xlabel("to the right (user units)", fontsize=9)
        panel.set_ylabel(upwards, fontsize=9)
        panel.set_aspect("equal", adjustable="datalim")
        plots.tidy(panel)
    bar = figure.colorbar(ScalarMappable(norm, SCORE_MAP), ax=[above, side], shrink=0.8, pad=0.01)
    bar.set_label("score: mean uncertainty of the render", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower left", ncols=len(labels), frameon=False, fontsize=8.5
    )
    return plots.to_svg(figure, salt="place", label="Photos, candidates and chosen poses")


def worth_plot(worth: Worth, photo_gain: float) -> str:
    """What each pick and the best candidate left tell, as shares of the best one's at first."""
    first = float(worth.best_left[0])
    figure = Figure(figsize=(6.4, 3.7), layout="constrained")
    axes = figure.add_subplot()
    picks = np.arange(len(worth.picked) + 1)
    label = "best candidate left after that many picks"
    axes.plot(picks, worth.best_left / first, "o-", color=plots.BLUE, label=label)
    label = "each pick, after those before"
    axes.plot(picks[1:], worth.picked / first, "s-", color=plots.VERMILION, label=label)
    label = "another photo from where there is one"
    axes.axhline(photo_gain / first, color=plots.GREY, linestyle="--", label=label)
    axes.set_xlabel("picks", fontsize=10)
    title = "Information, as a share of the best candidate's at first"
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_ylim(0.0, None)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8.5, loc="lower left")
    return plots.to_svg(figure, salt="worth", label="Worth of the best candidate left")
