"""Whole images and lists of pixels, in compiled chunks of fixed size."""

from collections.abc import Iterable, Mapping
from typing import Protocol

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays, pixel_rays, subpixel_offsets, take, view_pixels
from bavs_jax.progress import Progress, map_chunks


class RenderChunk(Protocol):
    """What R rays see, by name: arrays [R, ...]. R is the same at every call: it compiles once."""

    def __call__(self, rays: Rays, /) -> Mapping[str, Array]: ...


def render_pixels(
    chunk_fn: RenderChunk,
    cameras: Cameras,
    view_ids: np.ndarray,
    pixels: np.ndarray,
    *,
    chunk: int,
    rays_per_pixel: int = 1,
    progress_fn: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Streams N pixels through a compiled function of `chunk` rays, to host arrays [N, ...].

    A pixel shows the mean of what its rays see. These count in the mean depth by their "opacity",
    where `chunk_fn` gives that.

    Args:
      chunk_fn: `Rays` [chunk] -> dict of arrays [chunk, ...].
      cameras: V cameras.
      view_ids: [N] int.
      pixels: [N, 2] pixel coordinates.
      chunk: rays of one call; the last call is padded with copies of the last ray.
      rays_per_pixel: 1, 4 or 9; see `subpixel_offsets`.
      progress_fn: called with the number of rays done since the last call.
    """
    cameras = jax.tree.map(np.asarray, cameras)

    def one_ray_each(offset):
        def render(rows):
            # A camera for each ray: compiled once, however many cameras there are.
            places = pixels[rows] + offset
            return chunk_fn(_pixel_rays(take(cameras, view_ids[rows]), np.arange(chunk), places))

        return map_chunks(render, len(view_ids), chunk, progress_fn)

    offsets = subpixel_offsets(rays_per_pixel)
    if rays_per_pixel == 1:
        return one_ray_each(offsets[0])
    return _mean_of_rays(map(one_ray_each, offsets), rays_per_pixel)


_pixel_rays = jax.jit(pixel_rays)


def render_views(
    chunk_fn: RenderChunk,
    cameras: Cameras,
    view_ids,
    *,
    chunk: int,
    rays_per_pixel: int = 1,
    progress_fn: Progress | None = None,
) -> list[dict[str, np.ndarray]]:
    """Renders whole views; each as a dict of images [H, W, ...].

    Arguments as `render_pixels`.
    """
    sizes = np.asarray(cameras.sizes)[view_ids]
    ids, pixels = view_pixels(cameras, view_ids)
    rows = render_pixels(
        chunk_fn,
        cameras,
        ids,
        pixels,
        chunk=chunk,
        rays_per_pixel=rays_per_pixel,
        progress_fn=progress_fn,
    )
    ends = np.cumsum(sizes.prod(axis=-1))
    return [
        {name: x[end - w * h : end].reshape(h, w, *x.shape[1:]) for name, x in rows.items()}
        for end, (w, h) in zip(ends, sizes)
    ]


def _mean_of_rays(passes: Iterable[dict[str, np.ndarray]], num: int) -> dict[str, np.ndarray]:
    """Means over `num` rays of each of N pixels; each pass has one ray of every pixel."""
    total: dict[str, np.ndarray] = {}
    for rows in passes:
        rows = {name: x.astype(np.float32) for name, x in rows.items()}
        if "depth" in rows and "opacity" in rows:
            rows["depth"] = rows["depth"] * rows["opacity"]
        for name, x in rows.items():
            total[name] = total[name] + x if name in total else x
    means = {name: x / num for name, x in total.items()}
    if "depth" in means and "opacity" in means:
        seen = means["opacity"] > 0
        means["depth"] = np.where(seen, means["depth"] / np.where(seen, means["opacity"], 1), 0)
    return means
