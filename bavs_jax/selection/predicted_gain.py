"""What a batch of views is predicted to be worth, in dB, before any of its photos is taken.

The definition. Displace the field by offsets theta of the deformation grid; a ray's colour changes
by `dC = g . theta` to first order, so under the posterior `theta ~ N(0, diag(1 / H))` the expected
squared colour error of reference rays, those one wants to be right, is

    E(H) = mean_r sum_c sum_vd g_rcvd^2 / H_vd  =  const sum_vd q_vd / H_vd = const tr(q H^-1),

where q is the raw sum of Eq 13 over the reference rays. A batch that adds the curvature h turns H
into `H + h`, and is predicted to be worth

    gain = 10 log10(E(H) / E(H + h))  dB,

which is compared with the rise of the PSNR of test views once the batch has been trained on.

The prior decides how much an unseen place counts. That of the paper (`2 lambda`) allows offsets of
many scene sizes, where nothing is linear any more. Here `offset_precision` says instead that a
place is off by about one cell of the grid, and colours by as much as a field usually misses its
own photos (`NOISE_VARIANCE`). Both priors are recorded; the definition is that with one cell.

Assumes: offsets explain the error; they are independent (H is diagonal, so neighbours that a ray
cannot tell apart count as if it could); the field stays where it is while it is trained anew;
reference rays look like test rays. Nothing of it is fitted to an error, so a scale remains to be
calibrated.

Limits: 0 for a batch that sees nothing new to the reference rays; never below 0; gains of batches
taken one after another add up; k more views of a kind that n views have settled already gain
`10 log10((n + k) / n)`, which is what counting views alone predicts (`views_gain_db`).

All of it is small sums on the host, in float64.
"""

from __future__ import annotations

import math

import numpy as np

from bavs_jax.uncertainty.posterior import NOISE_VARIANCE


def offset_precision(
    offset_std, *, num_rays: int, noise_variance: float = NOISE_VARIANCE
) -> np.ndarray:
    """Prior precision that stands for offsets of a given size, in the unit of H.

    Eq 13 has `H = (2 / R) jac_sq_sum`. For colours of variance s^2 around the field the precision
    is `jac_sq_sum / s^2 + 1 / std^2 = (R / 2 s^2) (H + (2 / R) s^2 / std^2)`, and the last term is
    this prior.

    Args:
      offset_std: [...] standard deviation of offsets a priori, scene units, > 0.
      num_rays: R of Eq 13.
      noise_variance: s^2 > 0, colour unit^2.

    Returns:
      [...] > 0, 1 / scene unit^2.
    """
    return (2.0 / num_rays) * noise_variance / np.square(np.asarray(offset_std, np.float64))


def expected_error(reference, precision) -> float:
    """Expected squared colour error of reference rays up to a factor, `tr(q H^-1)`.

    Args:
      reference: [G, 3] q >= 0, curvature of the reference rays (Eq 13) in any unit.
      precision: [G, 3] H > 0.

    Returns:
      >= 0; 0 where the reference rays meet nothing.
    """
    return float((np.asarray(reference, np.float64) / np.asarray(precision, np.float64)).sum())


def variance_gain_db(reference, precision, added) -> float:
    """Predicted worth of a batch, `10 log10(tr(q H^-1) / tr(q (H + h)^-1))`, dB.

    Args:
      reference: [G, 3] q >= 0, curvature of the reference rays in any unit.
      precision: [G, 3] H > 0, before the batch.
      added: [G, 3] h >= 0, what the whole batch adds to H.

    Returns:
      >= 0, finite; 0 where the reference rays meet nothing.
    """
    precision = np.asarray(precision, np.float64)
    return _decibels(
        expected_error(reference, precision),
        expected_error(reference, precision + np.asarray(added, np.float64)),
    )


def batch_information(precision, added) -> float:
    """What a batch tells of the offsets, `sum log(1 + h / H)`, nats; see `log_det_gain`.

    Args:
      precision: [G, 3] H > 0, before the batch.
      added: [G, 3] h >= 0.
    """
    ratio = np.asarray(added, np.float64) / np.asarray(precision, np.float64)
    return float(np.log1p(ratio).sum())


def views_gain_db(num_views: int, num_added: int) -> float:
    """What counting views alone predicts, `10 log10((n + k) / n)`, dB.

    Args:
      num_views: n >= 1 before the batch.
      num_added: k >= 0.
    """
    return 10.0 * math.log10((num_views + num_added) / num_views)


def distance_gain_db(positions, chosen, added) -> float:
    """What camera positions alone predict: the fall of the mean squared distance to a chosen view.

    `10 log10(mean_j min_s |x_j - x_s|^2 before / after)`, dB: the error if it grew with the square
    of the distance to the nearest training view.

    Args:
      positions: [N, 3] of reference views, scene units.
      chosen: [n, 3] of training views, n >= 1.
      added: [k, 3] of the batch.

    Returns:
      >= 0; infinity where each reference position is taken by the batch.
    """
    before = _nearest_squared(positions, chosen)
    after = before
    if len(added):
        after = np.minimum(before, _nearest_squared(positions, added))
    return _decibels(float(before.mean()), float(after.mean()))


def _nearest_squared(positions, others) -> np.ndarray:
    positions, others = np.asarray(positions, np.float64), np.asarray(others, np.float64)
    return np.square(positions[:, None] - others[None]).sum(-1).min(axis=1)


def _decibels(before: float, after: float) -> float:
    """`10 log10(before / after)`; 0 where there was no error to begin with.

    Numerics: below 0 is clipped to 0: sums of shrinking terms rise by their rounding at most.
    """
    if before == 0.0:
        return 0.0
    return max(10.0 * math.log10(before / after), 0.0) if after > 0.0 else math.inf
