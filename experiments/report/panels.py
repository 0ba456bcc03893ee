"""Figures as files: panels of images, and what all of them share."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from experiments.files import write_atomic

DPI = 150
PANEL = 2.1  # inches
TEXT = "#111827"


class Panel(NamedTuple):
    """One image of a table of images."""

    title: str
    image: np.ndarray  # [H, W, 3] sRGB in [0, 1], or [H, W] values of a colour map
    colours: str = "cividis"
    limits: tuple[float, float] = (0.0, 1.0)  # of the colour map


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Writes a figure whole or not at all; the end of its name, such as `.pdf`, is the format."""
    form = pathlib.Path(path).suffix.removeprefix(".")
    write_atomic(path, lambda file: figure.savefig(file, format=form, dpi=DPI))


def panel_table(rows: Sequence[tuple[str, Sequence[Panel]]], *, scale_label: str = "") -> Figure:
    """Rows of images, each with a name at its left.

    Args:
      rows: (name, panels) from the top; all of the same length.
      scale_label: what the last colour map of each row shows; adds its scale at the right.
    """
    num = len(rows[0][1])
    height, width = rows[0][1][0].image.shape[:2]
    row_height = PANEL * height / width + 0.15 * (height < width)  # room for the titles
    figure = Figure(figsize=(PANEL * num + 0.8, row_height * len(rows) + 0.3), layout="constrained")
    grid = figure.subplots(len(rows), num, squeeze=False)
    for axes, (name, panels) in zip(grid, rows):
        for place, panel in zip(axes, panels):
            _show(place, panel)
        axes[0].set_ylabel(name, fontsize=9, color=TEXT)
        mapped = [panel for panel in panels if panel.image.ndim == 2]
        if scale_label and mapped:
            colour_bar(figure, axes, mapped[-1].colours, mapped[-1].limits, scale_label)
    return figure


def colour_bar(figure: Figure, axes, colours: str, limits, label: str) -> None:
    """The scale of a colour map at the right of a row of axes."""
    mappable = ScalarMappable(Normalize(*limits), colours)
    bar = figure.colorbar(mappable, ax=list(axes), shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    bar.outline.set_visible(False)


def bare(axes: Axes) -> None:
    """Takes the frame away."""
    for spine in axes.spines.values():
        spine.set_visible(False)


def _show(axes: Axes, panel: Panel) -> None:
    if panel.image.ndim == 3:
        axes.imshow(np.clip(panel.image, 0.0, 1.0), interpolation="nearest")
    else:
        low, high = panel.limits
        axes.imshow(panel.image, cmap=panel.colours, vmin=low, vmax=high, interpolation="nearest")
    axes.set_title(panel.title, fontsize=8.5, color=TEXT)
    axes.set_xticks([])
    axes.set_yticks([])
    bare(axes)
