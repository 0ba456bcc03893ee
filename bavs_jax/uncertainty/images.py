"""Renders of a field with measures of one's own beside colour and depth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bavs_jax.cameras import take
from bavs_jax.devices import jit_over_rays
from bavs_jax.rendering.images import render_views
from bavs_jax.rendering.pixels import basic_images, render_pixels
from bavs_jax.uncertainty.model import Toolbox
from bavs_jax.uncertainty.scoring import reduced_cameras


def make_image_fn(toolbox: Toolbox, kind: str, measures_fn: Callable | None = None) -> Callable:
    """Makes the compiled `images(train_state, rays [R]) -> dict` of a kind of field.

    Args:
      toolbox: the parts of a scene.
      kind: a key of `toolbox.fields`.
      measures_fn: `Rendering` of R rays -> dict of [R], beside `basic_images`.
    """
    field, sampler = toolbox.fields[kind]

    def images(params, sampler_state, rays):
        rendering, samples = render_pixels(
            field,
            sampler,
            params,
            sampler_state,
            rays,
            background=toolbox.background,
            capacity=toolbox.capacity,
        )
        more = {} if measures_fn is None else measures_fn(rendering)
        return {**basic_images(rendering, samples), **more}

    compiled = jit_over_rays(images, toolbox.mesh, spread=(False, False, True))
    return lambda train, rays: compiled(train.params, train.sampler_state, rays)


def render_stack(
    image_fn: Callable, cameras, mask, *, scale: float, chunk: int, names=("rgb", "depth")
) -> tuple:
    """Renders the marked views at a reduced size into arrays over all of them, 0 elsewhere.

    Args:
      image_fn: rays [chunk] -> dict.
      cameras: [V].
      mask: [V] bool, which to render.
      scale: of width and height.
      chunk: rays of one call.
      names: which images.

    Returns:
      the reduced cameras [V], and for each name an array [V, H, W, ...].

    Raises:
      ValueError: the views have images of different sizes.
    """
    small = reduced_cameras(cameras, scale)
    sizes = np.asarray(small.sizes)
    if (sizes != sizes[0]).any():
        raise ValueError(
            "views of different sizes cannot be stacked: choose another policy, or make the "
            "images one size"
        )
    width, height = (int(n) for n in sizes[0])
    rows = np.flatnonzero(mask)
    images = render_views(
        lambda rays: {name: value for name, value in image_fn(rays).items() if name in names},
        take(small, rows),
        np.arange(len(rows)),
        chunk=chunk,
    )
    shapes = {"rgb": (3,)}
    stacks = []
    for name in names:
        stack = np.zeros((len(sizes), height, width, *shapes.get(name, ())), np.float32)
        for row, image in zip(rows, images):
            stack[row] = image[name]
        stacks.append(stack)
    return (small, *stacks)
