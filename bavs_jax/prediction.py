"""Predicts, from the field and its posterior alone, what a chosen batch will be worth.

Definitions and formulas are in `selection/predicted_gain.py`; this gathers what they are made of.
Every curvature is summed over images of a reduced size and scaled up to the pixels of the photos,
so that a prediction costs about as much as to look at the candidates once.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from bavs_jax.cameras import Cameras
from bavs_jax.candidates import Candidates
from bavs_jax.fields.deformation import cell_sides, vertices_in_box
from bavs_jax.selection.predicted_gain import (
    batch_information,
    distance_gain_db,
    offset_precision,
    variance_gain_db,
    views_gain_db,
)
from bavs_jax.sources import WEIGHTING, make_view_rays_fn
from bavs_jax.training.batches import PixelTable
from bavs_jax.uncertainty.model import Situation, Toolbox

# Candidates, evenly spaced in their order, whose rays stand for those of test views.
NUM_REFERENCE = 16


def make_predict_fn(
    toolbox: Toolbox, *, image_scale: float, num_reference: int = NUM_REFERENCE
) -> Callable:
    """Makes `predict(situation, candidates, batches) -> list of dicts`, one for each batch.

    `batches` are candidates' indices [k] each, taken one after another: what is predicted of the
    second is what it adds to the first. The field stays that of the situation. By each definition
    one number:

    - `variance_db`: the predicted gain, dB, with a prior of one grid cell (`variance_gain_db`).
    - `paper_prior_db`: the same with the paper's prior, `2 lambda`.
    - `information_nats`: what the batch tells of the offsets, with the paper's prior.
    - `views_db`: from the number of views alone.
    - `distance_db`: from camera positions alone, over all candidates; None where it is infinite.

    Reference rays are those of candidates, chosen views among them: where one may stand is where
    one wants to be right.

    Args:
      toolbox: the parts of a scene.
      image_scale: of width and height of the images that are looked at.
      num_reference: views whose rays are the reference.
    """

    def predict(situation: Situation, candidates: Candidates, batches) -> list[dict]:
        cameras = candidates.cameras
        num = min(len(cameras), num_reference)
        places = np.arange(num) * len(cameras) // num
        table, is_training = situation.table, np.flatnonzero(situation.is_training_view)
        known = summed_curvature(
            *(toolbox, situation, table.cameras, is_training, image_scale), table
        )
        reference = summed_curvature(toolbox, situation, cameras, places, image_scale)
        cell_prior = offset_precision(cell_sides(toolbox.grid), num_rays=situation.num_rays)
        paper_prior = 2.0 * toolbox.laplace.prior_weight
        positions = np.asarray(cameras.positions)
        chosen = np.asarray(table.cameras.positions)[is_training]
        predictions = []
        for batch in batches:
            picks = np.asarray(batch)
            added = summed_curvature(toolbox, situation, cameras, picks, image_scale)
            distance = distance_gain_db(positions, chosen, positions[picks])
            predictions.append(
                {
                    "variance_db": variance_gain_db(reference, known + cell_prior, added),
                    "paper_prior_db": variance_gain_db(reference, known + paper_prior, added),
                    "information_nats": batch_information(known + paper_prior, added),
                    "views_db": views_gain_db(len(chosen), len(picks)),
                    "distance_db": distance if math.isfinite(distance) else None,
                }
            )
            known = known + added
            chosen = np.concatenate([chosen, positions[picks]])
        return predictions

    return predict


def summed_curvature(
    toolbox: Toolbox,
    situation: Situation,
    cameras: Cameras,
    indices,
    image_scale: float,
    table: PixelTable | None = None,
) -> np.ndarray:
    """What the photos of some cameras together add to the precision, [G, 3] float64 >= 0.

    As `make_candidate_curvature_fn`, but one sum over all of `indices` [n]. Views of different
    sizes are scaled up together, in proportion to the pixels of their reduced images. `table`:
    where they are views trained on, see `make_view_rays_fn`.
    """
    of_rays, places, scale = make_view_rays_fn(cameras, image_scale, table)(indices)
    total = np.asarray(
        toolbox.curvature(situation.train, label=None, weighting=WEIGHTING, **of_rays), np.float64
    )
    if toolbox.laplace.extent == "box":
        total = total * np.asarray(vertices_in_box(toolbox.grid))[:, None]
    # A sum of squares that was summed in another order may fall short of 0 by its rounding.
    return 2.0 / situation.num_rays * scale[places].mean() * np.maximum(total, 0.0)
