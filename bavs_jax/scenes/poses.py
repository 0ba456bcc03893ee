"""Poses: their conventions, and the units and the centre of a scene."""

import numpy as np

from bavs_jax.scenes.base import Scene


def user_transforms(scene: Scene, world_from_cam) -> np.ndarray:
    """Poses [N, 3, 4] of the scene in the user's coordinates, [N, 4, 4] float64."""
    poses = np.tile(np.eye(4), (len(world_from_cam), 1, 1))
    poses[:, :3] = transform_poses(scene.user_from_scene, world_from_cam)
    return poses


def user_units(scene: Scene) -> float:
    """How many of the user's units make one scene unit."""
    return float(np.cbrt(np.linalg.det(np.asarray(scene.user_from_scene, np.float64)[:3, :3])))


def user_points(scene: Scene, positions) -> np.ndarray:
    """Points of the scene [..., 3] in the user's coordinates, float64."""
    return _moved(np.asarray(scene.user_from_scene, np.float64), positions)


def scene_points(scene: Scene, positions) -> np.ndarray:
    """Points in the user's coordinates [..., 3] as points of the scene, float64."""
    return _moved(np.linalg.inv(np.asarray(scene.user_from_scene, np.float64)), positions)


def _moved(matrix: np.ndarray, positions) -> np.ndarray:
    return np.asarray(positions, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


PARALLEL = 1e-8  # sine below which two directions count as parallel


def rotation_between(source, target) -> np.ndarray:
    """The shortest rotation [3, 3] that turns one direction [3] into another.

    `R = I + [v] + [v]^2 / (1 + c)` with `v = source x target`, `c = source . target`; opposite
    directions turn by pi about any axis at right angles.

    Numerics: near opposite directions `1 + c` is `v . v / (1 - c)`, which does not cancel.
    """
    source = np.asarray(source, np.float64) / np.linalg.norm(source)
    target = np.asarray(target, np.float64) / np.linalg.norm(target)
    cross, cos = np.cross(source, target), source @ target
    if np.linalg.norm(cross) < PARALLEL:
        if cos > 0:
            return np.eye(3)
        axis = np.cross(source, np.eye(3)[np.argmin(np.abs(source))])
        axis /= np.linalg.norm(axis)
        return 2.0 * np.outer(axis, axis) - np.eye(3)
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    rest = 1.0 + cos if cos > -0.5 else cross @ cross / (1.0 - cos)
    return np.eye(3) + skew + skew @ skew / rest


def level_and_scale(poses: np.ndarray, *, scale: float | None = None) -> np.ndarray:
    """The similarity that makes a capture upright, centred and of unit size.

    The mean of the cameras' up axes becomes +z, the mean of their positions the origin, and the
    largest absolute coordinate of a position 1.

    Args:
      poses: [V, 3 or 4, 4] camera-to-world, OpenGL axes.
      scale: scene units per unit of the poses; None for that of unit size.

    Returns:
      [4, 4] float64 `scene_from_user = s [R | -R mean]`.

    Numerics: up axes that cancel out leave the orientation, cameras in one place the scale.
    """
    poses = np.asarray(poses, np.float64)
    up, middle = poses[:, :3, 1].mean(axis=0), poses[:, :3, 3].mean(axis=0)
    rotation = np.eye(3)
    if np.linalg.norm(up) > PARALLEL:
        rotation = rotation_between(up, [0.0, 0.0, 1.0])
    positions = (poses[:, :3, 3] - middle) @ rotation.T
    if scale is None:
        reach = np.abs(positions).max()
        scale = 1.0 / reach if reach > PARALLEL else 1.0
    scene_from_user = np.eye(4)
    scene_from_user[:3, :3] = scale * rotation
    scene_from_user[:3, 3] = -scale * rotation @ middle
    return scene_from_user


def transform_poses(similarity: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses [V, 3, 4] where a similarity [4, 4] leads to, float64; rotations stay orthonormal."""
    similarity, poses = np.asarray(similarity, np.float64), np.asarray(poses, np.float64)
    scale = np.cbrt(np.linalg.det(similarity[:3, :3]))
    moved = similarity[:3] @ np.concatenate(
        [poses[:, :3], np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(poses), 1, 4))], axis=1
    )
    moved[:, :, :3] /= scale
    return moved
