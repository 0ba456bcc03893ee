"""AUSE, the area under the sparsification error: does the error grow with the uncertainty?

Pixels are taken away from the most uncertain down, and the mean error of those that are left is
drawn against the share that is gone. The same is done in the order of the true error, which no
uncertainty can beat; the area between both curves is the AUSE (Ilg et al. 2018).

Papers differ in how they compute it, and a table that does not say which is worth nothing. Every
choice is an argument here, and `variant_name` says which were made.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bavs_jax.registry import check_known

NUM_FRACTIONS = 100
ERRORS = ("mae", "mse", "rmse")


class Sparsification(NamedTuple):
    """Two curves of the same pixels, and the area between them."""

    fractions: np.ndarray  # [F] share of pixels taken away, 0 .. 1, without 1
    by_uncertainty: np.ndarray  # [F] error of the pixels that are left
    by_error: np.ndarray  # [F] the same in the order of the error itself: the best there is
    ause: float  # area between the curves, both divided by their common maximum
    ause_unnormalised: float  # area between the curves as they are, in the unit of the error


def removal_fractions(num: int = NUM_FRACTIONS) -> np.ndarray:
    """`linspace(0, 1, num, endpoint=False)`: at least one pixel is always left."""
    return np.linspace(0.0, 1.0, num, endpoint=False)


def sparsification_curve(errors, order_by, fractions, *, error: str = "mae") -> np.ndarray:
    """Error of the pixels that are left when those of largest `order_by` are taken away.

    Args:
      errors: [N] absolute errors, >= 0.
      order_by: [N] from the first to keep up to the first to go.
      fractions: [F] shares to take away, in [0, 1).
      error: of `ERRORS`; what is averaged over the pixels left.

    Returns:
      [F]. `ceil((1 - f) N)` pixels are left. Pixels of equal `order_by` go in a random order: the
      curve is its mean over these orders, so that where pixels stand in memory never matters. Of
      "rmse" it is the root of that mean, of squares: the mean of the roots, which is at most as
      large, has no closed form.

    Raises:
      ValueError: no pixels, shapes differ, values are not finite, or an unknown error.
    """
    errors, order_by = np.asarray(errors, np.float64), np.asarray(order_by, np.float64)
    check_known("error", error, ERRORS)
    if errors.ndim != 1 or errors.shape != order_by.shape or len(errors) == 0:
        raise ValueError(f"errors {errors.shape} and order {order_by.shape}: give one [N], N > 0")
    if not (np.isfinite(errors).all() and np.isfinite(order_by).all()):
        raise ValueError("errors or their order: not finite; leave out pixels without a true value")
    values = errors if error == "mae" else np.square(errors)
    _, group, sizes = np.unique(order_by, return_inverse=True, return_counts=True)
    group_mean = np.bincount(group, weights=values) / sizes
    summed = np.concatenate([[0.0], np.cumsum(np.repeat(group_mean, sizes))])
    num = len(values)
    left = np.ceil((1.0 - np.asarray(fractions)) * num - 1e-9 * num).astype(int)
    curve = summed[left] / left
    return np.sqrt(curve) if error == "rmse" else curve


def sparsification(
    errors, uncertainty, *, error: str = "mae", num_fractions: int = NUM_FRACTIONS
) -> Sparsification:
    """Both curves of one set of pixels, and the areas between them.

    Args:
      errors: [N] absolute errors, >= 0.
      uncertainty: [N] any scale; only its order counts.
      error: of `ERRORS`.
      num_fractions: points of the curves.

    Numerics: the trapezoid rule over the fractions. Where nothing is wrong anywhere, both are 0.
    """
    fractions = removal_fractions(num_fractions)
    return _between(
        fractions,
        sparsification_curve(errors, uncertainty, fractions, error=error),
        sparsification_curve(errors, errors, fractions, error=error),
    )


def mean_sparsification(
    images: Sequence[tuple],
    *,
    error: str = "mae",
    pooled: bool = False,
    num_fractions: int = NUM_FRACTIONS,
) -> Sparsification:
    """Of several images: all pixels in one order, or each image by itself and then the mean.

    Args:
      images: (errors [N], uncertainty [N]) of each image; without pixels that have no true value.
      error: of `ERRORS`.
      pooled: whether pixels of all images are put into one order. Else the areas are the means of
        those of the images, each normalised by its own maximum, and so are the curves.
    """
    if not images:
        raise ValueError("images: there are none")
    if pooled:
        errors, uncertainty = (np.concatenate([np.ravel(i[k]) for i in images]) for k in (0, 1))
        return sparsification(errors, uncertainty, error=error, num_fractions=num_fractions)
    each = [sparsification(e, u, error=error, num_fractions=num_fractions) for e, u in images]
    return Sparsification(
        each[0].fractions,
        np.mean([one.by_uncertainty for one in each], axis=0),
        np.mean([one.by_error for one in each], axis=0),
        float(np.mean([one.ause for one in each])),
        float(np.mean([one.ause_unnormalised for one in each])),
    )


def variant_name(*, of: str, error: str, pooled: bool) -> str:
    """How a number is called in tables and files, such as `depth_mae_per_image`."""
    return f"{of}_{error}_{'pooled' if pooled else 'per_image'}"


def _between(fractions, by_uncertainty, by_error) -> Sparsification:
    area = float(np.trapezoid(by_uncertainty - by_error, fractions))
    largest = max(by_uncertainty.max(), by_error.max())
    normalised = area / largest if largest > 0.0 else 0.0
    return Sparsification(fractions, by_uncertainty, by_error, normalised, area)
