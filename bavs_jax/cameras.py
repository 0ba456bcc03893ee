"""Cameras as arrays: poses, pixels to rays, points to pixels, candidate poses.

Poses use the OpenGL axes (x right, y up, the camera looks along -z) and pixel centres lie at
integer + 0.5, so that the ray through the middle of a W x H image is pixel (W / 2, H / 2).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.lenses import LENSES, lens_directions, rising_radii, undistort
from bavs_jax.numerics import safe_divide


class Rays(struct.PyTreeNode):
    """Half lines in world space; `directions` are unit vectors, so `t` is a distance."""

    origins: Array  # [..., 3] scene units
    directions: Array  # [..., 3] unit


class Cameras(struct.PyTreeNode):
    """V posed cameras with one lens model; images may differ in size."""

    world_from_cam: Array  # [V, 3, 4] OpenGL axes, scene units
    intrinsics: Array  # [V, 4] fx, fy, cx, cy in pixels
    distortion: Array  # [V, 6] k1, k2, k3, k4, p1, p2; a fisheye has no p1, p2
    sizes: Array  # [V, 2] int32 width, height in pixels
    lens: str = struct.field(pytree_node=False, default="pinhole")  # a key of `lenses.LENSES`

    @property
    def positions(self) -> Array:
        """Camera centres [V, 3], scene units."""
        return self.world_from_cam[..., :, 3]

    def __len__(self) -> int:
        return self.world_from_cam.shape[0]


def num_pixels(cameras: Cameras) -> np.ndarray:
    """Pixels of each camera's image, and so its rays, [V] int."""
    return np.prod(np.asarray(cameras.sizes), axis=-1)


# --- pixels to rays --------------------------------------------------------------------------


