"""What a set of training views can be described by, and how much of its quality that explains."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

from bavs_jax.cameras import pixel_rays, project, view_pixels
from bavs_jax.scenes.base import Scene
from bavs_jax.uncertainty.gaps import UNSEEN, gap_of

NUM_POINTS = 5000  # of the surface, that a set is described by
BUFFER_POINTS = 200_000  # of the surface, that decide which of those hide behind others
TOLERANCE = 0.01  # of the box's diagonal, within which depths are of one surface,
SLANT = 3.0  # and as many widths of a pixel more: a surface seen at 70 degrees
PER_PLACE = 8  # points that a place of a depth buffer has in the mean, at least
FOLDS = 10
ROUNDING = 1e-5  # as share of the largest: cameras on a sphere are equally far


class Surface(NamedTuple):
    """Points that test views show, and which views of the pool see them."""

    points: np.ndarray  # [P, 3] scene units
    towards: np.ndarray  # [P, 3] unit, to the test camera
    distance: np.ndarray  # [P] to it, scene units
    view: np.ndarray  # [P] which of the test views
    width: np.ndarray  # [P] of its pixel there, scene units
    seen: np.ndarray  # [V, P] bool, of all views of the scene; only the pool's are filled


def visible_surface(scene: Scene, *, seed: int = 0) -> Surface | None:
    """Random pixels of test views on their true surface; None where no depth is known.

    A view sees a point if nothing of the surface is nearer in its pixel. That is asked of a depth
    buffer into which many such points are thrown, so that views of the pool need no depth.
    """
    if scene.depth is None:
        return None
    view_ids, pixels = view_pixels(scene.cameras, scene.test)
    rows = np.concatenate([np.arange(len(scene.pixels))[scene.view_slice(v)] for v in scene.test])
    known = np.flatnonzero(scene.depth[rows] > 0.0)
    if not len(known):
        return None
    kept = np.random.default_rng(seed).permutation(known)[:BUFFER_POINTS]
    rays = jax.tree.map(np.asarray, pixel_rays(scene.cameras, view_ids[kept], pixels[kept]))
    points = rays.origins + scene.depth[rows[kept]][:, None] * rays.directions
    few = slice(None, NUM_POINTS)
    of_test, distance = view_ids[kept][few], scene.depth[rows[kept]][few]
    focal = np.asarray(scene.cameras.intrinsics[:, 0])
    seen = np.zeros((scene.num_views, len(points[few])), bool)
    tolerance = TOLERANCE * float(np.linalg.norm(scene.box[1] - scene.box[0]))
    for view in scene.pool:
        seen[view] = _seen_by(scene, view, points, tolerance)[few]
    return Surface(
        points=points[few],
        towards=-rays.directions[few],
        distance=distance,
        view=of_test,
        width=distance / focal[of_test],
        seen=seen,
    )


_project = jax.jit(project)


def _seen_by(scene: Scene, view: int, points: np.ndarray, tolerance: float) -> np.ndarray:
    """Which points [N] a view sees, by a depth buffer of these points."""
    camera = jax.tree.map(lambda x: x[view], scene.cameras)
    pixels, inside = map(np.asarray, _project(camera, jnp.asarray(points)))
    width, height = (int(n) for n in np.asarray(scene.cameras.sizes)[view])
    # Where a place of the buffer has no point, what lies behind would count as seen.
    side = max(1.0, np.sqrt(PER_PLACE * width * height / max(inside.sum(), 1)))  # pixels
    columns = int(width / side) + 1
    places = (pixels / side).astype(int)
    place = places[:, 1] * columns + places[:, 0]
    depth = np.linalg.norm(points - np.asarray(camera.positions), axis=-1)
    buffer = np.full(columns * (int(height / side) + 1), np.inf)
    np.minimum.at(buffer, place[inside], depth[inside])
    slack = tolerance + SLANT * side * depth / float(camera.intrinsics[0])
    return inside & (depth <= buffer[place] + slack)


def describe(scene: Scene, views: np.ndarray, surface: Surface | None) -> dict[str, float]:
    """Numbers of a set of views, all of which may say how good a field will be.

    Distances between cameras are in units of the median camera distance from the scene's centre.

    Args:
      scene: whose views they are.
      views: [n] ids.
      surface: from `visible_surface`; None leaves out what needs it.

    Returns:
      `candidates_gap`, `test_gap`: mean squared distance of a view of the pool, or of the test
      split, to the nearest of the set; `..._largest`: the largest distance; `elevation`: mean
      height over the centre, as the sine of the angle; `distance`: mean camera distance;
      `unseen`: share of the surface in test views that no view of the set sees; `sides`: mean of
      `(1 - cos a) / 2` over that surface, a the angle at the point between the test camera and
      the nearest view of the set that sees it, 1 where none does; `resolution`: mean of
      `log2(d_test / d_set)` over what is seen, d the distance of the closest one; `gaps`: the mean
      predicted log error of test views (`selection/gaps.py`), on the true surface.
    """
    positions, centre = np.asarray(scene.cameras.positions, np.float64), scene.centre
    offsets = positions - centre
    radii = np.linalg.norm(offsets, axis=-1)
    unit = float(np.median(radii[scene.pool]))
    found = {}
    for name, others in (("candidates", scene.pool), ("test", scene.test)):
        apart = np.linalg.norm(positions[others][:, None] - positions[views], axis=-1) / unit
        nearest = apart.min(axis=1)
        found[f"{name}_gap"] = float(np.mean(nearest**2))
        found[f"{name}_gap_largest"] = float(nearest.max())
    found["elevation"] = float(np.mean(offsets[views] @ np.asarray(scene.up) / radii[views]))
    found["distance"] = float(np.mean(radii[views]) / unit)
    if surface is None:
        return found
    seen = surface.seen[views]  # [n, P]
    apart = positions[views][:, None] - surface.points
    distance = np.linalg.norm(apart, axis=-1)
    cosine = (apart / distance[..., None] * surface.towards).sum(-1)
    found["unseen"] = float(np.mean(~seen.any(axis=0)))
    sides = np.where(seen, (1.0 - cosine) / 2.0, 1.0).min(axis=0)
    found["sides"] = float(np.mean(sides))
    closest = np.where(seen, distance, np.inf).min(axis=0)
    is_seen = np.isfinite(closest)
    ratio = np.log2(surface.distance[is_seen] / closest[is_seen])
    found["resolution"] = float(np.mean(ratio)) if is_seen.any() else 0.0
    width = distance / np.asarray(scene.cameras.intrinsics)[views, :1]
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    closeness = np.where(seen, 1.0 / gap_of(angle, width / surface.width), 0.0)
    errors = 1.0 / (UNSEEN + closeness.sum(axis=0))
    _, view, counts = np.unique(surface.view, return_inverse=True, return_counts=True)
    found["gaps"] = float(np.mean(np.log(np.bincount(view, errors) / counts)))
    return found


# --- what it explains ------------------------------------------------------------------------


def correlation(x: np.ndarray, y: np.ndarray) -> float | None:
    """Spearman's rank correlation of [N] and [N]; None where either varies by rounding alone."""
    if any(np.ptp(values) <= ROUNDING * np.abs(values).max() for values in (x, y)):
        return None
    return float(spearmanr(x, y).statistic)


