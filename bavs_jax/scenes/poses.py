"""Poses between a scene's own coordinates and those of the user's files."""

from __future__ import annotations

import numpy as np

from bavs_jax.scenes.base import Scene


def user_transforms(scene: Scene, world_from_cam) -> np.ndarray:
    """Poses in the user's coordinates, [N, 4, 4] float64.

    `user_from_scene` may scale; a pose must not, so its rotation is divided by that scale.

    Args:
      scene: holds `user_from_scene` [4, 4], a similarity.
      world_from_cam: [N, 3, 4] poses in the scene's coordinates.
    """
    similarity = np.asarray(scene.user_from_scene, np.float64)
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    poses = np.tile(np.eye(4), (len(world_from_cam), 1, 1))
    poses[:, :3] = world_from_cam
    poses = similarity @ poses
    poses[:, :3, :3] /= scale
    return poses
