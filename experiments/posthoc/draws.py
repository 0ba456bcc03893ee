"""A run under offsets drawn from its posterior, and how far pixels move (Fig 3)."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

from bavs_jax.fields.deformation import DeformationGrid, vertex_positions
from bavs_jax.metrics.covered import MIN_OPACITY
from bavs_jax.rendering.images import render_views
from bavs_jax.uncertainty.draws import (
    colour_deviation,
    draw_offsets,
    make_displaced_render_fn,
    noise_scale,
)
from experiments.build import stream_key
from experiments.build_model import RENDER_CHUNK
from experiments.runtime import track
from experiments.trained import TrainedRun, run_curvature, run_precision


class ViewDraws(NamedTuple):
    """One view under the mode and under D draws."""

    view_id: int  # row of the pixel table
    rgb: np.ndarray  # [H, W, 3] at the mode, `theta = 0`
    opacity: np.ndarray  # [H, W] at the mode
    uncertainty: np.ndarray  # [H, W] rendered channel of the run
    draws: np.ndarray  # [D, H, W, 3]

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the colour over draws, [H, W]."""
        return np.asarray(colour_deviation(self.draws))


def farthest_view(run: TrainedRun, view_ids) -> int:
    """The view whose camera is farthest from its nearest training camera."""
    positions = np.asarray(run.state.table.cameras.positions)
    gaps = positions[view_ids][:, None] - positions[run.training_views]
    return int(view_ids[np.argmax(np.linalg.norm(gaps, axis=-1).min(-1))])


def largest_offset(grid: DeformationGrid, cells: float) -> np.ndarray:
    """The sides of `cells` cells in the middle of the deformation grid, [3] scene units."""
    side, middle = grid.cells + 1, grid.cells // 2
    places = np.asarray(vertex_positions(grid)).reshape(side, side, side, 3)
    ahead = places[middle + 1, middle + 1, middle + 1]
    return cells * (ahead - places[middle, middle, middle])


def draw_views(
    run: TrainedRun, view_ids, *, num_draws: int, scale: float | None, limit
) -> tuple[list[ViewDraws], float]:
    """Renders views at the mode and for every draw.

    Args:
      run: the run.
      view_ids: [n] rows of the pixel table, training views among them.
      num_draws: D >= 2.
      scale: temperature of `draw_offsets`; None takes `noise_scale` of the training views shown.
      limit: largest offset, scene units.

    Returns:
      The views in their order, and the scale.
    """
    train, cameras = run.state.train, run.state.table.cameras
    rays_per_pixel = run.config.rays_per_pixel
    total = rays_per_pixel * int(np.diff(np.asarray(run.state.table.offsets))[view_ids].sum())
    jac_sq_sum = run_curvature(run)
    modes = run.problem.render(train, jac_sq_sum, run.num_rays)
    with track(total, f"{run.label}: {len(view_ids)} views", "rays") as bar:
        images = render_views(
            modes,
            cameras,
            view_ids,
            chunk=RENDER_CHUNK,
            rays_per_pixel=rays_per_pixel,
            progress_fn=bar.advance,
        )
    if scale is None:
        seen = set(run.training_views.tolist())
        squares = [
            np.square(image["rgb"] - run.truth(v))[run.pixel_mask(v)].mean()
            for v, image in zip(view_ids, images)
            if int(v) in seen
        ]
        scale = float(noise_scale(np.mean(squares), run.num_rays))

    displaced = make_displaced_render_fn(run.setup.model, run.setup.grid)
    precision, key = run_precision(run, jac_sq_sum), stream_key(run.seed, "draws")
    by_draw = []
    with track(total * num_draws, f"{run.label}: {num_draws} draws", "rays") as bar:
        for draw in range(num_draws):
            draw_key = jax.random.fold_in(key, draw)
            (theta,) = draw_offsets(draw_key, precision, 1, scale=scale, limit=jnp.asarray(limit))
            moved = partial(displaced, train.model, theta)

            def render_rgb(rays, moved=moved):
                return {"rgb": moved(rays)["rgb"]}

            rendered = render_views(
                render_rgb,
                cameras,
                view_ids,
                chunk=RENDER_CHUNK,
                rays_per_pixel=rays_per_pixel,
                progress_fn=bar.advance,
            )
            by_draw.append([image["rgb"] for image in rendered])
    views = []
    for view, image, draws in zip(view_ids, images, zip(*by_draw)):
        shown = (image[name] for name in ("rgb", "opacity", "uncertainty"))
        views.append(ViewDraws(int(view), *shown, np.stack(draws)))
    return views, scale


def spread_measures(views: list[ViewDraws]) -> dict[str, float | None]:
    """How far pixels move, and whether they do so where the uncertainty says.

    Over the pixels of all views whose opacity at the mode is at least `MIN_OPACITY`; `spread_all`
    is over all pixels. `rank_correlation` is Spearman's, of the spread over draws with the rendered
    uncertainty; None where either is the same everywhere.
    """
    spread = np.concatenate([view.spread.ravel() for view in views])
    uncertainty = np.concatenate([view.uncertainty.ravel() for view in views])
    covered = np.concatenate([view.opacity.ravel() for view in views]) >= MIN_OPACITY
    measures: dict[str, float | None] = {
        "num_views": len(views),
        "num_covered_pixels": int(covered.sum()),
        "spread": float(spread[covered].mean()) if covered.any() else None,
        "spread_all": float(spread.mean()),
        "rank_correlation": None,
    }
    if covered.any() and np.ptp(spread[covered]) > 0 and np.ptp(uncertainty[covered]) > 0:
        correlation = spearmanr(spread[covered], uncertainty[covered]).statistic
        measures["rank_correlation"] = float(correlation)
    return measures
