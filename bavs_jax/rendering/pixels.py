"""Pixels of a trained field: samples where its sampler puts them, all of them evaluated."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Field
from bavs_jax.rendering.render import Rendering, render_rays
from bavs_jax.rendering.samplers import Sampler
from bavs_jax.rendering.sampling import Samples


def render_pixels(
    field: Field,
    sampler: Sampler,
    params: dict,
    sampler_state,
    rays: Rays,
    *,
    background,
    capacity: int,
    displace_fn: Callable | None = None,
    channels: dict | None = None,
) -> tuple[Rendering, Samples]:
    """Renders rays with a trained field; arguments as in `render_rays`.

    Args:
      field, sampler: the field and how rays are sampled for it.
      params: {"field", "sampler"}, as trained.
      sampler_state: what the sampler carries untrained.
      rays: R rays.
    """
    samples, _ = sampler.sample(None, params["sampler"], sampler_state, rays)
    rendering = render_rays(
        rays,
        samples,
        partial(field.apply, params["field"]),
        background=background,
        capacity=capacity,
        exact=True,
        inputs=field.inputs(rays, samples),
        displace_fn=displace_fn,
        channels=channels,
    )
    return rendering, samples


def basic_images(rendering: Rendering, samples: Samples) -> dict[str, jax.Array]:
    """What every render gives: "rgb" [R, 3], "depth", "opacity" and "thinned" [R]."""
    return {
        "rgb": rendering.rgb,
        "depth": rendering.depth,
        "opacity": rendering.opacity,
        "thinned": samples.thinned,
    }
