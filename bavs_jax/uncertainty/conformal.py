"""Error bars with a checked guarantee: split-conformal intervals from an uncertainty.

An uncertainty says where a render is likelier to be wrong, not by how much. Here it gets a unit:
`prediction +- factor * scale(uncertainty)` holds the truth for a stated share of the pixels. How
wide the interval is from pixel to pixel, `scale`, is learned on *fit* views; the `factor` of each
level on *calibration* views; whether it holds is measured on *test* views. None of the three was
trained on, and they are split by view: pixels of one image are alike, so a split by pixel would
calibrate and test on the same errors.

The guarantee (hierarchical conformal prediction: Lee, Barber and Willett 2023; after the pooled
CDFs of Dunn, Wasserman and Ramdas 2022). Let V calibration views and one new view be exchangeable,
with scale and field fixed before; pixels within a view may depend on each other in any way. Then
a pixel drawn at random from the new view lies in its interval of a level with probability

    level <= P(covered) <= level + 1 / (V + 1) + a,

over calibration views, new view and pixel; `a` is the largest share that one value of
|error| / scale has of all V + 1 views, at most 1 / (V + 1) where no two values are equal and close
to 0 where views have many pixels. It is an average: single views, pixels, or values of the
uncertainty may be covered less, which is why `coverage_report` looks at them. The upper bound says
what few views cost: if all views are alike, P(covered) is `level (V + 1) / V`, and a level above
V / (V + 1) has an infinite interval, for nothing shorter can be promised from V views.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bavs_jax.uncertainty.conformal_scale import (
    ROUNDING,
    Scale,
    ViewErrors,
    evaluate_scale,
    fit_scale,
    pool_views,
    weighted_quantile,
)

LEVELS = (0.5, 0.8, 0.9, 0.95)


class Calibrated(NamedTuple):
    """Intervals for L levels."""

    levels: np.ndarray  # [L] growing, in (0, 1)
    factors: np.ndarray  # [L] half-width / scale, infinite where the views are too few
    scale: Scale
    constant_half_widths: np.ndarray  # [L] of one interval for all pixels, from the same views
    num_views: int  # V, of the calibration


def calibrate(
    fit: Sequence[ViewErrors],
    calibration: Sequence[ViewErrors],
    *,
    scale: str = "isotonic",
    levels: Sequence[float] = LEVELS,
) -> Calibrated:
    """Intervals that hold the truth of a pixel of a new view at each level.

    The factor of a level is that quantile of |error| / scale(uncertainty), where each of the V
    calibration views has weight 1 / (V + 1), spread evenly over its pixels, and the remaining
    1 / (V + 1), of the view to come, sits at infinity. The module says what this guarantees.

    Args:
      fit: views from which the scale is learned; of no calibration or test view.
      calibration: V views from which the factors are learned.
      scale: of `SCALES`, see `fit_scale`.
      levels: shares of pixels to be covered, in (0, 1).

    Returns:
      the intervals, levels in growing order. Above V / (V + 1), they are infinite.

    Raises:
      ValueError: a group or a view is empty, a value is negative or not finite, a level is outside
        (0, 1), or the scale is unknown.
    """
    shares = np.unique(np.asarray(levels, np.float64))
    if shares.size == 0 or not ((shares > 0.0) & (shares < 1.0)).all():
        raise ValueError(f"levels {shares.tolist()}: give at least one, each in (0, 1)")
    fitted = fit_scale(fit, scale=scale)
    errors, uncertainty, weights = pool_views(calibration, group="calibration")
    num_views = len(calibration)
    weights *= num_views / (num_views + 1.0)  # the rest is the new view's, at infinity
    return Calibrated(
        shares,
        weighted_quantile(errors / evaluate_scale(fitted, uncertainty), weights, shares),
        fitted,
        weighted_quantile(errors, weights, shares),
        num_views,
    )


def half_width(calibrated: Calibrated, uncertainty, level: float) -> np.ndarray:
    """Half the length of the interval, `factor * scale(uncertainty)`, in the unit of the error.

    Args:
      uncertainty: [...] finite and >= 0, in the unit it had there.
      level: one of `calibrated.levels`.

    Returns:
      [...] of `uncertainty`; infinite where there were too few views for the level.

    Raises:
      ValueError: not a level that was calibrated, or an uncertainty is negative or not finite.
    """
    found = np.flatnonzero(np.abs(calibrated.levels - level) < ROUNDING)
    if not len(found):
        raise ValueError(
            f"level {level}: calibrated are {calibrated.levels.tolist()}; use one of them or "
            "calibrate for it"
        )
    return calibrated.factors[found[0]] * evaluate_scale(calibrated.scale, uncertainty)


def interval(
    calibrated: Calibrated,
    prediction,
    uncertainty,
    level: float,
    *,
    bounds: tuple[float, float] = (-np.inf, np.inf),
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end of the interval around a prediction, both of its shape.

    Args:
      prediction: [...] as the uncertainty, or [..., channels] with one half-width for all: then the
        errors of the calibration must be the largest over the channels for all to be covered.
      uncertainty: [...] finite and >= 0.
      level: one of `calibrated.levels`.
      bounds: what the truth is known to lie in, (0, 1) for colours and (0, inf) for depth; the
        interval is cut to it, which costs no coverage.

    Raises:
      ValueError: as `half_width`, or the shapes do not fit.
    """
    prediction = np.asarray(prediction, np.float64)
    half = half_width(calibrated, uncertainty, level)
    if prediction.shape[:-1] == half.shape and prediction.ndim == half.ndim + 1:
        half = half[..., None]
    elif prediction.shape != half.shape:
        raise ValueError(
            f"prediction {prediction.shape}: the uncertainty is {half.shape}; give that shape, or "
            "that and channels"
        )
    return np.clip(prediction - half, *bounds), np.clip(prediction + half, *bounds)
