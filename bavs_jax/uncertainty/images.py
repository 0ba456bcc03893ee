"""Renders of a field with measures of one's own beside colour and depth."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays, reduced_cameras, take
from bavs_jax.devices import jit_over_rays
from bavs_jax.rendering.images import RenderChunk, render_views
from bavs_jax.rendering.render import RayRendering, basic_images
from bavs_jax.training.train import TrainState
from bavs_jax.uncertainty.model import SceneSetup


def make_image_fn(
    setup: SceneSetup,
    kind: str,
    measures_fn: Callable[[RayRendering], dict[str, jax.Array]] | None = None,
) -> Callable[[TrainState, Rays], dict[str, jax.Array]]:
    """Makes the compiled renders of a kind of field, `basic_images` and further measures.

    Args:
      kind: a key of `setup.models`.
      measures_fn: the further measures, [R] each; they need a field that is sampled along rays.
    """
    model = setup.models[kind]

    def images(state, rays):
        rendering = model.render(state, rays)
        images = basic_images(rendering)
        if measures_fn is None:
            return images
        if not isinstance(rendering, RayRendering):
            raise TypeError(f"{kind}: has no samples along its rays, which the measures are of")
        return {**images, **measures_fn(rendering)}

    compiled = jit_over_rays(images, setup.mesh, sharded=(False, True))
    return lambda train, rays: compiled(train.model, rays)


def render_stack(
    image_fn: RenderChunk,
    cameras: Cameras,
    mask: Array,
    *,
    scale: float,
    chunk: int,
    names: Sequence[str] = ("rgb", "depth"),
) -> tuple:
    """Renders the marked views at a reduced size into arrays over all of them, 0 elsewhere.

    Args:
      image_fn: renders `chunk` rays.
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
