"""Poses and points between a scene's own coordinates and those of the user's files."""

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


def user_units(scene: Scene) -> float:
    """How many of the user's units make one scene unit."""
    return float(np.cbrt(np.linalg.det(np.asarray(scene.user_from_scene, np.float64)[:3, :3])))


def user_points(scene: Scene, positions) -> np.ndarray:
    """Points of the scene [..., 3] in the user's coordinates, float64."""
    matrix = np.asarray(scene.user_from_scene, np.float64)
    return np.asarray(positions, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def scene_points(scene: Scene, positions) -> np.ndarray:
    """Points in the user's coordinates [..., 3] as points of the scene, float64."""
    matrix = np.linalg.inv(np.asarray(scene.user_from_scene, np.float64))
    return np.asarray(positions, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
