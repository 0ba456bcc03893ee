"""A picture of an exported grid: its middle planes."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from experiments.posthoc.field_files import on_unit_scale
from experiments.report.panels import TEXT, bare, colour_bar

ROWS = {  # title, colour map
    "opacity": ("light that a voxel stops", "Greys"),
    "uncertainty": ("uncertainty, log10 sigma on [0, 1]", "cividis"),
}


def slices_figure(axes, grid: dict, box) -> Figure:
    """Opacity of the voxels and uncertainty on the three planes through the middle of the box.

    Args:
      axes: [X], [Y], [Z] scene units.
      grid: "density" and "sigma" [X, Y, Z], scene units.
      box: [2, 3] of the scene.
    """
    spacing = float(np.mean([axis[1] - axis[0] for axis in axes]))
    shown = {
        "opacity": -np.expm1(-grid["density"] * spacing),
        "uncertainty": on_unit_scale(grid["sigma"], box),
    }
    figure = Figure(figsize=(7.6, 5.2), layout="constrained")
    places = figure.subplots(len(ROWS), 3, squeeze=False)
    for row, (name, (title, colours)) in zip(places, ROWS.items()):
        for normal, place in zip("xyz", row):
            across, up = (i for i, axis in enumerate("xyz") if axis != normal)
            fixed = "xyz".index(normal)
            middle = len(axes[fixed]) // 2
            extent = [axes[across][0], axes[across][-1], axes[up][0], axes[up][-1]]
            plane = np.take(shown[name], middle, axis=fixed).T
            place.imshow(plane, origin="lower", extent=extent, cmap=colours, vmin=0.0, vmax=1.0)
            place.set_title(f"{normal} = {axes[fixed][middle]:.2f}", fontsize=8.5, color=TEXT)
            place.set_xlabel(f"{'xyz'[across]} (scene units)", fontsize=8)
            place.set_ylabel(f"{'xyz'[up]}", fontsize=8)
            place.tick_params(labelsize=7)
            bare(place)
        colour_bar(figure, row, colours, (0.0, 1.0), title)
    return figure
