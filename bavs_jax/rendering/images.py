"""Whole images and lists of pixels, in compiled chunks of fixed size."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from bavs_jax.cameras import Cameras, image_pixels, pixel_rays, take


def render_pixels(
    chunk_fn: Callable,
    cameras: Cameras,
    view_ids: np.ndarray,
    pixels: np.ndarray,
    *,
    chunk: int,
    progress_fn: Callable[[int], None] | None = None,
) -> dict[str, np.ndarray]:
    """Streams N pixels through a compiled function of `chunk` rays.

    Args:
      chunk_fn: `Rays` [chunk] -> dict of arrays [chunk, ...].
      cameras: V cameras.
      view_ids: [N] int.
      pixels: [N, 2] pixel coordinates.
      chunk: rays of one call; the last call is padded with copies of the last ray.
      progress_fn: called with the number of rays done since the last call.

    Returns:
      dict of host arrays [N, ...].
    """
    num = len(view_ids)
    cameras = jax.tree.map(np.asarray, cameras)
    parts = []
    for start in range(0, num, chunk):
        rows = np.minimum(np.arange(start, start + chunk), num - 1)
        # A camera for each ray: compiled once, however many cameras there are.
        rays = _pixel_rays(take(cameras, view_ids[rows]), np.arange(chunk), pixels[rows])
        count = min(chunk, num - start)
        parts.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], chunk_fn(rays)))
        if progress_fn is not None:
            progress_fn(count)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


_pixel_rays = jax.jit(pixel_rays)


def render_views(
    chunk_fn: Callable, cameras: Cameras, view_ids, *, chunk: int, progress_fn=None
) -> list[dict[str, np.ndarray]]:
    """Renders whole views; each as a dict of images [H, W, ...]. Arguments as `render_pixels`."""
    sizes = np.asarray(cameras.sizes)[view_ids]
    pixels = [image_pixels(int(w), int(h)) for w, h in sizes]
    ids = np.concatenate([np.full(len(p), v, np.int32) for v, p in zip(view_ids, pixels)])
    rows = render_pixels(
        chunk_fn, cameras, ids, np.concatenate(pixels), chunk=chunk, progress_fn=progress_fn
    )
    ends = np.cumsum([len(p) for p in pixels])
    return [
        {name: x[end - w * h : end].reshape(h, w, *x.shape[1:]) for name, x in rows.items()}
        for end, (w, h) in zip(ends, sizes)
    ]
