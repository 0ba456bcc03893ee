"""Random training pixels, drawn on the device from the views that a mask allows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.cameras import Cameras, Rays, pixel_rays
from bavs_jax.scenes.base import Scene


@struct.dataclass
class PixelTable:
    """A scene's pixels on the device; which of them are trained on is a mask over views."""

    cameras: Cameras  # [V]
    pixels: jax.Array  # [N, 3] uint8
    pixel_mask: jax.Array  # [N] bool, or [1] when every pixel counts
    offsets: jax.Array  # [V + 1] int32


def make_pixel_table(scene: Scene) -> PixelTable:
    """Puts a scene's cameras and pixels on the device.

    Raises:
      ValueError: if the scene has more pixels than an int32 can number.
    """
    if scene.offsets[-1] >= 2**31:
        raise ValueError(
            f"{scene.name}: {scene.offsets[-1]} pixels exceed 2^31; use smaller images"
        )
    mask = np.ones(1, bool) if scene.pixel_mask is None else scene.pixel_mask
    return PixelTable(
        cameras=jax.tree.map(jnp.asarray, scene.cameras),
        pixels=jnp.asarray(scene.pixels),
        pixel_mask=jnp.asarray(mask),
        offsets=jnp.asarray(scene.offsets, jnp.int32),
    )


def num_training_pixels(scene: Scene | PixelTable, view_ids) -> np.ndarray:
    """How many pixels of each of some views are trained on, [n] int: those that are not masked."""
    offsets, mask = np.asarray(scene.offsets), scene.pixel_mask
    if mask is None or len(mask) == 1:
        return np.diff(offsets)[view_ids]
    before = np.concatenate([[0], np.cumsum(np.asarray(mask), dtype=np.int64)])
    return np.diff(before[offsets])[view_ids]


@struct.dataclass
class PixelBatch:
    """R training pixels."""

    rays: Rays
    rgb: jax.Array  # [R, 3] true colours in [0, 1]
    ray_weight: jax.Array  # [R], 0 for masked pixels
    view_ids: jax.Array  # [R] int32


def sample_pixels(
    key: jax.Array, table: PixelTable, is_training_view: jax.Array, num_rays: int
) -> PixelBatch:
    """Uniform over all pixels of the training views, with replacement.

    Args:
      key: random key.
      table: the scene's pixels.
      is_training_view: bool [V], at least one true.
      num_rays: R.

    Returns:
      A batch of R pixels.
    """
    sizes = jnp.where(is_training_view, jnp.diff(table.offsets), 0)
    ends = jnp.cumsum(sizes)
    number = jax.random.randint(key, (num_rays,), 0, ends[-1])
    view_ids = jnp.searchsorted(ends, number, side="right")
    within = number - (ends - sizes)[view_ids]
    rays = view_pixel_rays(table.cameras, view_ids, within)
    if table.pixel_mask.shape[0] == 1:
        weight = jnp.ones(num_rays)
    else:
        weight = table.pixel_mask[table.offsets[view_ids] + within].astype(jnp.float32)
    return PixelBatch(rays, pixel_colours(table, view_ids, within), weight, view_ids)


def pixel_colours(table: PixelTable, view_ids: jax.Array, within: jax.Array) -> jax.Array:
    """True colours [R, 3] in [0, 1] of the pixels numbered `within` of the views `view_ids`."""
    return table.pixels[table.offsets[view_ids] + within].astype(jnp.float32) / 255.0


def view_pixel_rays(cameras: Cameras, view_ids: jax.Array, within: jax.Array) -> Rays:
    """Rays through the pixels numbered `within` (row order) of the views `view_ids`, both [R]."""
    width = cameras.sizes[view_ids, 0]
    pixels = jnp.stack([within % width, within // width], axis=-1) + 0.5
    return pixel_rays(cameras, view_ids, pixels)
