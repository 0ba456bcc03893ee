"""What a candidate view is worth: the mean of its rendered uncertainty (Eq 15)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from bavs_jax.cameras import Cameras, rescale, take
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.images import render_views
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.sampling import MarchOptions, march
from bavs_jax.uncertainty.channel import finish_uncertainty, make_uncertainty_channel


def make_render_chunk_fn(
    field: Field,
    grid: DeformationGrid,
    march_options: MarchOptions,
    *,
    background,
    capacity: int,
    variant: str,
    scale: str,
) -> Callable:
    """Makes the compiled rendering of a chunk of rays, uncertainty included (Fig 4).

    Returns:
      `render_chunk(params, occupancy, variance [G], rays [R]) -> {"rgb" [R, 3], "depth" [R],
      "opacity" [R], "uncertainty" [R], "thinned" [R]}`.
    """

    @jax.jit
    def render_chunk(params, occupancy, variance, rays):
        samples = march(rays, occupancy, march_options)
        channel = make_uncertainty_channel(grid, variance, variant=variant, scale=scale)
        rendering = render_rays(
            rays,
            samples,
            partial(field.apply, params),
            background=background,
            capacity=capacity,
            exact=True,
            channels={"uncertainty": channel},
        )
        return {
            "rgb": rendering.rgb,
            "depth": rendering.depth,
            "opacity": rendering.opacity,
            "uncertainty": finish_uncertainty(rendering.channels["uncertainty"], scale=scale),
            "thinned": samples.thinned,
        }

    return render_chunk


def reduced_cameras(cameras: Cameras, image_scale: float) -> Cameras:
    """The same cameras with images of `image_scale` times the width and height, at least 1 px."""
    sizes = np.maximum(np.round(np.asarray(cameras.sizes) * image_scale), 1).astype(np.int32)
    return rescale(cameras, sizes)


def mean_uncertainty(
    chunk_fn: Callable, cameras: Cameras, indices: np.ndarray, *, image_scale, chunk, progress_fn
) -> np.ndarray:
    """Score of candidates, `f = |U|_1 / (W H)` over an image of reduced size (Eq 15).

    Args:
      chunk_fn: `Rays` [chunk] -> dict with "uncertainty" [chunk], >= 0.
      cameras: C candidates.
      indices: [n] int, which of them.
      image_scale: factor on width and height.
      chunk: rays of one compiled call.
      progress_fn: called with the number of rays done since the last call, or None.

    Returns:
      [n] float32 in the unit of the channel.
    """
    small = reduced_cameras(take(cameras, np.asarray(indices)), image_scale)
    images = render_views(
        lambda rays: {"uncertainty": chunk_fn(rays)["uncertainty"]},
        small,
        np.arange(len(indices)),
        chunk=chunk,
        progress_fn=progress_fn,
    )
    return np.array([image["uncertainty"].mean() for image in images], np.float32)
