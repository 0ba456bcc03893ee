"""Maps of the cameras seen from above the scene: candidates, scores and choices of each round."""

from __future__ import annotations

import math

import numpy as np
from markupsafe import Markup
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from experiments.reporting import plots
from experiments.reporting.results import Round

SCORE_MAP = "viridis"
UNSCORED = "#b6bcc6"
COLUMNS = 4
DISTANCE_SPREAD = 0.2  # of the median: beyond this the distances get a panel of their own


def equal_area(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Lambert's azimuthal equal-area projection about `up`: equal areas stay equal.

    `rho = 2 sin(theta / 2)` with `theta` the angle from `up`, so the pole is the middle, the
    horizon the circle of radius sqrt(2), and the nadir the one of radius 2.

    Args:
      directions: [N, 3] from the scene's centre to each camera, any length but 0.
      up: [3] the pole.

    Returns:
      [N, 2] to the right and to the top, as seen by someone above who looks down.
    """
    right, top, up = _axes(up)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    theta = np.arccos(np.clip(unit @ up, -1.0, 1.0))
    azimuth = np.arctan2(unit @ top, unit @ right)
    rho = 2.0 * np.sin(theta / 2.0)
    return np.stack([rho * np.cos(azimuth), rho * np.sin(azimuth)], axis=-1)


def _axes(up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, top and towards the viewer; right is the world's x, or z where `up` is along x."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    right = np.array([0.0, 0.0, 1.0] if abs(up[0]) > 0.9 else [1.0, 0.0, 0.0])
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return right, np.cross(up, right), up


def map_plot(acquisition: dict[str, np.ndarray], rounds: list[Round], *, salt: str) -> Markup:
    """One small map per round, with the distances below where cameras do not keep theirs.

    Args:
      acquisition: arrays of `acquisition.npz`.
      rounds: from `make_rounds`; none gives a map of the initial views.
      salt: makes the ids of the SVG unique on the page.
    """
    offsets = np.asarray(acquisition["positions"], float) - np.asarray(acquisition["centre"], float)
    initial = np.asarray(acquisition["initial"], int)
    shown = np.union1d(acquisition["pool"], initial).astype(int)
    distances = np.linalg.norm(offsets, axis=-1)
    # A camera in the very centre has no direction; it is drawn at the pole.
    offsets[distances == 0.0] = acquisition["up"]
    points = equal_area(offsets, acquisition["up"])
    scores = np.concatenate([r.scores[np.isfinite(r.scores)] for r in rounds] or [np.zeros(0)])
    # One colour scale for all rounds, or none if nothing was scored.
    norm = Normalize(*np.percentile(scores, [1.0, 99.0])) if scores.size else None
    num_maps = max(len(rounds), 1)
    columns = min(num_maps, COLUMNS)
    map_rows = math.ceil(num_maps / columns)
    spread = np.ptp(distances[shown]) > DISTANCE_SPREAD * np.median(distances[shown])
    heights = [2.95] * map_rows + [1.7] * bool(spread)
    figure = Figure(figsize=(2.65 * COLUMNS, sum(heights) + 0.45))
    grid = figure.add_gridspec(len(heights), COLUMNS, height_ratios=heights)
    all_axes = [figure.add_subplot(grid[i // columns, i % columns]) for i in range(num_maps)]
    for i, axes in enumerate(all_axes):
        _draw_sky(axes, points[shown])
        _draw_candidates(axes, points, rounds[i : i + 1], acquisition, norm)
        _draw_initial(axes, points[initial])
        for earlier in rounds[:i]:
            _draw_numbers(axes, points[earlier.selected], earlier.number, "#374151")
        if rounds:
            _draw_chosen(axes, points, rounds[i], norm)
        title = f"Round {rounds[i].number}" if rounds else "Initial views"
        axes.set_title(title, fontsize=10)
    if spread:
        # Distance from the centre against azimuth, as the map from above cannot show it.
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        where = np.stack([azimuth, distances], axis=-1)
        axes = figure.add_subplot(grid[map_rows, :])
        _draw_candidates(axes, where, rounds[-1:], acquisition, norm)
        _draw_initial(axes, where[initial])
        for one in rounds:
            _draw_numbers(axes, where[one.selected], one.number, plots.VERMILION)
        axes.set_ylim(0.0, 1.08 * distances.max())
        if np.ptp(azimuth) > 180.0:
            axes.set_xlim(-185, 185)
            axes.set_xticks(range(-180, 181, 60))
        axes.set_xlabel("azimuth (degrees)", fontsize=9)
        axes.set_ylabel("distance\n(scene units)", fontsize=9)
        when = ", after the last round" if rounds else ""
        axes.set_title(f"Distance from the scene's centre{when}", fontsize=10)
        plots.tidy(axes)
    if norm is not None:
        place = {"ax": all_axes, "shrink": 0.8, "pad": 0.01, "aspect": 30}
        bar = figure.colorbar(ScalarMappable(norm, SCORE_MAP), **place)
        bar.set_label("score", fontsize=9)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_visible(False)
    _legend(figure, rounds, norm)
    return plots.to_svg(figure, salt=salt, label="Map of cameras from above, one per round")


def _draw_sky(axes: Axes, shown: np.ndarray) -> None:
    """Circles of equal elevation, and limits that hold every camera."""
    reach = np.linalg.norm(shown, axis=-1).max()
    low, high = shown.min(axis=0), shown.max(axis=0)
    middle, half = np.zeros(2), 1.14 * max(reach, math.sqrt(2.0))
    # Cameras on one side only (a capture that faces forward): look closer at that side.
    if (high - low).max() < 0.9 * math.sqrt(2.0):
        middle, half = (low + high) / 2.0, 0.62 * max((high - low).max(), 0.05)
    for elevation in (60, 30, 0):
        radius = 2.0 * math.sin(math.radians(90 - elevation) / 2.0)
        edge = {"linewidth": 1.1 if elevation == 0 else 0.6, "edgecolor": plots.PALE}
        axes.add_patch(Circle((0, 0), radius, facecolor="none", zorder=0, **edge))
        name = "horizon" if elevation == 0 else f"{elevation}°"
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}
        look = {"fontsize": 6.5, "color": "#8b93a1", "ha": "center", "va": "center", "bbox": box}
        axes.text(0, -radius, name, clip_on=True, zorder=0.5, **look)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _draw_initial(axes: Axes, points: np.ndarray) -> None:
    axes.scatter(*points.T, s=34, marker="^", color="black", edgecolors="white", zorder=5)


def _draw_candidates(axes: Axes, points, rounds: list[Round], acquisition, norm) -> None:
    """Candidates coloured by score; those the distance filter took away are small and pale.

    Without a round, all of the pool but the initial views.
    """
    if not rounds:
        pool = np.setdiff1d(acquisition["pool"], acquisition["initial"]).astype(int)
        axes.scatter(*points[pool].T, s=16, color=UNSCORED, linewidths=0)
        return
    (this,) = rounds
    scored = np.isfinite(this.scores)
    for kept, size, alpha in ((False, 11, 0.5), (True, 26, 1.0)):
        for has_score in (False, True):
            rows = (this.survives == kept) & (scored == has_score)
            if rows.any():
                colours = _colours(this.scores[rows], norm) if has_score else UNSCORED
                look = {"s": size, "alpha": alpha, "linewidths": 0, "zorder": 2 + kept}
                axes.scatter(*points[this.candidates[rows]].T, c=colours, **look)


def _draw_chosen(axes: Axes, points, this: Round, norm) -> None:
    """The views of this round, ringed and with its number."""
    chosen = points[this.selected]
    scores = this.selected_scores
    face = [_colours(s, norm) if norm is not None and np.isfinite(s) else "white" for s in scores]
    look = {"edgecolors": plots.VERMILION, "linewidths": 2.2, "zorder": 7}
    axes.scatter(*chosen.T, s=70, c=face or None, **look)
    for x, y in chosen:
        look = {"fontsize": 8.5, "fontweight": "bold", "color": plots.VERMILION, "zorder": 8}
        place = {"xytext": (5.5, 4.5), "textcoords": "offset points"}
        text = axes.annotate(str(this.number), (x, y), **place, **look)
        text.set_path_effects([patheffects.withStroke(linewidth=2.2, foreground="white")])


def _colours(scores, norm: Normalize):
    return ScalarMappable(norm, SCORE_MAP).to_rgba(scores)


def _draw_numbers(axes: Axes, points: np.ndarray, number: int, colour: str) -> None:
    axes.scatter(*points.T, s=62, color="#e5e7eb", edgecolors=colour, linewidths=0.8, zorder=6)
    for x, y in points:
        look = {"fontsize": 6.5, "color": colour, "ha": "center", "va": "center_baseline"}
        axes.text(x, y, str(number), zorder=6.5, **look)


def _legend(figure: Figure, rounds: list[Round], norm: Normalize | None) -> None:
    fill = UNSCORED if norm is None else "#35b779"
    initial = {"marker": "^", "markerfacecolor": "black", "markersize": 7}
    candidate = {"markerfacecolor": fill, "markersize": 5.5}
    marks = {"initial view": initial, "candidate": candidate}
    if any((~r.survives).any() for r in rounds):
        small = {"markerfacecolor": fill, "markersize": 3.3, "alpha": 0.5}
        marks["taken away by the distance filter"] = small
    if rounds:
        ring = {"markeredgecolor": plots.VERMILION, "markeredgewidth": 2}
        chosen = {"markerfacecolor": "white", "markersize": 8, **ring}
        marks["chosen in this round"] = chosen
    if len(rounds) > 1:
        before = {"markerfacecolor": "#e5e7eb", "markersize": 8, "markeredgecolor": "#374151"}
        marks["chosen before, with its round"] = before
    dot = {"marker": "o", "markeredgecolor": "none", "linestyle": "none"}
    handles = [Line2D([], [], label=label, **(dot | style)) for label, style in marks.items()]
    place = {"loc": "outside lower left", "ncols": len(marks), "handletextpad": 0.3}
    figure.legend(handles=handles, fontsize=8.5, **place)
