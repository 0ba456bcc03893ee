"""Pictures of test views: images of a page, panels of a figure, and the figures as files."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from PIL import Image

from experiments.reporting import plots, stats
from experiments.reporting.results import Run, load_pictures, load_runs, policies_of
from experiments.runtime import ReportError

MAX_VIEWS, MAX_SIDE = 4, 320  # pixels; of larger pictures areas are averaged
ERROR_LIMIT = 0.25  # the same in every report, so that pages can be laid side by side
ERROR_MAP, UNCERTAINTY_MAP = "magma", "cividis"
FORMATS = ("pdf", "png", "svg")  # of figures
IMAGES = ("truth", "rgb", "error", "uncertainty")
PANEL = 2.1  # inches


# --- pictures of a page ---


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
    images = [image for pictures in all_pictures for image in pictures["uncertainty"][:MAX_VIEWS]]
    values = np.concatenate([np.zeros(0), *(image[np.isfinite(image)] for image in images)])
    if values.size == 0:
        return 0.0, 1.0
    top = np.percentile(values, 99.0)
    low = np.floor(100.0 * np.percentile(values[values >= 0.5 * top], 2.0)) / 100.0
    return float(low), float(max(np.ceil(100.0 * top) / 100.0, low + 0.01))


def psnr_words(rgb: np.ndarray, truth: np.ndarray) -> str:
    """PSNR of an image in [0, 255] against another."""
    mse = np.mean((rgb.astype(np.float64) - truth.astype(np.float64)) ** 2) / 255.0**2
    return "identical" if mse == 0.0 else f"{-10.0 * np.log10(mse):.2f} dB"


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
    grid = figure.subplots(len(rows), num, squeeze=False, subplot_kw={"xticks": [], "yticks": []})
    for places, (name, panels) in zip(grid, rows):
        for axes, (title, image, colours, (low, high)) in zip(places, panels):
            look = {"vmin": low, "vmax": high, "cmap": colours, "interpolation": "none"}
            axes.imshow(image if image.ndim == 2 else image.clip(0, 1), **look)
            axes.set_title(title, fontsize=8.5, loc="center")
            axes.set_facecolor("0.6")  # where values are not finite
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


# --- test views, and figures as files ---


def views_figure(
    pictures: dict[str, dict[str, np.ndarray]], num_views: int, limits=None, *, errors=False
) -> Figure:
    """A row for each test view: the truth, then each policy's render and rendered uncertainty.

    Of each policy `pictures` are what its run left in `pictures.npz`; at most `num_views` that all
    of them show are shown, ReportError of none. `limits` are of the colours of uncertainty, by
    default those of these pictures; with `errors` that of each render is beside it.
    """
    places = {p: {int(v): i for i, v in enumerate(a["view_ids"])} for p, a in pictures.items()}
    first, *others = places.values()
    shared = [view for view in first if all(view in other for other in others)]
    if not shared:
        raise ReportError(f"{', '.join(pictures)}: show no test view in common; name one policy")
    limits = limits or uncertainty_limits([*pictures.values()])
    rows = []
    for view in shared[:num_views]:
        panels = []
        for policy, arrays in pictures.items():
            whole = {name: arrays[name][places[policy][view]] for name in IMAGES}
            truth, rgb, error, uncertainty = (shrink(image, MAX_SIDE) for image in whole.values())
            if not panels:
                panels.append(Panel("truth", truth / 255.0))
            psnr = psnr_words(whole["rgb"], whole["truth"])
            panels.append(Panel(f"{policy}, {psnr}", rgb / 255.0))
            if errors:
                title = f"error {error.mean():.3f}"
                panels.append(Panel(title, error, ERROR_MAP, (0.0, ERROR_LIMIT)))
            panels.append(Panel(f"{policy}, uncertainty", uncertainty, limits=limits))
        name = next(iter(pictures.values()))["names"][first[view]]
        rows.append((pathlib.PurePath(str(name)).stem, panels))
    return panel_table(rows, scale_label="uncertainty (in [0, 1])")


def first_pictures(runs: list[Run]) -> dict[str, tuple[Run, dict[str, np.ndarray]]]:
    """Of each policy the first run that has pictures, and these."""
    found: dict[str, tuple[Run, dict]] = {}
    for run in runs:
        if run.policy not in found and (pictures := load_pictures(run)) is not None:
            found[run.policy] = run, pictures
    return found


def write_figures(
    workdir: pathlib.Path, *, form: str = "png", policies: Sequence[str] = (), num_views: int = 4
) -> list[pathlib.Path]:
    """Writes every figure that the results of a folder have numbers for, and says where.

    Of some `policies` in this order, or of all, and at most `num_views` test views; `form` is one
    of `FORMATS`.
    """
    runs = load_runs(workdir, policies)
    shown = policies_of(runs)
    figures = {m.key: plots.quality_figure(runs, shown, m) for m in stats.MEASURES}
    pictures = {policy: arrays for policy, (_, arrays) in first_pictures(runs).items()}
    if pictures:
        figures["views"] = views_figure(pictures, num_views)
    paths = {workdir / "figures" / f"{name}.{form}": f for name, f in figures.items() if f}
    for path, figure in paths.items():
        plots.save_figure(figure, path)
    return [*paths]
