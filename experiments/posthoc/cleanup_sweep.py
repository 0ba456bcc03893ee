"""Renders views at every threshold of a clean-up, and measures them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np

from bavs_jax.metrics.covered import Sweep, pixel_sums, sweep_of
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.cleanup import make_cleaned_render_fn
from experiments.build import RENDER_CHUNK
from experiments.progress import track
from experiments.trained import TrainedRun


def make_cleaned_chunk_fn(run: TrainedRun, variance) -> Callable:
    """Makes `cleaned(thresholds [T]) -> (Rays [chunk] -> dict)` of a run's field."""
    tools = run.toolbox
    field, sampler = tools.fields[tools.kind]
    render = make_cleaned_render_fn(
        field,
        sampler,
        tools.grid,
        background=tools.background,
        capacity=tools.capacity,
        variant=tools.laplace.variant,
        extent=tools.laplace.extent,
    )
    train = run.state.train

    def cleaned(thresholds):
        thresholds = jnp.asarray(thresholds, jnp.float32)
        return partial(render, train.params, train.sampler_state, variance, thresholds)

    return cleaned


def sweep_views(
    cleaned: Callable, run: TrainedRun, view_ids, thresholds, *, min_opacity: float, label: str
) -> Sweep:
    """Measures of views for all thresholds; pixels that the scene masks do not count.

    Args:
      cleaned: from `make_cleaned_chunk_fn`.
      run: the run.
      view_ids: [n] rows of the pixel table.
      thresholds: [T] ascending, the last +inf.
      min_opacity: from which on a pixel is covered.
      label: for progress.
    """
    table, sums = run.state.table, []
    offsets = np.asarray(table.offsets)
    total = int(np.diff(offsets)[view_ids].sum())
    chunk_fn = cleaned(thresholds)
    with track(total, f"{run.label}: {label}", "rays") as bar:
        # One view at a time: its images at every threshold are T times as large as the view.
        for view in view_ids:
            (images,) = render_views(
                chunk_fn, table.cameras, [view], chunk=RENDER_CHUNK, progress_fn=bar.advance
            )
            mask = run.pixel_mask(view)
            counted = {name: value[mask] for name, value in images.items()}
            sums.append(
                pixel_sums(
                    counted,
                    run.truth(view)[mask],
                    background=run.toolbox.background,
                    min_opacity=min_opacity,
                )
            )
    return sweep_of(thresholds, sums)
