"""A field on a regular grid, as a point cloud and as a surface, with its uncertainty."""

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import take
from bavs_jax.export.formats import ExportError, import_extra
from bavs_jax.metrics.chamfer import surface_error
from bavs_jax.pixel_table import PixelTable, view_pixel_rays
from bavs_jax.progress import Progress
from bavs_jax.rendering.images import RenderChunk
from bavs_jax.scenes.base import Scene
from bavs_jax.uncertainty.measures import look_at_points

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
    point_fn: Callable[[np.ndarray], Mapping[str, Array]],
    axes: Sequence[np.ndarray],
    *,
    block: int = BLOCK,
    progress_fn: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Reads a field at all points of a grid, a block at a time: by name, [X, Y, Z] float32.

    Args:
      point_fn: from positions [K, 3], scene units, arrays [K] by name.
      axes: [X], [Y], [Z], scene units.
      block: points of one call.
      progress_fn: called with the number of points done.
    """
    shape = tuple(len(axis) for axis in axes)
    num = int(np.prod(shape))
    values: dict[str, np.ndarray] = {}
    for start in range(0, num, block):
        stop = min(start + block, num)
        index = np.unravel_index(np.arange(start, stop), shape)
        part = point_fn(np.stack([axis[i] for axis, i in zip(axes, index)], axis=-1))
        for name, x in part.items():
            values.setdefault(name, np.empty(num, np.float32))[start:stop] = x
        if progress_fn is not None:
            progress_fn(stop - start)
    return {name: x.reshape(shape) for name, x in values.items()}


MIN_OPACITY = 0.5


def ray_end_points(
    render_fn: RenderChunk,
    table: PixelTable,
    view_ids,
    pixel_ids,
    *,
    chunk: int,
    min_opacity: float = MIN_OPACITY,
    progress_fn: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Points at the expected depth of rays through pixels that are not empty: `o + depth d`.

    Args:
      render_fn: renders "rgb" [R, 3], "depth" and "opacity" [R] of R = `chunk` rays.
      view_ids, pixel_ids: [N] views and numbers of the pixels (`batches.training_pixels`).
      chunk: rays of one call.
      min_opacity: of the rays that count, in [0, 1]; below it a ray mostly passes.
      progress_fn: called with the number of rays done.

    Returns:
      positions [K, 3] scene units, and rendered colours [K, 3] in [0, 1], of the K <= N rays that
      count.
    """
    positions, colours = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    num = len(view_ids)
    for start in range(0, num, chunk):
        rows = np.minimum(np.arange(start, start + chunk), num - 1)
        rays = _pixel_rays(table.cameras, view_ids[rows], pixel_ids[rows])
        images = {name: np.asarray(x) for name, x in render_fn(rays).items()}
        counts = (np.arange(chunk) < num - start) & (images["opacity"] >= min_opacity)
        ends = np.asarray(rays.origins) + images["depth"][:, None] * np.asarray(rays.directions)
        positions.append(ends[counts])
        colours.append(np.clip(images["rgb"][counts], 0.0, 1.0))
        if progress_fn is not None:
            progress_fn(min(chunk, num - start))
    return np.concatenate(positions), np.concatenate(colours)


_pixel_rays = jax.jit(view_pixel_rays)


DISTANCE_SHARE = 0.01  # of the longest side of the box, for the F-score
HIDDEN_BY = 0.01  # share of its distance by which a point must lie behind the surface to be hidden


def sample_mesh(mesh, num: int, *, seed: int) -> np.ndarray:
    """Points [num, 3] uniform over the area of a `trimesh.Trimesh`."""
    return import_extra("trimesh").sample.sample_surface(mesh, num, seed=seed)[0]


def seen_by_any(scene: Scene, points) -> np.ndarray:
    """Which points [K, 3] some view of the scene sees by its true depth, [K] bool.

    A view sees what lies in front of the true surface or on it, so that floating matter counts as
    seen; what is inside of an object, or on a side that no view faces, does not.

    Raises:
      ValueError: the scene has no true depth.
    """
    if scene.depth is None:
        raise ValueError(f"{scene.name}: has no true depth, which tells what its views see")
    points, seen = jnp.asarray(points, jnp.float32), np.zeros(len(points), bool)
    for view_id in range(scene.num_views):
        camera = jax.tree.map(jnp.asarray, take(scene.cameras, view_id))
        is_seen, _ = _look(camera, points, jnp.asarray(scene.depth_image(view_id)))
        seen |= np.asarray(is_seen)
    return seen


@jax.jit
def _look(camera, points, depth_map):
    return look_at_points(camera, points, depth_map, tolerance=HIDDEN_BY)


def geometry_error(scene: Scene, predicted, true, true_again, *, distance: float) -> dict:
    """Chamfer distances of the whole surfaces, and of what the scene's views see of them.

    Args:
      scene: with true depth, which tells what is seen.
      predicted: [N, 3] points spread evenly over the mesh, scene units.
      true: [M, 3] over the true surface.
      true_again: [M, 3] another draw: its error is the floor that the finite number of points sets.
      distance: of the F-score, scene units.

    Returns:
      {"whole", "seen", "floor"}: each the fields of a `SurfaceError`; "seen" is None where no view
      sees anything of the mesh.
    """
    seen = [points[seen_by_any(scene, points)] for points in (predicted, true)]
    return {
        "whole": surface_error(predicted, true, distance=distance)._asdict(),
        "seen": surface_error(*seen, distance=distance)._asdict() if all(map(len, seen)) else None,
        "floor": surface_error(true_again, true, distance=distance)._asdict(),
    }
