"""Where the rays of photos end: the scene as a cloud of coloured points."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from bavs_jax.training.batches import PixelTable, view_pixel_rays

MIN_OPACITY = 0.5


def ray_end_points(
    render_fn: Callable,
    table: PixelTable,
    view_ids,
    within,
    *,
    chunk: int,
    min_opacity: float = MIN_OPACITY,
    progress_fn=None,
) -> tuple[np.ndarray, np.ndarray]:
    """Points at the expected depth of rays through pixels that are not empty: `o + depth d`.

    Args:
      render_fn: `Rays` [chunk] -> dict with "rgb" [chunk, 3], "depth" and "opacity" [chunk].
      table: the scene's pixels.
      view_ids, within: [N] views and numbers of the pixels (`batches.training_pixels`).
      chunk: rays of one call.
      min_opacity: of the rays that count, in [0, 1]; below it a ray mostly passes.
      progress_fn: called with the number of rays done.

    Returns:
      positions [K, 3] scene units, and rendered colours [K, 3] in [0, 1], of the K <= N rays that
      count.
    """
    positions, colours = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    num = len(view_ids)
    for start in range(0, num, chunk):
        rows = np.minimum(np.arange(start, start + chunk), num - 1)
        rays = _pixel_rays(table.cameras, view_ids[rows], within[rows])
        images = {name: np.asarray(x) for name, x in render_fn(rays).items()}
        counts = (np.arange(chunk) < num - start) & (images["opacity"] >= min_opacity)
        ends = np.asarray(rays.origins) + images["depth"][:, None] * np.asarray(rays.directions)
        positions.append(ends[counts])
        colours.append(np.clip(images["rgb"][counts], 0.0, 1.0))
        if progress_fn is not None:
            progress_fn(min(chunk, num - start))
    return np.concatenate(positions), np.concatenate(colours)


_pixel_rays = jax.jit(view_pixel_rays)
