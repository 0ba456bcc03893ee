"""A tiny scene whose views are coloured by a smooth function, quick enough for training tests."""

import numpy as np

from bavs_jax.cameras import look_at, make_cameras
from bavs_jax.scenes.base import Scene, pixel_table

SIZE = 8


def toy_scene(num_views=12, num_test=3, size=SIZE) -> Scene:
    """Cameras on a ring around a coloured ball; the images are exact renders of its silhouette."""
    angles = 2 * np.pi * np.arange(num_views) / num_views
    positions = 3.0 * np.stack([np.cos(angles), np.sin(angles), 0.4 + 0.3 * np.cos(3 * angles)], -1)
    poses = np.stack([look_at(p, [0.0, 0.0, 0.0]) for p in positions])
    focal = 1.2 * size
    cameras = make_cameras(
        poses,
        np.tile([focal, focal, size / 2, size / 2], (num_views, 1)),
        np.tile([size, size], (num_views, 1)),
    )
    images = [_ball_image(np.asarray(pose, np.float64), focal, size) for pose in poses]
    pixels, offsets = pixel_table(images)
    return Scene(
        name="ball",
        cameras=cameras,
        pixels=pixels,
        offsets=offsets,
        pool=np.arange(num_views - num_test, dtype=np.int32),
        test=np.arange(num_views - num_test, num_views, dtype=np.int32),
        box=np.array([[-1.0] * 3, [1.0] * 3], np.float32),
        near=1.0,
        far=6.0,
        background=np.ones(3, np.float32),
        names=tuple(f"view_{i}" for i in range(num_views)),
    )


def _ball_image(pose, focal, size):
    y, x = np.mgrid[:size, :size] + 0.5
    local = np.stack([(x - size / 2) / focal, -(y - size / 2) / focal, -np.ones_like(x)], -1)
    directions = local @ pose[:, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    along = -(directions @ pose[:, 3])
    closest = pose[:, 3] + along[..., None] * directions
    inside = (closest**2).sum(-1) < 0.7**2
    half = np.sqrt(np.maximum(0.7**2 - (closest**2).sum(-1), 0.0))
    surface = closest - half[..., None] * directions
    colour = np.where(inside[..., None], 0.5 + 0.5 * surface / 0.7, 1.0)
    return np.round(255 * colour).astype(np.uint8)
