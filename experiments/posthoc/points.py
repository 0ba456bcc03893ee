"""Points that a user names, and slices through a field."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np
from matplotlib.figure import Figure

from bavs_jax.scenes.poses import scene_points, user_units
from bavs_jax.uncertainty.points import make_point_fn
from experiments.posthoc.field_files import on_unit_scale
from experiments.report.panels import TEXT, bare, colour_bar
from experiments.trained import TrainedRun, run_curvature, run_variance


def scene_point_fn(run: TrainedRun, variance: jax.Array) -> Callable:
    """`positions [K, 3] -> dict`, in scene units: see `make_point_fn`.

    Args:
      run: the run.
      variance: from `run_variance`.
    """
    toolbox = run.toolbox
    point_fn = make_point_fn(toolbox.model, toolbox.grid, variant=toolbox.laplace.variant)
    return partial(point_fn, run.state.train.model, variance)


def user_point_fn(run: TrainedRun, variance: jax.Array | None = None) -> Callable:
    """The same in the coordinates and units of the user's own files, directions included.

    Args:
      run: the run.
      variance: from `run_variance`; None computes it.

    Returns:
      `point_fn(positions [K, 3], *, directions=None, progress_fn=None) -> dict` as in
      `make_point_fn`, with "density" in 1 / user unit and "sigma" in user units.
    """
    scene = run.problem.scene
    if variance is None:
        variance = run_variance(run, run_curvature(run))
    point_fn, unit = scene_point_fn(run, variance), user_units(scene)
    user_from_scene_rotation = np.asarray(scene.user_from_scene)[:3, :3] / unit

    def query(positions, *, directions=None, progress_fn=None):
        if directions is not None:
            directions = np.asarray(directions) @ user_from_scene_rotation
        values = point_fn(
            scene_points(scene, positions), directions=directions, progress_fn=progress_fn
        )
        return values | {"density": values["density"] / unit, "sigma": values["sigma"] * unit}

    return query


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