def explained(features: np.ndarray, target: np.ndarray, *, seed: int = 0) -> float | None:
    """Share of a target's variance that least squares predict for sets they have not seen.

    `R^2 = 1 - sum (y - yhat)^2 / sum (y - mean y)^2` by ten-fold cross-validation; below 0 where
    the mean would have been the better guess. None of fewer sets than thrice the features.

    Args:
      features: [N, F].
      target: [N].
      seed: of the folds.
    """
    num, num_features = features.shape
    if num < 3 * num_features or np.ptp(target) == 0.0:
        return None
    fold = np.random.default_rng(seed).permutation(num) % FOLDS
    predicted = np.empty(num)
    for number in range(FOLDS):
        out = fold == number
        predicted[out] = fit_line(features[~out], target[~out])(features[out])
    return float(1.0 - np.sum((target - predicted) ** 2) / np.sum((target - target.mean()) ** 2))


def fit_line(features: np.ndarray, target: np.ndarray):
    """Least squares of [N] on [N, F] and a constant, as a function of other features [M, F].

    Features are put on one scale first; those that do not vary have no part in it.
    """
    mean, std = features.mean(axis=0), features.std(axis=0)
    kept = std > ROUNDING * np.abs(features).max(axis=0)
    scaled = (features[:, kept] - mean[kept]) / std[kept]
    weights, *_ = np.linalg.lstsq(scaled, target - target.mean(), rcond=None)

    def predict(others: np.ndarray) -> np.ndarray:
        return target.mean() + (others[:, kept] - mean[kept]) / std[kept] @ weights

    return predict
