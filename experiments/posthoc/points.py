"""Density, uncertainty and colour of a trained field at points that a user names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from bavs_jax.scenes.poses import scene_points, user_units
from bavs_jax.uncertainty.points import make_point_fn
from experiments.trained import TrainedRun, run_curvature, run_variance


def scene_point_fn(run: TrainedRun, variance: jax.Array) -> Callable:
    """`positions [K, 3] -> dict`, in scene units: see `make_point_fn`.

    Args:
      run: the run.
      variance: from `run_variance`.
    """
    setup = run.setup
    point_fn = make_point_fn(setup.model, setup.grid, variant=setup.laplace.variant)
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
