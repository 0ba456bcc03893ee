"""Whether calibrated intervals hold on views that nothing was learned from, and how wide they are.

A guarantee is an average over views; what is measured here is whether it was met, for whom, and at
what price: coverage with its standard error, coverage from the least to the most uncertain pixels,
width and score beside those of one constant interval for all pixels, which needs no uncertainty.

The mean width alone does not tell which intervals are better. One interval for all pixels reaches
its share by holding nearly all certain pixels and hardly any uncertain one; where few pixels hold
the large errors, this is shorter on average at low levels than intervals that hold their share of
both, even of the true scale. The interval score (Gneiting and Raftery 2007) also counts how far the
truth is outside; nothing has a lower one on average than intervals that are right at each pixel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bavs_jax.uncertainty.conformal import Calibrated
from bavs_jax.uncertainty.conformal_scale import ViewErrors, evaluate_scale, pool_views

NUM_DECILES = 10


class CoverageReport(NamedTuple):
    """Measures of L levels on V test views."""

    levels: np.ndarray  # [L] what was promised
    num_calibration_views: int
    num_test_views: int  # V
    coverage: np.ndarray  # [L] share of a view's pixels inside their interval, mean over views
    coverage_stderr: np.ndarray  # [L] its standard error over test views; NaN for a single one
    decile_coverage: np.ndarray  # [L, 10] of pooled pixels, from the least uncertain tenth up
    mean_width: np.ndarray  # [L] upper - lower end, unit of the error; mean over views
    score: np.ndarray  # [L] as `interval_score`, unit of the error; mean over views
    constant_coverage: np.ndarray  # [L] as `coverage`, of the constant interval
    constant_decile_coverage: np.ndarray  # [L, 10] as `decile_coverage`, likewise
    constant_width: np.ndarray  # [L] unit of the error
    width_ratio: np.ndarray  # [L] mean width / that of the constant interval; NaN if infinite
    score_ratio: np.ndarray  # [L] score / that of the constant interval; NaN if infinite


def coverage_report(calibrated: Calibrated, test: Sequence[ViewErrors]) -> CoverageReport:
    """Measures calibrated intervals on views of their own.

    Args:
      test: views that neither the field nor the scale nor the factors were learned from.

    Returns:
      The measures. The standard error is that of the mean over the test views for the intervals as
      they are; another draw of calibration views would move the coverage, too. Widths are those
      before an interval is cut to the bounds of its quantity.

    Raises:
      ValueError: as `calibrate`.

    Numerics: a pixel counts as covered by |error| / scale <= factor, the very numbers that were
    calibrated, so that rounding never moves a pixel that stands on the edge.
    """
    errors, uncertainty, _ = pool_views(test, group="test")
    scale = evaluate_scale(calibrated.scale, uncertainty)
    is_covered = errors / scale <= calibrated.factors[:, None]
    is_covered_by_constant = errors <= calibrated.constant_half_widths[:, None]

    sizes = np.array([len(view.errors) for view in test])
    mean_width = 2.0 * calibrated.factors * _mean_over_views(scale, sizes)
    constant_width = 2.0 * calibrated.constant_half_widths
    score, constant_score = np.zeros((2, len(calibrated.levels)))
    for row, level in enumerate(calibrated.levels):
        of_pixels = interval_score(errors, calibrated.factors[row] * scale, level)
        score[row] = _mean_over_views(of_pixels, sizes)
        of_pixels = interval_score(errors, calibrated.constant_half_widths[row], level)
        constant_score[row] = _mean_over_views(of_pixels, sizes)

    shares = _means_of_views(is_covered, sizes)
    squares = np.square(shares - shares.mean(-1, keepdims=True)).mean(-1)
    with np.errstate(invalid="ignore"):  # 0 / 0 for one view, and what is infinite or 0 by itself
        stderr = np.sqrt(squares / np.float64(len(test) - 1))
        width_ratio, score_ratio = mean_width / constant_width, score / constant_score
    return CoverageReport(
        levels=calibrated.levels,
        num_calibration_views=calibrated.num_views,
        num_test_views=len(test),
        coverage=shares.mean(-1),
        coverage_stderr=stderr,
        decile_coverage=share_by_decile(is_covered, uncertainty),
        mean_width=mean_width,
        score=score,
        constant_coverage=_mean_over_views(is_covered_by_constant, sizes),
        constant_decile_coverage=share_by_decile(is_covered_by_constant, uncertainty),
        constant_width=constant_width,
        width_ratio=width_ratio,
        score_ratio=score_ratio,
    )


def interval_score(errors, half_widths, level: float) -> np.ndarray:
    """Width of an interval and a fine for missing, `2 h + 2 / (1 - level) max(|error| - h, 0)`.

    Its mean is smallest for the half-width h that holds the truth with probability `level`, at
    each pixel by itself. Lower is better.

    Args:
      errors: [N] absolute errors.
      half_widths: [N] or one for all, in the unit of the errors.
      level: in (0, 1).

    Returns:
      [N] in the unit of the errors; infinite where the interval is.
    """
    return 2.0 * half_widths + 2.0 / (1.0 - level) * np.maximum(errors - half_widths, 0.0)


def share_by_decile(is_covered, uncertainty) -> np.ndarray:
    """Share of covered pixels in each tenth of the pixels, from the least uncertain up.

    Args:
      is_covered: [L, N] bool.
      uncertainty: [N].

    Returns:
      [L, 10]. Pixels of equal uncertainty are spread evenly over the tenths that they fill, so
      that where pixels stand in memory never matters.
    """
    order = np.argsort(uncertainty)
    starts = np.flatnonzero(np.diff(uncertainty[order], prepend=-np.inf))
    ends = np.append(starts, len(order))
    cuts = np.linspace(0.0, len(order), NUM_DECILES + 1)
    summed = np.add.reduceat(is_covered[:, order], starts, axis=-1, dtype=np.float64)
    summed = np.pad(np.cumsum(summed, axis=-1), ((0, 0), (1, 0)))
    at_cuts = np.stack([np.interp(cuts, ends, one) for one in summed])
    return np.diff(at_cuts, axis=-1) * NUM_DECILES / len(order)


def to_json(value):
    """A NamedTuple of numbers and arrays as a dict of lists; infinity and NaN become None.

    For `Calibrated` and `CoverageReport`: JSON has no infinity. A half-width or width of None was
    promised from too few views, or is relative to one that was.
    """
    if value is None or isinstance(value, str):
        return value
    if hasattr(value, "_asdict"):
        return {name: to_json(one) for name, one in value._asdict().items()}
    if np.ndim(value):
        return [to_json(one) for one in value]
    number = np.asarray(value).item()
    return number if np.isfinite(number) else None


def _means_of_views(values, sizes) -> np.ndarray:
    """Means [..., V] of values [..., N] over the pixels of each view."""
    starts = np.cumsum(sizes) - sizes
    return np.add.reduceat(values, starts, axis=-1, dtype=np.float64) / sizes


def _mean_over_views(values, sizes) -> np.ndarray:
    """Mean [...] over views of their means, so that each counts the same whatever its size."""
    return _means_of_views(values, sizes).mean(-1)
