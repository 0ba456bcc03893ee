"""What free poses look at, and what they would see of it."""

import numpy as np

from bavs_jax.arrays import DensityFn
from bavs_jax.cameras import Cameras
from bavs_jax.placement.clearance import optical_depth

PULL = 1e-6  # of the fallback against one camera; decides only where the axes do not


def focus_point(world_from_cam, fallback) -> np.ndarray:
    """The point [3] closest to all optical axes, in the sense of least squares.

    Solves `sum_v (I - d_v d_v^T) (x - p_v) = 0` for camera centres `p` and view directions `d`.

    Args:
      world_from_cam: [V, 3 or 4, 4] poses, OpenGL axes.
      fallback: [3] which point of a common line to take where all axes are parallel.

    Numerics: a weak pull towards `fallback` keeps the system regular.
    """
    poses = np.asarray(world_from_cam, np.float64)
    fallback = np.asarray(fallback, np.float64)
    positions, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = PULL * len(poses) * np.eye(3)
    right = np.einsum("vij,vj->i", across, positions) + pull @ fallback
    return np.linalg.solve(across.sum(axis=0) + pull, right)


def share_facing(world_from_cam, point) -> float:
    """Share of cameras that have a point in front of them, 0 to 1; low where they look outwards."""
    poses = np.asarray(world_from_cam, np.float64)
    towards = np.asarray(point, np.float64) - poses[:, :3, 3]
    return float(((towards * -poses[:, :3, 2]).sum(axis=-1) > 0.0).mean())


def count_seeing(cameras: Cameras, position, density_fn: DensityFn) -> int:
    """How many cameras have a place in their image, with at least half of its light unhidden.

    Args:
      cameras: [V].
      position: [3] scene units.

    Numerics: lens distortion is left out, which moves the image's edge by a few pixels.
    """
    poses = np.asarray(cameras.world_from_cam, np.float64)
    local = np.einsum("vij,vi->vj", poses[:, :, :3], position - poses[:, :, 3])
    depth = -local[:, 2]
    fx, fy, cx, cy = np.asarray(cameras.intrinsics, np.float64).T
    safe = np.where(depth > 0.0, depth, 1.0)
    x, y = cx + fx * local[:, 0] / safe, cy - fy * local[:, 1] / safe
    width, height = np.asarray(cameras.sizes).T
    in_image = (depth > 0.0) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    if not in_image.any():
        return 0
    # All cameras at once, so that the field is compiled for one shape.
    ends = np.broadcast_to(position, poses[:, :, 3].shape)
    return int((in_image & (optical_depth(density_fn, poses[:, :, 3], ends) < np.log(2.0))).sum())


def in_unknown_space(
    positions, cameras: Cameras, density_fn: DensityFn, *, reach: float
) -> np.ndarray:
    """Which places no camera sees and none stands near, [N] bool.

    A field says nothing about space that no photo looks into: it is free there because nothing
    told it otherwise. Only the neighbourhood of a camera is known to be free without a look.

    Args:
      positions: [N, 3] scene units.
      cameras: [V].
      density_fn: see `count_seeing`.
      reach: radius around each camera that counts as known, scene units.
    """
    positions = np.asarray(positions, np.float64)
    standing = np.asarray(cameras.world_from_cam, np.float64)[:, :, 3]
    unknown = np.zeros(len(positions), bool)
    for i, position in enumerate(positions):
        if np.linalg.norm(standing - position, axis=-1).min() > reach:
            unknown[i] = count_seeing(cameras, position, density_fn) == 0
    return unknown
