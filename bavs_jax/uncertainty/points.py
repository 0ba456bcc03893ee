"""The field and its posterior as functions of space: density, uncertainty and colour at points."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.uncertainty.channel import VARIANTS, uncertainty_at

CHUNK = 1 << 15  # points of one compiled call


def make_point_fn(
    field: Field, grid: DeformationGrid, *, variant: str, chunk: int = CHUNK
) -> Callable:
    """Makes the query of a trained field and its Laplace posterior at single points.

    What the renderer composites along a ray is here read at the points themselves: density and
    colour (Eq 1), and the standard deviation of the offset (Fig 4, before it is rendered). Fields
    that read more of a sample than its place are read without it: the point itself in place of a
    piece of a pixel's cone, the mean code in place of a view's.

    Args:
      field: the radiance field.
      grid: the deformation grid.
      variant: one of `channel.VARIANTS`.
      chunk: points of one compiled call.

    Returns:
      `point_fn(params, variance [G], positions [K, 3], *, directions=None, progress_fn=None)`, with
      the field's own parameters, the variances of `vertex_variance` and any K, gives a dict of host
      arrays, float32:
        "density" [K] 1 / scene unit; 0 outside of the box of a bounded scene, where the renderer
          never looks;
        "sigma" [K] standard deviation of the offset, scene units; outside of the box of a bounded
          scene that of the nearest face;
        "rgb" [K, 3] in [0, 1], only with `directions`: unit vectors along which points are looked
          at, [3] for all points, [K, 3] one for each, or [D, 1 or K, 3] for the mean over D.
      `progress_fn(n)` is called with the number of points done.

    Raises:
      ValueError: unknown variant; by `point_fn`: positions or directions of the wrong shape.
    """
    if variant not in VARIANTS:
        raise ValueError(f"variant: {variant!r} is unknown; use one of {', '.join(VARIANTS)}")

    @jax.jit
    def query(params, variance, positions, directions):
        density = field.density(params, positions)
        if not grid.contracted:
            lower, upper = grid.box
            inside = ((positions >= lower) & (positions <= upper)).all(-1)
            density = jnp.where(inside, density, 0.0)
        values = {
            "density": density,
            "sigma": uncertainty_at(grid, variance, positions, variant=variant),
        }
        if directions is not None:
            # Mapped over directions alone, the part of the field before them is evaluated once.
            colours = jax.vmap(lambda d: field.apply(params, positions, d)[1])(directions)
            values["rgb"] = colours.mean(0)
        return values

    def point_fn(params, variance, positions, *, directions=None, progress_fn=None):
        positions = np.asarray(positions, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions: have the shape {positions.shape}; give [K, 3]")
        num = len(positions)
        if directions is not None:
            directions = _stacked(directions, num)
        parts = []
        for start in range(0, max(num, 1), chunk):
            # An empty list is one chunk of nothing, so that its answer has the right shapes.
            rows = np.minimum(np.arange(start, start + chunk), max(num - 1, 0))
            points = positions[rows] if num else np.zeros((chunk, 3), np.float32)
            looks = directions
            if looks is not None:
                looks = looks[:, rows] if num else np.zeros((len(looks), chunk, 3), np.float32)
            count = min(chunk, num - start)
            values = query(params, variance, points, looks)
            parts.append({name: np.asarray(x)[:count] for name, x in values.items()})
            if progress_fn is not None:
                progress_fn(count)
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    return point_fn


def _stacked(directions, num: int) -> np.ndarray:
    """Directions as [D, num, 3]."""
    directions = np.asarray(directions, np.float32)
    stack = directions.reshape((1,) * max(3 - directions.ndim, 0) + directions.shape)
    if stack.ndim != 3 or stack.shape[2] != 3 or (num and stack.shape[1] not in (1, num)):
        raise ValueError(
            f"directions: have the shape {directions.shape}; give [3], [{num}, 3] or "
            f"[D, 1 or {num}, 3]"
        )
    return np.broadcast_to(stack, (len(stack), num, 3)) if num else stack[:, :0]
