"""How far apart two surfaces are, both given as points spread evenly over them."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree


class SurfaceError(NamedTuple):
    """Distances between a predicted and a true surface, in the unit of the points."""

    accuracy: float  # mean distance from the prediction to the truth
    completeness: float  # mean distance from the truth to the prediction
    chamfer: float  # (accuracy + completeness) / 2
    precision: float  # share of the prediction within `distance` of the truth
    recall: float  # share of the truth within `distance` of the prediction
    f_score: float  # harmonic mean of precision and recall
    distance: float  # at which the shares are counted


def nearest_distances(points, targets) -> np.ndarray:
    """Distance from each point [N, 3] to the nearest of the targets [M, 3], M > 0: [N]."""
    return cKDTree(np.asarray(targets, np.float64)).query(np.asarray(points, np.float64))[0]


def surface_error(predicted, true, *, distance: float) -> SurfaceError:
    """Chamfer distance in both directions, and the F-score (Knapitsch et al. 2017).

    `accuracy = mean_p min_t |p - t|`, `completeness = mean_t min_p |p - t|`; distances are not
    squared. Papers also print the sum of the two, or squares.

    Two draws of one surface are not at distance 0: with N points on an area A they are about
    `0.5 sqrt(A / N)` apart, so draw densely, or compare with two draws of the truth.

    Args:
      predicted: [N, 3] points spread evenly over the predicted surface.
      true: [M, 3] over the true one, in the same unit.
      distance: up to which a point counts as right, >= 0.

    Raises:
      ValueError: no points, or a wrong shape.
    """
    for name, points in (("predicted", predicted), ("true", true)):
        if np.ndim(points) != 2 or np.shape(points)[1] != 3 or len(points) == 0:
            raise ValueError(f"{name}: has the shape {np.shape(points)}; give [N, 3], N > 0")
    to_truth, to_prediction = nearest_distances(predicted, true), nearest_distances(true, predicted)
    accuracy, completeness = float(to_truth.mean()), float(to_prediction.mean())
    precision, recall = (float((d <= distance).mean()) for d in (to_truth, to_prediction))
    both = precision + recall
    return SurfaceError(
        accuracy=accuracy,
        completeness=completeness,
        chamfer=0.5 * (accuracy + completeness),
        precision=precision,
        recall=recall,
        f_score=2.0 * precision * recall / both if both > 0.0 else 0.0,
        distance=float(distance),
    )
