"""Random training pixels, drawn on the device from the views that a mask allows."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays, pixel_rays, subpixel_offsets
from bavs_jax.scenes.base import Scene


class PixelTable(struct.PyTreeNode):
    """A scene's pixels on the device; which of them are trained on is a mask over views."""

    cameras: Cameras  # [V]
    pixels: jax.Array  # [N, 3] uint8
    pixel_mask: jax.Array  # [N] bool, or [1] when every pixel counts
    offsets: jax.Array  # [V + 1] int32
    # [N] uint8 opacity of the photos, which `pixels` show over the background; [1] if all opaque.
    alpha: jax.Array


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
    alpha = np.full(1, 255, np.uint8) if scene.alpha is None else scene.alpha
    return PixelTable(
        cameras=jax.tree.map(jnp.asarray, scene.cameras),
        pixels=jnp.asarray(scene.pixels),
        pixel_mask=jnp.asarray(mask),
        offsets=jnp.asarray(scene.offsets, jnp.int32),
        alpha=jnp.asarray(alpha),
    )


def num_training_pixels(scene: Scene | PixelTable, view_ids) -> np.ndarray:
    """How many pixels of each of some views are trained on, [n] int: those that are not masked."""
    offsets, mask = np.asarray(scene.offsets), scene.pixel_mask
    if mask is None or len(mask) == 1:
        return np.diff(offsets)[view_ids]
    before = np.concatenate([[0], np.cumsum(np.asarray(mask), dtype=np.int64)])
    return np.diff(before[offsets])[view_ids]


def training_sizes(table: PixelTable, is_training_view: jax.Array) -> jax.Array:
    """Pixels of each view that is trained on, masked ones too, and 0 of the others, [V] int."""
    return jnp.where(is_training_view, jnp.diff(table.offsets), 0)


class PixelBatch(struct.PyTreeNode):
    """P training pixels, each the mean of what its own rays see: R in all, side by side."""

    rays: Rays  # [R]
    rgb: jax.Array  # [P, 3] true colours in [0, 1]
    pixel_weight: jax.Array  # [P], 0 for masked pixels
    view_ids: jax.Array  # [R] int32
    background: jax.Array | None  # [R, 3] colour behind everything; see `composite_colour`

    def mean(self, values: jax.Array) -> jax.Array:
        """What pixels show: means over their rays, [R, ...] -> [P, ...]."""
        return self._by_pixel(values).mean(1)

    def whole(self, ray_mask: jax.Array) -> jax.Array:
        """Pixels all of whose rays are marked, [R] bool -> [P] bool."""
        return self._by_pixel(ray_mask).all(1)

    def _by_pixel(self, values: jax.Array) -> jax.Array:
        return values.reshape(len(self.rgb), -1, *values.shape[1:])


def sample_pixels(
    key: jax.Array,
    table: PixelTable,
    is_training_view: jax.Array,
    num_rays: int,
    *,
    rays_per_pixel: int = 1,
    background=None,
    random_background: bool = False,
) -> PixelBatch:
    """Uniform over all pixels of the training views, with replacement.

    A photo's pixel is a mean over its area, not what one ray sees: several rays through it, on an
    even grid, are averaged before they are compared with it.

    With `random_background`, each pixel gets a background of its own, uniform in colour, wherever
    photos have alpha: `rgb + (1 - alpha) (b' - b)`. Fog of the background's colour then costs as
    much as any other, where over one fixed colour it explains an empty pixel for nothing.

    Args:
      is_training_view: bool [V], at least one true.
      num_rays: R, a multiple of `rays_per_pixel`.
      rays_per_pixel: 1, 4 or 9; see `subpixel_offsets`.
      background: b [3], which the photos are shown over; None: see `composite_colour`.
      random_background: see above; does nothing where photos are opaque.
    """
    sizes = training_sizes(table, is_training_view)
    ends = jnp.cumsum(sizes)
    number = jax.random.randint(key, (num_rays // rays_per_pixel,), 0, ends[-1])
    view_ids = jnp.searchsorted(ends, number, side="right")
    pixel_ids = number - (ends - sizes)[view_ids]
    if table.pixel_mask.shape[0] == 1:
        weight = jnp.ones(len(number))
    else:
        weight = table.pixel_mask[table.offsets[view_ids] + pixel_ids].astype(jnp.float32)
    rgb = pixel_colours(table, view_ids, pixel_ids)
    if background is not None:
        background = jnp.broadcast_to(jnp.asarray(background, jnp.float32), rgb.shape)
    if random_background and background is not None and table.alpha.shape[0] > 1:
        seen_through = 1.0 - table.alpha[table.offsets[view_ids] + pixel_ids] / 255.0
        drawn = jax.random.uniform(jax.random.fold_in(key, 1), rgb.shape)
        rgb = rgb + seen_through[:, None] * (drawn - background)
        background = drawn

    def of_rays(values):
        return jnp.repeat(values, rays_per_pixel, axis=0)

    offsets = jnp.tile(subpixel_offsets(rays_per_pixel), (len(number), 1))
    rays = view_pixel_rays(table.cameras, of_rays(view_ids), of_rays(pixel_ids), offsets)
    if background is not None:
        background = of_rays(background)
    return PixelBatch(rays, rgb, weight, of_rays(view_ids), background)


def pixel_colours(table: PixelTable, view_ids: jax.Array, pixel_ids: jax.Array) -> jax.Array:
    """True colours [R, 3] in [0, 1] of the pixels numbered `pixel_ids` of the views `view_ids`."""
    return table.pixels[table.offsets[view_ids] + pixel_ids].astype(jnp.float32) / 255.0


def view_pixel_rays(
    cameras: Cameras, view_ids: jax.Array, pixel_ids: jax.Array, offsets: Array | float = 0.0
) -> Rays:
    """Rays through pixels, numbered in row order, of the views `view_ids`; both [R].

    They go through the pixels' centres, or `offsets` [R, 2] beside these, in pixels.
    """
    width = cameras.sizes[view_ids, 0]
    pixels = jnp.stack([pixel_ids % width, pixel_ids // width], axis=-1) + 0.5 + offsets
    return pixel_rays(cameras, view_ids, pixels)


def view_mask(table: PixelTable, view_ids) -> np.ndarray:
    """Which views of a table are the given ones, [V] bool."""
    mask = np.zeros(len(table.cameras), bool)
    mask[np.asarray(view_ids)] = True
    return mask


def training_pixels(table: PixelTable, is_training_view) -> tuple[np.ndarray, np.ndarray]:
    """All pixels of the training views that are not masked: view ids [N] and row numbers [N]."""
    offsets, mask = np.asarray(table.offsets), np.asarray(table.pixel_mask)
    views = np.flatnonzero(is_training_view)
    view_ids = np.repeat(views, np.diff(offsets)[views]).astype(np.int32)
    pixel_ids = np.concatenate([np.arange(offsets[v + 1] - offsets[v]) for v in views])
    pixel_ids = pixel_ids.astype(np.int32)
    if len(mask) > 1:
        keep = mask[offsets[view_ids] + pixel_ids]
        view_ids, pixel_ids = view_ids[keep], pixel_ids[keep]
    return view_ids, pixel_ids
