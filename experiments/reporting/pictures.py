"""Pictures of test views: strips as PNG of a page, panels of a figure, and the figures as files."""

from __future__ import annotations

import base64
import io
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from experiments.reporting import plots, stats
from experiments.reporting.results import load_pictures, load_runs, policies_of
from experiments.runtime import ReportError

MAX_VIEWS = 4
ERROR_LIMIT = 0.25  # the same in every report, so that pages can be laid side by side
ERROR_MAP, UNCERTAINTY_MAP = "magma", "cividis"
FORMATS = ("pdf", "png", "svg")  # of figures
PANEL = 2.1  # inches


# --- pictures of a page ---


class Picture(NamedTuple):
    """One image of a page, or a colour scale with the values at its ends."""

    uri: str
    caption: str
    low: str = ""
    high: str = ""


def png_uri(image: np.ndarray) -> str:
    """[H, W, 3] uint8 as a `data:` address that stands in the page itself."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def colourise(values: np.ndarray, low: float, high: float, name: str) -> np.ndarray:
    """[H, W] values as [H, W, 3] uint8 colours; grey where a value is not finite."""
    scaled = (values - low) / max(high - low, 1e-12)
    rgb = colormaps[name](np.clip(np.nan_to_num(scaled, nan=0.0), 0.0, 1.0))[..., :3]
    rgb[~np.isfinite(values)] = 0.6
    return np.round(255.0 * rgb).astype(np.uint8)


def shrink(image: np.ndarray, max_side: int) -> np.ndarray:
    """Area average down to at most `max_side` pixels; smaller images stay as they are."""
    height, width = image.shape[:2]
    factor = max_side / max(height, width)
    if factor >= 1.0:
        return image
    size = (max(round(width * factor), 1), max(round(height * factor), 1))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def uncertainty_limits(all_pictures: list[dict[str, np.ndarray]]) -> tuple[float, float]:
    """One scale for every uncertainty image of a page, over what is seen, not the empty background.

    From the 2nd percentile of the values above half the top to the top, the 99th percentile of
    all; rounded outwards.
    """
    values = [image.ravel() for p in all_pictures for image in p["uncertainty"][:MAX_VIEWS]]
    values = np.concatenate(values) if values else np.zeros(0)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 0.0, 1.0
    high = np.percentile(values, 99.0)
    low = np.percentile(values[values >= 0.5 * high], 2.0)
    low, high = np.floor(low * 100) / 100, np.ceil(high * 100) / 100
    return float(low), float(high if high > low else low + 0.01)


def strips(
    pictures: dict[str, np.ndarray], limits: tuple[float, float], *, max_side: int
) -> dict[str, list[Picture]]:
    """By the names of at most four test views: truth, render, error and uncertainty."""
    found = {}
    for i, name in enumerate(pictures["names"][:MAX_VIEWS]):
        truth, rgb, error, uncertainty = (
            pictures[key][i] for key in ("truth", "rgb", "error", "uncertainty")
        )
        small_error, small_uncertainty = shrink(error, max_side), shrink(uncertainty, max_side)
        shown = {
            "truth": shrink(truth, max_side),
            f"render, {psnr_words(rgb, truth)}": shrink(rgb, max_side),
            f"error {_mean(error)}": colourise(small_error, 0.0, ERROR_LIMIT, ERROR_MAP),
            f"uncertainty {_mean(uncertainty)}": colourise(
                small_uncertainty, *limits, UNCERTAINTY_MAP
            ),
        }
        found[str(name)] = [Picture(png_uri(image), caption) for caption, image in shown.items()]
    return found


def colour_bars(limits: tuple[float, float]) -> list[Picture]:
    """The scales of the error and uncertainty images."""
    ramp = np.linspace(0.0, 1.0, 256)[None]
    error, uncertainty = (
        png_uri(colourise(ramp, 0.0, 1.0, name)) for name in (ERROR_MAP, UNCERTAINTY_MAP)
    )
    words = "Error: absolute colour difference, mean of the channels (fixed scale)"
    bars = [Picture(error, words, "0", f"≥ {ERROR_LIMIT}")]
    words = "Uncertainty: rendered channel in [0, 1] (one scale for this page)"
    return [*bars, Picture(uncertainty, words, f"≤ {limits[0]:.2f}", f"≥ {limits[1]:.2f}")]


def psnr_words(rgb: np.ndarray, truth: np.ndarray) -> str:
    """PSNR of an image in [0, 255] against another."""
    mse = np.mean((rgb.astype(np.float64) - truth.astype(np.float64)) ** 2) / 255.0**2
    return "identical" if mse == 0.0 else f"{-10.0 * np.log10(mse):.2f} dB"


def _mean(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    return f"{finite.mean():.3f}" if finite.size else "not known"


# --- panels of a figure ---


class Panel(NamedTuple):
    """One image of a table of images."""

    title: str
    image: np.ndarray  # [H, W, 3] sRGB in [0, 1], or [H, W] values of a colour map
    colours: str = UNCERTAINTY_MAP
    limits: tuple[float, float] = (0.0, 1.0)  # of the colour map


def panel_table(rows: Sequence[tuple[str, Sequence[Panel]]], *, scale_label: str = "") -> Figure:
    """Rows of images, each with a name at its left.

    Args:
      rows: (name, panels) from the top; all of the same length.
      scale_label: what the last colour map of each row shows; adds its scale at the right.
    """
    num = len(rows[0][1])
    height, width = rows[0][1][0].image.shape[:2]
    row_height = PANEL * height / width + 0.15 * (height < width)  # room for the titles
    figure = Figure(figsize=(PANEL * num + 0.8, row_height * len(rows) + 0.3))
    grid = figure.subplots(len(rows), num, squeeze=False)
    for places, (name, panels) in zip(grid, rows):
        for axes, panel in zip(places, panels):
            look = {"interpolation": "nearest"}
            if panel.image.ndim == 2:
                look |= dict(zip(("vmin", "vmax"), panel.limits), cmap=panel.colours)
            axes.imshow(panel.image if panel.image.ndim == 2 else panel.image.clip(0, 1), **look)
            axes.set_title(panel.title, fontsize=8.5, loc="center")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.spines[:].set_visible(False)
        places[0].set_ylabel(name, fontsize=9)
        mapped = [panel for panel in panels if panel.image.ndim == 2]
        if scale_label and mapped:
            colour_bar(figure, places, mapped[-1].colours, mapped[-1].limits, scale_label)
    return figure


def colour_bar(figure: Figure, axes, colours: str, limits, label: str) -> None:
    """The scale of a colour map at the right of a row of axes."""
    mappable = ScalarMappable(Normalize(*limits), colours)
    bar = figure.colorbar(mappable, ax=list(axes), shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)


# --- figures as files ---


def write_figures(
    workdir: pathlib.Path, *, form: str = "png", policies: Sequence[str] = (), num_views: int = 4
) -> list[pathlib.Path]:
    """Writes every figure that the results of a folder have numbers for.

    Args:
      workdir: with `summary.json` and the arrays of each run.
      form: one of `FORMATS`.
      policies: which, in this order; none: all.
      num_views: most test views.

    Returns:
      The files.

    Raises:
      ReportError: a file that cannot be used, or a policy without a run.
    """
    runs = load_runs(workdir, policies)
    shown = policies_of(runs)
    coloured = plots.in_colour(runs, shown, stats.focus_policy(shown))
    figures = {m.key: plots.quality_figure(runs, shown, m, coloured) for m in stats.MEASURES}
    for figure in filter(None, figures.values()):
        # A page says this beside the figure; a file has to say it itself.
        scene = runs[0].result["scene"]["name"]
        what = f"training views of {scene} (thin: each seed; band: 95 % interval)"
        figure.axes[0].set_xlabel(what, fontsize=9)
    # Of each policy, the pictures of the first seed of which all, or else most, have some.
    kept: dict[int, dict] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        pictures = load_pictures(run)
        if pictures is not None:
            kept.setdefault(run.seed, {})[run.policy] = pictures
    if kept:
        best = max(kept.values(), key=len)  # the first of the largest
        figures["views"] = views_figure({p: best[p] for p in shown if p in best}, num_views)
    figures = {
        workdir / "figures" / f"{name}.{form}": figure for name, figure in figures.items() if figure
    }
    for path, figure in figures.items():
        plots.save_figure(figure, path)
    return list(figures)


def views_figure(pictures: dict[str, dict[str, np.ndarray]], num_views: int) -> Figure:
    """A row for each test view: the truth, then each policy's render and rendered uncertainty.

    Args:
      pictures: of each policy, what its run left in `pictures.npz`.
      num_views: most rows, of the views that all of them show.

    Raises:
      ReportError: there is no such view.
    """
    places = {p: {int(v): i for i, v in enumerate(a["view_ids"])} for p, a in pictures.items()}
    first = next(iter(pictures))
    shared = [view for view in places[first] if all(view in place for place in places.values())]
    if not shared:
        raise ReportError(f"{', '.join(pictures)}: show no test view in common; name one policy")
    limits = uncertainty_limits([*pictures.values()])
    rows = []
    for view in shared[:num_views]:
        at = places[first][view]
        panels = [Panel("truth", pictures[first]["truth"][at] / 255.0)]
        for policy, arrays in pictures.items():
            rgb, truth, uncertainty = (
                arrays[name][places[policy][view]] for name in ("rgb", "truth", "uncertainty")
            )
            panels.append(Panel(f"{policy}, {psnr_words(rgb, truth)}", rgb / 255.0))
            panels.append(Panel(f"{policy}, uncertainty", uncertainty, limits=limits))
        rows.append((pathlib.PurePath(str(pictures[first]["names"][at])).stem, panels))
    return panel_table(rows, scale_label="uncertainty (in [0, 1])")
