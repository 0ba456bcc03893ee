"""A field on the points of a regular grid over the scene box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bavs_jax.export.extras import ExportError

BLOCK = 1 << 20  # points whose positions are in memory at once


def grid_axes(box, resolution: int) -> list[np.ndarray]:
    """Coordinates of the grid's planes along x, y and z, scene units; both faces are planes.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      resolution: planes across the longest side; the others get as many as make voxels most
        nearly cubes.

    Returns:
      three arrays [X], [Y], [Z], float64, ascending and evenly spaced.

    Raises:
      ExportError: fewer than 2 planes.
    """
    if resolution < 2:
        raise ExportError(f"resolution: is {resolution}: give 2 or more points along a side")
    lower, upper = np.asarray(box, np.float64)
    spacing = (upper - lower).max() / (resolution - 1)
    counts = np.maximum(np.rint((upper - lower) / spacing).astype(int), 1) + 1
    return [np.linspace(a, b, n) for a, b, n in zip(lower, upper, counts)]


def sample_grid(
    point_fn: Callable, axes, *, block: int = BLOCK, progress_fn=None
) -> dict[str, np.ndarray]:
    """Reads a field at all points of a grid, a block of points at a time.

    Args:
      point_fn: positions [K, 3] -> dict of [K].
      axes: [X], [Y], [Z], scene units.
      block: points of one call.
      progress_fn: called with the number of points done.

    Returns:
      dict of [X, Y, Z] float32.
    """
    shape = tuple(len(axis) for axis in axes)
    num, values = int(np.prod(shape)), {}
    for start in range(0, num, block):
        stop = min(start + block, num)
        index = np.unravel_index(np.arange(start, stop), shape)
        part = point_fn(np.stack([axis[i] for axis, i in zip(axes, index)], axis=-1))
        for name, x in part.items():
            values.setdefault(name, np.empty(num, np.float32))[start:stop] = x
        if progress_fn is not None:
            progress_fn(stop - start)
    return {name: x.reshape(shape) for name, x in values.items()}
