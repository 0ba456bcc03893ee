"""A run under offsets drawn from its posterior, and how far pixels move (Fig 3)."""

from functools import partial

import jax
import numpy as np
from scipy.stats import spearmanr

from bavs_jax.metrics.covered import MIN_OPACITY
from bavs_jax.selection.distances import nearest_distances
from bavs_jax.uncertainty.draws import (
    colour_deviation,
    draw_offsets,
    make_displaced_render_fn,
    noise_scale,
)
from bavs_jax.uncertainty.posterior import posterior_precision
from experiments.build import stream_key
from experiments.trained import TrainedRun


def farthest_view(run: TrainedRun, view_ids) -> int:
    """The view whose camera is farthest from its nearest training camera."""
    positions, is_training = run.state.table.cameras.positions, run.state.is_training_view
    return int(view_ids[nearest_distances(positions[view_ids], positions, is_training).argmax()])


def draw_views(
    run: TrainedRun, view_ids, *, num_draws: int, scale: float, limit
) -> tuple[list[dict], float]:
    """Renders views at the mode and for every draw.

    Args:
      run: the run.
      view_ids: [n] rows of the pixel table, training views among them.
      num_draws: D >= 2.
      scale: temperature of `draw_offsets`; 0 takes `noise_scale` of the training views shown.
      limit: largest offset, scene units.

    Returns:
      Of each view `view_id`, images of the mode (`theta = 0`) with the run's "uncertainty", and
      "draws" [D, H, W, 3]; and the scale.
    """
    train, setup = run.state.train, run.problem.setup
    jac_sq_sum, laplace = run.curvature(), setup.laplace
    with run.track(view_ids, f"{len(view_ids)} views") as bar:
        modes = run.problem.render(train, jac_sq_sum, run.num_rays)
        images = run.render(modes, view_ids, bar.advance)
    if not scale:
        squares = []
        for view, image in zip(view_ids, images):
            truth, mask = run.photo(view)
            if run.state.is_training_view[view]:
                squares.append(np.square(image["rgb"] - truth)[mask].mean())
        scale = float(noise_scale(np.mean(squares), run.num_rays))

    displaced, by_draw = make_displaced_render_fn(setup.model, setup.grid), []
    precision = posterior_precision(
        jac_sq_sum,
        num_rays=run.num_rays,
        prior_weight=laplace.prior_weight,
        weighting=laplace.weighting,
    )
    with run.track(view_ids, f"{num_draws} draws", num_draws) as bar:
        for draw in range(num_draws):
            key = jax.random.fold_in(stream_key(run.seed, "draws"), draw)
            (theta,) = draw_offsets(key, precision, 1, scale=scale, limit=limit)
            moved = run.render(partial(displaced, train.model, theta), view_ids, bar.advance)
            by_draw.append([image["rgb"] for image in moved])
    views = [
        {**image, "view_id": int(view), "draws": np.stack(draws)}
        for view, image, draws in zip(view_ids, images, zip(*by_draw))
    ]
    return views, scale


def spread_measures(views: list[dict]) -> dict[str, float | None]:
    """How far pixels move, and whether they do so where the uncertainty says.

    Over the pixels of all views whose opacity at the mode is at least `MIN_OPACITY`; `spread_all`
    is over all pixels. `rank_correlation` is Spearman's, of the spread over draws with the rendered
    uncertainty; None where either is the same everywhere.
    """
    spread = np.concatenate([np.ravel(colour_deviation(view["draws"])) for view in views])
    opacity, uncertainty = (
        np.concatenate([view[name].ravel() for view in views])
        for name in ("opacity", "uncertainty")
    )
    covered = opacity >= MIN_OPACITY
    moved, uncertain = spread[covered], uncertainty[covered]
    varies = covered.any() and np.ptp(moved) > 0 and np.ptp(uncertain) > 0
    return {
        "num_views": len(views),
        "num_covered_pixels": int(covered.sum()),
        "spread": float(moved.mean()) if covered.any() else None,
        "spread_all": float(spread.mean()),
        "rank_correlation": float(spearmanr(moved, uncertain).statistic) if varies else None,
    }
