"""What a candidate view is worth: the mean of its rendered uncertainty (Eq 15)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jax.sharding import Mesh

from bavs_jax.cameras import Cameras, rescale
from bavs_jax.devices import jit_over_rays
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.images import render_views
from bavs_jax.rendering.pixels import basic_images, render_pixels
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
    extent: str = "box",
    mesh: Mesh | None = None,
) -> Callable:
    """Makes the compiled rendering of a chunk of rays, uncertainty included (Fig 4).

    The devices of a `mesh` (see `devices.py`) share the rays; each has a buffer of `capacity`.

    Returns:
      `render_chunk(params, sampler_state, variance [G], rays [R]) -> {"rgb" [R, 3], "depth" [R],
      "opacity" [R], "thinned" [R], "uncertainty" [R]}`; without the last where `variance` is None.
    """

    def render_chunk(params, sampler_state, variance, rays):
        channels = {}
        if variance is not None:
            channels["uncertainty"] = make_uncertainty_channel(
                grid, variance, variant=variant, scale=scale, extent=extent
            )
        rendering, samples = render_pixels(
            field,
            sampler,
            params,
            sampler_state,
            rays,
            background=background,
            capacity=capacity,
            channels=channels,
        )
        images = basic_images(rendering, samples)
        for name, value in rendering.channels.items():
            images[name] = finish_uncertainty(value, scale=scale)
        return images

    return jit_over_rays(render_chunk, mesh, spread=(False, False, False, True))


def reduced_cameras(cameras: Cameras, image_scale: float) -> Cameras:
    """The same cameras with images of `image_scale` times the width and height, at least 1 px."""
    sizes = np.maximum(np.round(np.asarray(cameras.sizes) * image_scale), 1).astype(np.int32)
    return rescale(cameras, sizes)


def mean_uncertainty(
    chunk_fn: Callable, cameras: Cameras, *, chunk, measure="uncertainty", progress_fn=None
):
    """Score of candidates, `f = |U|_1 / (W H)` over the pixels of each one's image (Eq 15).

    Args:
      chunk_fn: `Rays` [chunk] -> dict with `measure` [chunk], >= 0.
      cameras: n candidates, mostly of a reduced size (`reduced_cameras`).
      chunk: rays of one compiled call.
      measure: which image's mean is taken.
      progress_fn: called with the number of rays done since the last call.

    Returns:
      [n] float32 in the unit of the channel.
    """
    images = render_views(
        lambda rays: {measure: chunk_fn(rays)[measure]},
        cameras,
        np.arange(len(cameras)),
        chunk=chunk,
        progress_fn=progress_fn,
    )
    return np.array([image[measure].mean() for image in images], np.float32)
