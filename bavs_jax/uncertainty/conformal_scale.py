"""Views of a split, and the scale that turns an uncertainty into an error."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression

from bavs_jax.registry import check_known

SHARES = (0.25, 0.5, 0.25)  # calibration needs the most: V views promise V / (V + 1) at best


class ViewGroups(NamedTuple):
    """Views that were not trained on, in three disjoint groups, each sorted."""

    fit: np.ndarray
    calibration: np.ndarray
    test: np.ndarray


def split_views(
    views: Sequence[int], *, seed: int | None, shares: Sequence[float] = SHARES
) -> ViewGroups:
    """Splits views, never pixels, into fit, calibration and test, within one view of the shares.

    Args:
      views: numbers of views that were not trained on, each once.
      seed: of a random split, or None for an interleaved one: each group then takes its views
        evenly spread over the order in which they are given, such as along a camera path. The
        guarantee is for the random split; the interleaved one has no luck of the draw.
      shares: of fit, calibration and test, > 0, whose sum is 1.

    Raises:
      ValueError: views come twice, shares are not such, or a group would be empty.
    """
    numbers, wanted = np.asarray(views, np.int64), np.asarray(shares, np.float64)
    if wanted.shape != (3,) or not (wanted > 0.0).all() or abs(wanted.sum() - 1.0) > 1e-6:
        raise ValueError(
            f"shares {wanted.tolist()}: give three of fit, calibration and test, each > 0, sum 1"
        )
    if numbers.ndim != 1 or len(np.unique(numbers)) != len(numbers):
        raise ValueError("views: give a list of numbers, each view once")
    order = numbers
    if seed is not None:
        order = np.random.default_rng(seed).permutation(np.sort(numbers))
    counts = np.zeros(3, int)
    group = np.zeros(len(numbers), int)
    for row in range(len(numbers)):
        # The group that is furthest behind its share; rounded, for ties to go to the first.
        group[row] = np.argmax(np.round(wanted * (row + 1) - counts, 9))
        counts[group[row]] += 1
    if not counts.all():
        raise ValueError(
            f"views: {len(numbers)} are too few for fit, calibration and test with shares "
            f"{wanted.tolist()}: they would get {counts.tolist()}; give more views"
        )
    return ViewGroups(*(np.sort(order[group == which]) for which in range(3)))


SCALES = ("isotonic", "uncertainty", "constant")
NUM_BINS = 50  # of the fit views' uncertainty, below the isotonic regression
RELATIVE_FLOOR = 1e-3  # of the scale, relative to what it is on average
ROUNDING = 1e-9  # of summed weights: a level that is reached but for it counts as reached


class ViewErrors(NamedTuple):
    """What is known of the N pixels of a view, those without a true value left out."""

    errors: np.ndarray  # [N] absolute error, >= 0: scene units of depth, or of colour in 0 .. 1
    uncertainty: np.ndarray  # [N] >= 0, in any unit


class Scale(NamedTuple):
    """How the half-width of intervals varies with the uncertainty; see `evaluate_scale`."""

    name: str  # of SCALES
    knots: np.ndarray  # [K] uncertainty, growing; none where the scale is the uncertainty itself
    values: np.ndarray  # [K] mean absolute error there, not falling
    floor: float  # added everywhere, > 0


def fit_scale(views: Sequence[ViewErrors], *, scale: str) -> Scale:
    """Learns how the half-width of intervals varies with the uncertainty.

    Args:
      views: all views weigh the same, and so do the pixels within each.
      scale: 'isotonic': the mean error at an uncertainty, by isotonic regression over
        `NUM_BINS` bins of equal weight: it asks only that the error does not fall with the
        uncertainty, whatever its unit. 'uncertainty': the uncertainty itself: right where it is
        proportional to the error. 'constant': the same everywhere, the mean error.

    Returns:
      the scale, with a floor of `RELATIVE_FLOOR` of the mean error, or of the mean uncertainty if
      it is that.

    Raises:
      ValueError: as `calibrate`.

    Numerics: the floor keeps |error| / scale finite. It is 1 where all that it is relative to
    is 0: then the scale is constant.
    """
    check_known("scale", scale, SCALES)
    errors, uncertainty, weights = pool_views(views, group="fit")
    if scale == "uncertainty":
        knots, values, typical = np.zeros(0), np.zeros(0), weights @ uncertainty
    elif scale == "constant":
        knots, values, typical = np.zeros(1), np.array([weights @ errors]), weights @ errors
    else:
        knots, values = _isotonic_knots(errors, uncertainty, weights)
        typical = weights @ errors
    return Scale(scale, knots, values, RELATIVE_FLOOR * float(typical) or 1.0)


def evaluate_scale(scale: Scale, uncertainty) -> np.ndarray:
    """The scale > 0 at an uncertainty [...] >= 0: straight between knots and flat beyond them.

    Raises:
      ValueError: an uncertainty is negative or not finite.
    """
    uncertainty = np.asarray(uncertainty, np.float64)
    if not (np.isfinite(uncertainty) & (uncertainty >= 0.0)).all():
        raise ValueError("uncertainty: it must be finite and >= 0; leave out other pixels")
    if len(scale.knots):
        return np.interp(uncertainty, scale.knots, scale.values) + scale.floor
    return uncertainty + scale.floor


def weighted_quantile(values, weights, levels) -> np.ndarray:
    """The smallest value up to which the weights sum to a level, [L]; infinite if they never do.

    Args:
      values: [N] in any order.
      weights: [N] > 0, whose sum is at most 1; what is missing to 1 sits at infinity.
      levels: [L] in (0, 1).

    Numerics: a sum short of a level by less than `ROUNDING` counts as reaching it.
    """
    order = np.argsort(values)
    reached = np.searchsorted(np.cumsum(weights[order]), np.asarray(levels) - ROUNDING)
    return np.append(values[order], np.inf)[reached]


def pool_views(
    views: Sequence[ViewErrors], *, group: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors, uncertainty and weight of all pixels of V views, [N] each, checked, float64.

    A pixel weighs `1 / (V n)` in a view of n pixels: views count the same, whatever their size.

    Args:
      views: at least one.
      group: what they are called in messages.

    Raises:
      ValueError: there are none, a view is empty, or a value is negative or not finite.
    """
    if not len(views):
        raise ValueError(f"{group} views: there are none; give at least one")
    for row, view in enumerate(views):
        shapes = [np.shape(values) for values in view]
        if shapes[0] != shapes[1] or len(shapes[0]) != 1 or shapes[0] == (0,):
            raise ValueError(
                f"{group} view {row}: errors {shapes[0]} and uncertainty {shapes[1]}: give one "
                "[N], N > 0, and leave out views without a true value"
            )
        for name, values in view._asdict().items():
            if not (np.isfinite(values) & (np.asarray(values) >= 0.0)).all():
                raise ValueError(
                    f"{group} view {row}: {name}: a value is negative or not finite; leave out "
                    "pixels without a true value"
                )
    sizes = np.array([len(view.errors) for view in views])
    errors, uncertainty = (np.concatenate(values).astype(np.float64) for values in zip(*views))
    return errors, uncertainty, np.repeat(1.0 / (len(views) * sizes), sizes)


def _isotonic_knots(errors, uncertainty, weights) -> tuple[np.ndarray, np.ndarray]:
    """Median uncertainty of each bin, and the mean errors nearest to theirs that do not fall."""
    # Equal uncertainties share a bin, so that the order of the pixels never matters.
    edges = weighted_quantile(uncertainty, weights, np.arange(1, NUM_BINS) / NUM_BINS)
    bins = np.searchsorted(np.unique(edges), uncertainty)
    shares, sums = np.bincount(bins, weights), np.bincount(bins, weights * errors)
    knots = weighted_quantile(uncertainty, weights, np.cumsum(shares) - 0.5 * shares)
    return knots, isotonic_regression(sums / shares, weights=shares).x
