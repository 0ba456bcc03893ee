"""What a set of cameras looks at."""

from __future__ import annotations

import numpy as np

PULL = 1e-6  # of the fallback against one camera; decides only where the axes do not


def focus_point(world_from_cam, fallback) -> np.ndarray:
    """The point closest to all optical axes, in the sense of least squares.

    Solves `sum_v (I - d_v d_v^T) (x - p_v) = 0` for camera centres `p` and view directions `d`.

    Args:
      world_from_cam: [V, 3 or 4, 4] poses, OpenGL axes.
      fallback: [3] which point of a common line to take where all axes are parallel.

    Returns:
      [3] float64, in the unit of the poses.

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
