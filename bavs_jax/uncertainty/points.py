"""The field and its posterior as functions of space: density, uncertainty and colour at points."""

from typing import Protocol

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.progress import Progress, map_chunks
from bavs_jax.registry import check_known
from bavs_jax.uncertainty.channel import VARIANTS, uncertainty_at

CHUNK = 1 << 15  # points of one compiled call


class PointFn(Protocol):
    """See `make_point_fn`."""

    def __call__(
        self,
        state: ModelState,
        variance: Array,
        positions: Array,
        /,
        *,
        directions: Array | None = None,
        progress_fn: Progress | None = None,
    ) -> dict[str, np.ndarray]: ...


def make_point_fn(
    model: RadianceModel, grid: DeformationGrid, *, variant: str, chunk: int = CHUNK
) -> PointFn:
    """Makes the query of a trained field and its Laplace posterior at single points.

    What the renderer composites along a ray is here read at the points themselves: density and
    colour (Eq 1), and the standard deviation of the offset (Fig 4, before it is rendered). Fields
    that read more of a sample than its place are read without it: the point itself in place of a
    piece of a pixel's cone, the mean code in place of a view's.

    Args:
      variant: one of `channel.VARIANTS`.
      chunk: points of one compiled call.

    Returns:
      `point_fn(state, variance [G], positions [K, 3])` of any K points in scene units, which gives
      as host arrays, float32:
      "density" [K] 1 / scene unit; 0 outside of the box of a bounded scene, where the renderer
        never looks;
      "sigma" [K] standard deviation of the offset, scene units; outside of the box of a bounded
        scene that of the nearest face;
      "rgb" [K, 3] in [0, 1], only with `directions`: unit vectors along which points are looked
        at, [3] for all points, [K, 3] one for each, or [D, 1 or K, 3] for the mean over D.

    Raises:
      ValueError: unknown variant; from `point_fn`, positions or directions of the wrong shape.
    """
    check_known("variant", variant, VARIANTS)

    @jax.jit
    def query(state, variance, positions, directions):
        values = {
            "density": model.density(state, positions),
            "sigma": uncertainty_at(grid, variance, positions, variant=variant),
        }
        if directions is not None:
            # Mapped over directions alone, the part of the field before them is evaluated once.
            colours = jax.vmap(lambda d: model.radiance(state, positions, d)[1])(directions)
            values["rgb"] = colours.mean(0)
        return values

    def point_fn(state, variance, positions, *, directions=None, progress_fn=None):
        positions = np.asarray(positions, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions: have the shape {positions.shape}; give [K, 3]")
        num = len(positions)
        looks = None if directions is None else _stacked(directions, num)
        if not num:  # one point that is left out again, so that the answer has the right shapes
            positions, progress_fn = np.zeros((1, 3), np.float32), None
            looks = None if looks is None else np.zeros((len(looks), 1, 3), np.float32)

        def read(rows):
            some = None if looks is None else looks[:, rows]
            return query(state, variance, positions[rows], some)

        found = map_chunks(read, len(positions), chunk, progress_fn)
        return {name: x[:num] for name, x in found.items()}

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
