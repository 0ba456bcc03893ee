"""What a candidate's render is really off by: known only where its photo is at hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from PIL import Image

from bavs_jax.cameras import take
from bavs_jax.rendering.images import render_views
from bavs_jax.scenes.base import Scene
from bavs_jax.uncertainty.scoring import reduced_cameras


def make_true_error_fn(
    render_fn: Callable, scene: Scene, *, image_scale: float, chunk: int
) -> Callable:
    """Makes the mean squared colour error of renders against the photos themselves.

    Args:
      render_fn: state -> (`Rays` [chunk] -> dict with "rgb").
      scene: the scene with its photos.
      image_scale: of width and height; photos are reduced by the mean over areas.
      chunk: rays of one compiled call.

    Returns:
      `true_error(state, view_ids [n]) -> [n]`, colours in [0, 1].
    """

    def true_error(state, view_ids):
        view_ids = np.asarray(view_ids)
        small = reduced_cameras(take(scene.cameras, view_ids), image_scale)
        chunk_fn = render_fn(state)
        rows = np.arange(len(view_ids))
        images = render_views(lambda rays: {"rgb": chunk_fn(rays)["rgb"]}, small, rows, chunk=chunk)
        errors = []
        for view, image in zip(view_ids, images):
            height, width = image["rgb"].shape[:2]
            photo = Image.fromarray(scene.image(view)).resize((width, height), Image.Resampling.BOX)
            errors.append(np.square(image["rgb"] - np.asarray(photo) / 255.0).mean())
        return np.array(errors, np.float32)

    return true_error
