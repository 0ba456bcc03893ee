"""What a candidate view is worth: the mean of its rendered uncertainty (Eq 15)."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from bavs_jax.cameras import Cameras, rescale
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.images import render_views
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.uncertainty.channel import finish_uncertainty, make_uncertainty_channel


def make_render_chunk_fn(
    field: Field,
    sampler: Sampler,
    grid: DeformationGrid,
    *,
    background,
    capacity: int,
    variant: str,
    scale: str,
) -> Callable:
    """Makes the compiled rendering of a chunk of rays, uncertainty included (Fig 4).

    Returns:
      `render_chunk(params, sampler_state, variance [G], rays [R]) -> {"rgb" [R, 3], "depth" [R],
      "opacity" [R], "thinned" [R], "uncertainty" [R]}`; without the last where `variance` is None.
    """

    @jax.jit
    def render_chunk(params, sampler_state, variance, rays):
        samples, _ = sampler.sample(None, params["sampler"], sampler_state, rays)
        channels = {}
        if variance is not None:
            channels["uncertainty"] = make_uncertainty_channel(
                grid, variance, variant=variant, scale=scale
            )
        rendering = render_rays(
            rays,
            samples,
            partial(field.apply, params["field"]),
            background=background,
            capacity=capacity,
            exact=True,
            inputs=field.inputs(rays, samples),
            channels=channels,
        )
        return {
            "rgb": rendering.rgb,
            "depth": rendering.depth,
            "opacity": rendering.opacity,
            "thinned": samples.thinned,
            **{
                name: finish_uncertainty(value, scale=scale)
                for name, value in rendering.channels.items()
            },
        }

    return render_chunk


def reduced_cameras(cameras: Cameras, image_scale: float) -> Cameras:
    """The same cameras with images of `image_scale` times the width and height, at least 1 px."""
    sizes = np.maximum(np.round(np.asarray(cameras.sizes) * image_scale), 1).astype(np.int32)
    return rescale(cameras, sizes)


def mean_uncertainty(chunk_fn: Callable, cameras: Cameras, *, chunk, progress_fn=None):
    """Score of candidates, `f = |U|_1 / (W H)` over the pixels of each one's image (Eq 15).

    Args:
      chunk_fn: `Rays` [chunk] -> dict with "uncertainty" [chunk], >= 0.
      cameras: n candidates, mostly of a reduced size (`reduced_cameras`).
      chunk: rays of one compiled call.
      progress_fn: called with the number of rays done since the last call.

    Returns:
      [n] float32 in the unit of the channel.
    """
    images = render_views(
        lambda rays: {"uncertainty": chunk_fn(rays)["uncertainty"]},
        cameras,
        np.arange(len(cameras)),
        chunk=chunk,
        progress_fn=progress_fn,
    )
    return np.array([image["uncertainty"].mean() for image in images], np.float32)
