"""How well a mesh matches the true surface of its scene."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import take
from bavs_jax.export.extras import import_extra
from bavs_jax.metrics.chamfer import surface_error
from bavs_jax.scenes.base import Scene
from bavs_jax.uncertainty.visibility import look_at_points

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
