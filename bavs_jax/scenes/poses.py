"""Poses between a scene's own coordinates and those of the user's files."""

from __future__ import annotations

import numpy as np

from bavs_jax.scenes.base import Scene
from bavs_jax.scenes.normalise import transform_poses


def user_transforms(scene: Scene, world_from_cam) -> np.ndarray:
    """Poses in the user's coordinates, [N, 4, 4] float64.

    Args:
      scene: holds `user_from_scene` [4, 4], a similarity.
      world_from_cam: [N, 3, 4] poses in the scene's coordinates.
    """
    poses = np.tile(np.eye(4), (len(world_from_cam), 1, 1))
    poses[:, :3] = transform_poses(scene.user_from_scene, world_from_cam)
    return poses