def pixel_rays(cameras: Cameras, view_ids: Array, pixels: Array) -> Rays:
    """Rays [R, 3] through pixels: `origin = t`, `direction = R lens_directions(undistort(xy))`.

    Args:
      cameras: V cameras.
      view_ids: [R] int, which camera each ray belongs to.
      pixels: [R, 2] x (to the right) and y (down) in pixels; the first pixel's centre is 0.5.
    """
    fx, fy, cx, cy = (cameras.intrinsics[view_ids, i] for i in range(4))
    xy: Array = jnp.stack([(pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy], axis=-1)
    if cameras.lens != "pinhole":
        xy = jax.vmap(lambda p, d: undistort(p, d, lens=cameras.lens))(
            xy, cameras.distortion[view_ids]
        )
    local = lens_directions(xy, lens=cameras.lens)
    pose = cameras.world_from_cam[view_ids]
    # Spelt out rather than a matrix product: exact float32 on every accelerator. By components
    # rather than as a sum over an axis: XLA for CPUs may fuse such a sum with the division by the
    # norm, and then gives most rays the directions of others.
    right, up, back = (local[..., i, None] for i in range(3))
    world = right * pose[..., :3, 0] + up * pose[..., :3, 1] + back * pose[..., :3, 2]
    directions = world / jnp.linalg.norm(world, axis=-1, keepdims=True)
    return Rays(origins=pose[..., :3, 3], directions=directions)


def image_pixels(width: int, height: int) -> np.ndarray:
    """Pixel centres of a whole image in row order, [H * W, 2] float32 (x, y)."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float32)


def subpixel_offsets(rays_per_pixel: int) -> np.ndarray:
    """Where the rays of a pixel go: an even grid, relative to its centre, [rays_per_pixel, 2].

    Raises:
      ValueError: the number is no square.
    """
    side = math.isqrt(rays_per_pixel)
    if side**2 != rays_per_pixel or side < 1:
        raise ValueError(f"rays_per_pixel: {rays_per_pixel} is no square; give 1, 4 or 9")
    steps = (np.arange(side) + 0.5) / side - 0.5
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2).astype(np.float32)


def view_pixels(cameras: Cameras, view_ids) -> tuple[np.ndarray, np.ndarray]:
    """All pixels of some views, one view after another: view ids [N] and pixel centres [N, 2]."""
    pixels = [image_pixels(int(w), int(h)) for w, h in np.asarray(cameras.sizes)[view_ids]]
    ids = [np.full(len(centres), view, np.int32) for view, centres in zip(view_ids, pixels)]
    return np.concatenate(ids), np.concatenate(pixels)


# --- points to pixels ----------------------------------------------------------------------------


def project(camera: Cameras, points: Array) -> tuple[jax.Array, jax.Array]:
    """Pixel at which a camera sees each point, were nothing in between; undoes `pixel_rays`.

    `pixel = f distort(xy) + c` with `xy` the point on the lens's undistorted plane (`lenses.py`).

    Args:
      camera: one camera: `Cameras` without the axis of views, as under `jax.vmap` or a scan.
      points: [..., 3] scene units.

    Returns:
      pixels [..., 2] x (to the right) and y (down), 0 for what is not in the image;
      is_in_image [...] bool: in front of the camera, within the lens's range and within the image.
    """
    pose = camera.world_from_cam
    # Spelt out by components for the reasons given in `pixel_rays`.
    x, y, z = (points[..., i] - pose[i, 3] for i in range(3))
    right, up, back = (x * pose[0, i] + y * pose[1, i] + z * pose[2, i] for i in range(3))
    down, ahead = -up, -back
    across = jnp.stack([right, down], axis=-1)
    if camera.lens == "fisheye":
        radius = jnp.linalg.norm(across, axis=-1)
        is_shown = (radius > 0.0) | (ahead > 0.0)
        scale = safe_divide(jnp.arctan2(radius, ahead), radius)
    else:
        is_shown = ahead > 0.0
        scale = jnp.where(is_shown, 1.0, 0.0) / jnp.where(is_shown, ahead, 1.0)
    xy = scale[..., None] * across
    if camera.lens != "pinhole":
        # Beyond the lens's range its polynomial folds the outside back into the image.
        is_shown &= (
            jnp.linalg.norm(xy, axis=-1) < rising_radii(camera.distortion, lens=camera.lens)[-1]
        )
    seen_at = LENSES[camera.lens](xy, camera.distortion)
    pixels = camera.intrinsics[:2] * seen_at + camera.intrinsics[2:]
    is_in_image = is_shown & ((pixels >= 0.0) & (pixels <= camera.sizes)).all(axis=-1)
    return jnp.where(is_in_image[..., None], pixels, 0.0), is_in_image


# --- host-side helpers -----------------------------------------------------------------------


def make_cameras(world_from_cam, intrinsics, sizes, *, distortion=None, lens="pinhole") -> Cameras:
    """Builds `Cameras` from array-likes; `distortion` defaults to none."""
    world_from_cam = np.asarray(world_from_cam, np.float32)[..., :3, :4]
    num = world_from_cam.shape[0]
    if distortion is None:
        distortion = np.zeros((num, 6), np.float32)
    return Cameras(
        world_from_cam=world_from_cam,
        intrinsics=np.asarray(intrinsics, np.float32),
        distortion=np.asarray(distortion, np.float32),
        sizes=np.asarray(sizes, np.int32),
        lens=lens,
    )


def take(cameras: Cameras, view_ids) -> Cameras:
    """The cameras at `view_ids`, in that order."""
    return jax.tree.map(lambda x: x[view_ids], cameras)


def rescale(cameras: Cameras, sizes) -> Cameras:
    """The same cameras with images of other sizes [V, 2]; intrinsics scale along."""
    sizes = np.asarray(sizes, np.int32)
    factor = sizes / np.asarray(cameras.sizes)  # [V, 2]
    scale = np.concatenate([factor, factor], axis=-1).astype(np.float32)
    return cameras.replace(intrinsics=cameras.intrinsics * scale, sizes=sizes)


def reduced_cameras(cameras: Cameras, image_scale: float) -> Cameras:
    """The same cameras with images of `image_scale` times the width and height, at least 1 px."""
    sizes = np.maximum(np.round(np.asarray(cameras.sizes) * image_scale), 1).astype(np.int32)
    return rescale(cameras, sizes)


def look_at(position, target, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Pose [3, 4] of a camera at `position` that looks at `target`, OpenGL axes.

    Where the view line is parallel to `up`, the world's x axis takes the place of `up`.
    """
    position, target, up = (np.asarray(v, np.float64) for v in (position, target, up))
    back = position - target
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([1.0, 0.0, 0.0], back)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, position], axis=-1)


def hemisphere_poses(key, num: int, *, centre, radius: float, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Poses [num, 3, 4] uniform in area on the upper hemisphere, looking at its centre (Eq 14).

    `phi = 2 pi u`, `theta = arccos(1 - v)` with `u, v ~ U[0, 1]`, `theta` measured from `up`.

    Args:
      centre: [3] scene centre, scene units.
      radius: camera distance, scene units.
      up: [3] the hemisphere's pole.
    """
    u, v = np.asarray(jax.random.uniform(key, (2, num)), np.float64)
    phi, cos_theta = 2.0 * np.pi * u, 1.0 - v
    sin_theta = np.sqrt(np.maximum(1.0 - cos_theta**2, 0.0))
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    east = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
    east = east / np.linalg.norm(east)
    north = np.cross(up, east)
    offsets = (
        np.outer(sin_theta * np.cos(phi), east)
        + np.outer(sin_theta * np.sin(phi), north)
        + np.outer(cos_theta, up)
    )
    centre = np.asarray(centre, np.float64)
    poses = [look_at(centre + radius * o, centre, up) for o in offsets]
    return np.stack(poses).astype(np.float32)
