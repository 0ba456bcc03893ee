"""Maps of the cameras seen from above the scene: candidates, scores and choices of each round."""

import math

import numpy as np
from markupsafe import Markup
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from experiments.reporting import plots
from experiments.reporting.pictures import colour_bar

SCORE_MAP = "viridis"
COLOURS = colormaps[SCORE_MAP].with_extremes(bad="#b6bcc6")  # of a candidate without a score
COLUMNS = 4
WITHIN = 1.0 / 3.0  # of the median distance from the centre; on an orbit all are about as far


def equal_area(directions: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Lambert's azimuthal equal-area projection about `up`: equal areas stay equal.

    `rho = 2 sin(theta / 2)` with `theta` the angle from `up`, so the pole is the middle, the
    horizon the circle of radius sqrt(2), and the nadir the one of radius 2.

    Args:
      directions: [N, 3] from the scene's centre to each camera, any length but 0.
      up: [3] the pole.

    Returns:
      [N, 2] to the right and to the top, as seen by someone above who looks down. Right is the
      world's x, or z where `up` is along x.
    """
    up = np.asarray(up, float) / np.linalg.norm(up)
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    # 2 sin(theta / 2) / sin(theta), which is not known at the nadir itself
    scale = np.sqrt(2.0 / np.maximum(1.0 + unit @ up, 1e-12))
    return scale[:, None] * plan(unit, up)


def plan(offsets: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Places as on a floor plan, [N, 2] to the right and to the top, axes as of `equal_area`.

    Args:
      offsets: [N, 3] from the scene's centre, any unit.
      up: [3] towards who looks down.
    """
    up = np.asarray(up, float) / np.linalg.norm(up)
    right = np.array([0.0, 0.0, 1.0] if abs(up[0]) > 0.9 else [1.0, 0.0, 0.0])
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return offsets @ np.stack([right, np.cross(up, right)], axis=-1)


def stand_within(offsets: np.ndarray) -> bool:
    """Whether some cameras [N, 3] are much nearer to the centre than most: then their directions
    from it say little of where they are."""
    distances = np.linalg.norm(offsets, axis=-1)
    return bool(distances.min() < WITHIN * np.median(distances))


def map_plot(acquisition: dict[str, np.ndarray], *, salt: str) -> Markup:
    """One small map per round, on one scale of colours; without a round, of the initial views.

    `acquisition` are the arrays of `acquisition.npz`; `salt` makes ids unique on the page.
    """
    offsets = acquisition["positions"].astype(float) - acquisition["centre"]
    # A camera in the very centre has no direction; it is drawn at the pole.
    offsets[np.linalg.norm(offsets, axis=-1) == 0.0] = acquisition["up"]
    is_within = stand_within(offsets)
    points = (plan if is_within else equal_area)(offsets, acquisition["up"])
    pool, initial = (acquisition[name].astype(int) for name in ("pool", "initial"))
    chosen = [row[row >= 0] for row in acquisition["selected"]]  # -1 fills a round of fewer
    known = acquisition["scores"][np.isfinite(acquisition["scores"])]
    norm = Normalize(*(np.percentile(known, [1.0, 99.0]) if known.size else (0.0, 1.0)))
    num = max(len(chosen), 1)
    figure = Figure(figsize=(2.65 * COLUMNS, 2.95 * math.ceil(num / COLUMNS) + 0.45))
    grid = figure.add_gridspec(math.ceil(num / COLUMNS), min(num, COLUMNS))
    panels = [figure.add_subplot(grid[divmod(i, COLUMNS)]) for i in range(num)]
    for i, axes in enumerate(panels):
        _set_limits(axes, points[np.union1d(pool, initial)])
        if not is_within:
            _draw_sky(axes)
        axes.set_title(f"Round {i + 1}" if chosen else "Initial views", fontsize=10)
        look = {"marker": "^", "edgecolors": "white", "zorder": 5, "label": "initial view"}
        axes.scatter(*points[initial].T, 34, "black", **look)
        free = np.setdiff1d(pool, np.concatenate([initial, *chosen[:i]]))
        scores, kept = np.full(len(points), np.nan), np.ones(len(points), bool)
        if chosen:
            scores, kept = acquisition["scores"][i], acquisition["survivors"][i].astype(bool)
        colours = {"cmap": COLOURS, "norm": norm, "plotnonfinite": True}
        for views, size, alpha, name in (
            (free[~kept[free]], 11, 0.5, "taken away by the distance filter"),
            (free[kept[free]], 26, 1.0, "candidate"),
        ):
            if views.size:
                look = {"alpha": alpha, "linewidths": 0, "label": name, **colours}
                axes.scatter(*points[views].T, size, scores[views], **look)
        for number, views in enumerate(chosen[:i], start=1):
            name = "chosen before, with its round" if number == 1 else None
            look = {"edgecolors": plots.GREY, "zorder": 6, "label": name}
            axes.scatter(*points[views].T, 62, "#e5e7eb", **look)
            _write_number(axes, points[views], number, "#374151")
        for views in chosen[i : i + 1]:
            look = {"edgecolors": plots.VERMILION, "linewidths": 2.2, "zorder": 7, **colours}
            axes.scatter(*points[views].T, 70, scores[views], label="chosen in this round", **look)
            _write_number(axes, points[views], i + 1, plots.VERMILION, (8.0, 7.0))
    if known.size:
        colour_bar(figure, panels, SCORE_MAP, (norm.vmin, norm.vmax), "score")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower left", ncols=5)
    return plots.to_svg(figure, salt=salt, label="Map of cameras from above, one per round")


def _draw_sky(axes: Axes) -> None:
    """Circles of equal elevation, 60, 30 and 0 degrees."""
    for elevation in (60, 30, 0):
        radius = 2.0 * math.sin(math.radians(90 - elevation) / 2.0)
        edge = {"linewidth": 0.6 if elevation else 1.2, "edgecolor": plots.PALE, "zorder": 0}
        axes.add_patch(Circle((0, 0), radius, facecolor="none", **edge))


def _set_limits(axes: Axes, shown: np.ndarray) -> None:
    """Limits that hold every camera, one scale for both axes."""
    low, high = shown.min(axis=0), shown.max(axis=0)
    middle, half = (low + high) / 2.0, 0.6 * max((high - low).max(), 0.1)
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _write_number(axes: Axes, points, number: int, colour: str, offset=(0.0, 0.0)) -> None:
    for point in points:
        place = {"xytext": offset, "textcoords": "offset points", "ha": "center", "va": "center"}
        text = axes.annotate(str(number), point, color=colour, fontsize=7.5, zorder=8, **place)
        text.set_path_effects([patheffects.withStroke(linewidth=2, foreground="white")])
