"""What a candidate view is worth: the mean of its rendered uncertainty (Eq 15)."""

from collections.abc import Callable

import jax
import numpy as np
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.devices import jit_over_rays
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.progress import Progress
from bavs_jax.rendering.images import RenderChunk, render_views
from bavs_jax.rendering.render import basic_images
from bavs_jax.uncertainty.channel import finish_uncertainty, make_uncertainty_channel


def make_render_chunk_fn(
    model: RadianceModel,
    grid: DeformationGrid,
    *,
    variant: str,
    scale: str,
    extent: str = "box",
    mesh: Mesh | None = None,
) -> Callable[[ModelState, Array | None, Rays], dict[str, jax.Array]]:
    """Makes the compiled rendering of a chunk of rays, uncertainty included (Fig 4).

    The devices of a `mesh` (see `devices.py`) share the rays.

    Returns:
      `render_chunk(state, variance [G], rays)`, which gives of R rays the `basic_images` and
      "uncertainty" [R]; without the last where the variance is None.
    """

    def render_chunk(state, variance, rays):
        channels = {}
        if variance is not None:
            channels["uncertainty"] = make_uncertainty_channel(
                grid, variance, variant=variant, scale=scale, extent=extent
            )
        rendering = model.render(state, rays, channels=channels)
        images = basic_images(rendering)
        for name, value in rendering.channels.items():
            images[name] = finish_uncertainty(value, scale=scale)
        return images

    return jit_over_rays(render_chunk, mesh, sharded=(False, False, True))


def mean_uncertainty(
    chunk_fn: RenderChunk,
    cameras: Cameras,
    *,
    chunk: int,
    measure: str = "uncertainty",
    progress_fn: Progress | None = None,
) -> np.ndarray:
    """Score [n] of candidates, `f = |U|_1 / (W H)` over the pixels of each one's image (Eq 15).

    Args:
      chunk_fn: renders `measure` of `chunk` rays, >= 0.
      cameras: n candidates, mostly of a reduced size (`reduced_cameras`).
      chunk: rays of one compiled call.
      measure: which image's mean is taken.
      progress_fn: called with the number of rays done since the last call.
    """
    images = render_views(
        lambda rays: {measure: chunk_fn(rays)[measure]},
        cameras,
        np.arange(len(cameras)),
        chunk=chunk,
        progress_fn=progress_fn,
    )
    return np.array([image[measure].mean() for image in images], np.float32)
