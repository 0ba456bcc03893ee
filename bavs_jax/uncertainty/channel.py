"""Uncertainty as one more volume-rendered channel (Fig 4), whose mean is a view's score (Eq 15)."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.devices import jit_over_rays
from bavs_jax.fields.contraction import in_box, unit_coordinates
from bavs_jax.fields.deformation import DeformationGrid, interpolate, offset_unit
from bavs_jax.models.base import ModelState, RadianceModel
from bavs_jax.progress import Progress
from bavs_jax.registry import check_known
from bavs_jax.rendering.images import RenderChunk, render_views
from bavs_jax.rendering.render import Channel, basic_images
from bavs_jax.uncertainty.posterior import (
    bayesrays_vertex_variance,
    laplace_variance,
    posterior_precision,
)

VARIANTS = ("posterior", "bayesrays")
EXTENTS = ("box", "space")
SCALES = ("log", "sigma")
LOG10_MIN, LOG10_MAX = -3.0, 6.0

# See `make_render_chunk_fn`.
RenderChunkFn = Callable[[ModelState, Array | None, Rays], dict[str, jax.Array]]


def vertex_variance(
    jac_sq_sum: jax.Array, *, num_rays, prior_weight, weighting: str, variant: str
) -> jax.Array:
    """One variance per vertex [G], scene unit^2: what `make_uncertainty_channel` interpolates.

    `posterior`: `sum_d 1 / H_d`. `bayesrays`: `1 / (sum_d jac_sq_sum_d / R + lambda)`.

    Raises:
      ValueError: unknown variant.
    """
    if variant == "posterior":
        precision = posterior_precision(
            jac_sq_sum, num_rays=num_rays, prior_weight=prior_weight, weighting=weighting
        )
        return laplace_variance(precision).sum(-1)
    check_known("variant", variant, VARIANTS)
    return bayesrays_vertex_variance(jac_sq_sum, num_rays=num_rays, prior_weight=prior_weight)


def uncertainty_at(
    grid: DeformationGrid, variance: jax.Array, positions: jax.Array, *, variant: str
) -> jax.Array:
    """Standard deviation of the offset at points [..., 3], scene units.

    `posterior`: `sigma^2 = sum_k b_k^2 s_k`, the variance of `sum_k b_k theta_k`.
    `bayesrays`: the same weights normalised, `bhat_k = b_k^2 / sum_k b_k^2`.
    """
    summed = interpolate(grid, variance, positions, power=2)
    if variant == "bayesrays":
        summed = summed / interpolate(grid, jnp.ones_like(variance), positions, power=2)
    return jnp.sqrt(summed)


def make_uncertainty_channel(
    grid: DeformationGrid, variance: jax.Array, *, variant: str, scale: str, extent: str = "box"
) -> Channel:
    """The channel to hand to the renderer.

    What lies outside of the scene box counts like nothing at all (`extent`): sky and far hills,
    which no photo can place, would else be more uncertain than anything that a view could settle.

    Args:
      variance: [G] from `vertex_variance`.
      variant: one of `VARIANTS`.
      scale: `sigma` renders sigma over a floor of 0; `log` renders log10(sigma), sigma in
        `offset_unit`s, over a floor of -3. Finish either with `finish_uncertainty`.
      extent: `box`, or `space` for everything; they differ in unbounded scenes alone.

    Raises:
      ValueError: unknown scale or extent.
    """
    for name, value, known in (("scale", scale, SCALES), ("extent", extent, EXTENTS)):
        check_known(name, value, known)
    floor = 0.0 if scale == "sigma" else LOG10_MIN

    def value_fn(positions, directions):
        del directions
        sigma = uncertainty_at(grid, variance, positions, variant=variant)
        value = sigma if scale == "sigma" else jnp.log10(sigma / offset_unit(grid.box))
        if extent == "space":
            return value
        unit = unit_coordinates(grid.box, positions, contracted=grid.contracted)
        return jnp.where(in_box(unit, contracted=grid.contracted), value, floor)

    return Channel(value_fn, floor)


def finish_uncertainty(rendered: jax.Array, *, scale: str) -> jax.Array:
    """What is shown and scored: sigma as it is, log10 sigma clipped to [-3, 6] and put on [0, 1].

    A ray that meets nothing is 0 in both scales, so an empty background never counts.

    Differs from the paper, whose sigma is in scene units: here log10 is of sigma in `offset_unit`s.
    """
    if scale == "sigma":
        return rendered
    return (jnp.clip(rendered, LOG10_MIN, LOG10_MAX) - LOG10_MIN) / (LOG10_MAX - LOG10_MIN)


def make_render_chunk_fn(
    model: RadianceModel,
    grid: DeformationGrid,
    *,
    variant: str,
    scale: str,
    extent: str = "box",
    mesh: Mesh | None = None,
) -> RenderChunkFn:
    """Makes the compiled rendering of a chunk of rays, uncertainty included (Fig 4).

    The devices of a `mesh` (see `devices.py`) share the rays.

    Returns:
      `render_chunk(state, variance [G], rays)`, which gives of R rays the `basic_images`,
      "uncertainty" [R] on the scale asked for, and "sigma" [R], scene units; without the last two
      where the variance is None.
    """
    scales = {"uncertainty": scale, "sigma": "sigma"}

    def render_chunk(state, variance, rays):
        channels = {}
        if variance is not None:
            make = partial(make_uncertainty_channel, grid, variance, variant=variant, extent=extent)
            channels = {name: make(scale=scales[name]) for name in scales}
        rendering = model.render(state, rays, channels=channels)
        images = basic_images(rendering)
        for name, value in rendering.channels.items():
            images[name] = finish_uncertainty(value, scale=scales[name])
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
