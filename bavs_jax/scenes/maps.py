"""Masks and depth maps that lie beside images."""

import functools
import pathlib

import jax
import numpy as np

from bavs_jax.cameras import Cameras, image_pixels, pixel_rays, take
from bavs_jax.scenes import checks, images, texts
from bavs_jax.scenes.base import SceneError

GRAZING = 1e-3  # cosine to the optical axis below which a depth along it says nothing


def read_mask(path: pathlib.Path, size: tuple[int, int], image_path: pathlib.Path) -> np.ndarray:
    """Which pixels [H, W] of an image count: black in the mask means ignored.

    Args:
      path: an image file of one channel.
      size: (width, height) of the image that it belongs to, pixels.
      image_path: that image, for messages.

    Raises:
      SceneError: the mask is missing, damaged, coloured, of another size or black everywhere.
    """
    if not path.is_file():
        raise SceneError(f"{path}: mask of {image_path.name} is missing: add it or drop mask_path")
    mask = images.decode(path)
    if mask.ndim != 2:
        raise SceneError(
            f"{path}: mask has {mask.shape[-1]} channels: save it as one channel, black is ignored"
        )
    checks.check_image_size(mask.shape[::-1], size, path, image_path.name)
    if not mask.any():
        raise SceneError(
            f"{path}: mask is black everywhere: black is ignored; paint white what counts"
        )
    return mask > 0


def shrink_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """A mask at a smaller size [height, width]: a pixel counts where all that it covers counts."""
    share = images.area_resize(mask[..., None].astype(np.float64), width, height)[..., 0]
    return share > 1.0 - 1e-9  # rounding of the sums


def read_depth(
    path: pathlib.Path, size: tuple[int, int], image_path: pathlib.Path, *, unit: float
) -> np.ndarray:
    """Depth along the optical axis, or whatever else the file holds, 0 where unknown.

    Args:
      path: a 16-bit image or an .npy file.
      size: (width, height) of the image that it belongs to; the map may be smaller, as those of
        depth sensors are, but of the same proportions.
      image_path: that image, for messages.
      unit: what a value of 1 means, in the units of the poses.

    Returns:
      [h, w] float32 in the units of the poses.

    Raises:
      SceneError: the map is missing, damaged, of 8 bits, of other proportions or negative.
    """
    if not path.is_file():
        raise SceneError(
            f"{path}: depth of {image_path.name} is missing: add it or drop its depth_file_path"
        )
    if path.suffix == ".npy":
        depth = texts.read_array(path)
    else:
        depth = images.decode(path)
        if depth.dtype != np.uint16:
            raise SceneError(f"{path}: depth has {depth.dtype} values: save it as 16-bit PNG")
    if depth.ndim == 3 and depth.shape[-1] == 1:
        depth = depth[..., 0]
    if depth.ndim != 2 or 0 in depth.shape:
        raise SceneError(f"{path}: depth has shape {list(depth.shape)}: save it as one channel")
    if abs(depth.shape[0] - size[1] * depth.shape[1] / size[0]) > checks.SIZE_TOLERANCE:
        raise SceneError(
            f"{path}: depth is {depth.shape[1]} x {depth.shape[0]} but {image_path.name} is "
            f"{size[0]} x {size[1]}: use the same proportions"
        )
    depth = np.where(np.isfinite(depth), depth, 0.0)
    largest = max(unit, 1.0) * float(max(depth.max(), -depth.min()))
    if largest > checks.LARGEST:
        raise SceneError(
            f"{path}: depth reaches {largest:g}: give at most {checks.LARGEST:g}, 0 for unknown"
        )
    depth = depth.astype(np.float32) * np.float32(unit)
    if depth.min() < 0.0:
        raise SceneError(f"{path}: depth is negative ({depth.min():g}): use 0 for unknown")
    return depth


@functools.cache
def compiled_rays():
    """`pixel_rays`, compiled once for all views of a size."""
    return jax.jit(pixel_rays)


def along_rays(depth: np.ndarray, cameras: Cameras, view_id: int) -> np.ndarray:
    """Distance [H, W] along each pixel's ray from depth along the optical axis, `z / cos(angle)`.

    Args:
      depth: [H, W] depth along the axis, 0 where unknown; H, W are the view's size.
      cameras: V cameras.
      view_id: which of them.

    Numerics: rays at right angles to the axis, and beyond, have no such depth: 0.
    """
    height, width = depth.shape
    view = take(cameras, np.array([view_id]))
    rays = compiled_rays()(view, np.zeros(height * width, int), image_pixels(width, height))
    cosine = np.asarray(rays.directions) @ -np.asarray(view.world_from_cam)[0, :, 2]
    cosine = cosine.reshape(height, width)
    known = (depth > 0.0) & (cosine > GRAZING)
    return np.where(known, depth / np.where(known, cosine, 1.0), 0.0).astype(np.float32)
