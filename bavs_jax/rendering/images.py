"""Whole images and lists of pixels, in compiled chunks of fixed size."""

from collections.abc import Mapping
from typing import Protocol

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays, pixel_rays, take, view_pixels
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
    progress_fn: Progress | None = None,
) -> dict[str, np.ndarray]:
    """Streams N pixels through a compiled function of `chunk` rays, to host arrays [N, ...].

    Args:
      chunk_fn: `Rays` [chunk] -> dict of arrays [chunk, ...].
      cameras: V cameras.
      view_ids: [N] int.
      pixels: [N, 2] pixel coordinates.
      chunk: rays of one call; the last call is padded with copies of the last ray.
      progress_fn: called with the number of rays done since the last call.
    """
    cameras = jax.tree.map(np.asarray, cameras)

    def render(rows):
        # A camera for each ray: compiled once, however many cameras there are.
        return chunk_fn(_pixel_rays(take(cameras, view_ids[rows]), np.arange(chunk), pixels[rows]))

    return map_chunks(render, len(view_ids), chunk, progress_fn)


_pixel_rays = jax.jit(pixel_rays)


def render_views(
    chunk_fn: RenderChunk,
    cameras: Cameras,
    view_ids,
    *,
    chunk: int,
    progress_fn: Progress | None = None,
) -> list[dict[str, np.ndarray]]:
    """Renders whole views; each as a dict of images [H, W, ...]. Arguments as `render_pixels`."""
    sizes = np.asarray(cameras.sizes)[view_ids]
    ids, pixels = view_pixels(cameras, view_ids)
    rows = render_pixels(chunk_fn, cameras, ids, pixels, chunk=chunk, progress_fn=progress_fn)
    ends = np.cumsum(sizes.prod(axis=-1))
    return [
        {name: x[end - w * h : end].reshape(h, w, *x.shape[1:]) for name, x in rows.items()}
        for end, (w, h) in zip(ends, sizes)
    ]
