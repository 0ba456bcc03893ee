"""How much candidate views would tell about the field: gains of a diagonal Gaussian posterior.

With the posterior precision H [G, 3] of the deformation offsets and the curvature h [G, 3] that a
view would add to it, the new posterior has the precision `H + h`. A view is rendered for this, not
photographed: Gauss-Newton curvature (`curvature.WEIGHTINGS`: "gauss_newton") needs its pose alone.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array, Indices
from bavs_jax.selection import SelectionError

MIN_ROWS = 1024  # smallest padded size, so that views which see little share one compilation
DEFAULT_MAX_BYTES = 2**30


class CurvatureFn(Protocol):
    """One (rows [n] int32, h [n, 3] >= 0) after another: the curvature that each candidate adds at
    vertices `rows` of the grid; n is a power of two, filled up with rows = 0, h = 0."""

    def __call__(self, indices: Indices, /) -> Iterable[tuple[Array, Array]]: ...


DenseCurvatureFn = Callable[[np.ndarray], Array]  # what each of n candidates adds to H, [n, G, 3]
# Gain [] >= 0 of a view that adds h [n, 3] to the precision [n, 3].
Gain = Callable[[jax.Array, jax.Array], jax.Array]


class Information(NamedTuple):
    """What is known about the field, and what each candidate would add."""

    precision: jax.Array  # [G, 3] H > 0, the prior and all picks so far included
    curvature_fn: CurvatureFn


class BatchBound(NamedTuple):
    """How far a batch can be from the best batch of its size; sums of `log(1 + h / H)`, nats."""

    gain: float  # of the batch
    bound: float  # no batch of that size gains more
    ratio: float  # gain / bound, in [0, 1]; 1 where there is nothing to gain


# --- curvature in bounded memory -------------------------------------------------------------


def sparse_curvature(h) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that a view has any curvature at, padded to few different lengths.

    Args:
      h: [G, 3] >= 0; NaN is kept, so that it is found in the scores.

    Returns:
      rows [n] int32 and h [n, 3] float32, n the next power of two from `MIN_ROWS` up, filled up
      with rows = 0, h = 0, which change no sum.

    Numerics: below 0 is clipped to 0: a sum of squares that was summed in another order may fall
    short of 0 by its rounding.
    """
    h = np.maximum(np.asarray(h, np.float32), 0.0)
    rows = np.flatnonzero(h.any(axis=-1)).astype(np.int32)
    size = max(MIN_ROWS, 1 << max(len(rows) - 1, 0).bit_length())
    padding = size - len(rows)
    return np.pad(rows, (0, padding)), np.pad(h[rows], ((0, padding), (0, 0)))


def make_cached_curvature_fn(
    dense_fn: DenseCurvatureFn,
    *,
    num_vertices: int,
    max_bytes: int = DEFAULT_MAX_BYTES,
    group_size: int = 1,
) -> CurvatureFn:
    """Makes an `Information.curvature_fn` that remembers as many candidates as fit.

    A greedy batch asks for all candidates once for each pick, in the same order: to forget the
    oldest would mean to forget each one just before it is wanted. Hence what came first is kept,
    and what no longer fits is computed anew each time, a few candidates at once.

    Args:
      dense_fn: what each candidate adds to H.
      num_vertices: G.
      max_bytes: of host memory that remembered curvature may take.
      group_size: most candidates that `dense_fn` is asked for at once.

    Returns:
      `curvature_fn(indices)`, a generator of `(rows [n], h [n, 3])` in the order of the indices; it
      raises SelectionError where `dense_fn` returns another shape than [n, G, 3].
    """
    kept: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    room = max_bytes

    def look_at(indices: list[int]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        nonlocal room
        h = np.asarray(dense_fn(np.array(indices)))
        if h.shape != (len(indices), num_vertices, 3):
            raise SelectionError(
                f"curvature: shape {h.shape} for candidates {indices}; "
                f"return {(len(indices), num_vertices, 3)}"
            )
        fresh = {index: sparse_curvature(dense) for index, dense in zip(indices, h)}
        for index, (rows, values) in fresh.items():
            if rows.nbytes + values.nbytes <= room:
                room -= rows.nbytes + values.nbytes
                kept[index] = rows, values
        return fresh

    def curvature_fn(indices):
        indices, fresh = [int(index) for index in indices], {}
        for place, index in enumerate(indices):
            if index not in kept and index not in fresh:
                unknown = dict.fromkeys(i for i in indices[place:] if i not in kept)
                fresh = look_at(list(unknown)[:group_size])
            yield kept[index] if index in kept else fresh[index]

    return curvature_fn


# --- gains -----------------------------------------------------------------------------------


def log_det_gain(h: jax.Array, precision: jax.Array) -> jax.Array:
    """D-optimal gain of one view, `sum log(1 + h / H) = log det(H + h) - log det H`, nats.

    It is twice the mutual information between the view and the offsets. As a function of sets of
    views it is monotone and submodular. A view that meets nothing has h = 0 and gains 0.

    Args:
      h: [n, 3] >= 0, curvature that the view adds.
      precision: [n, 3] > 0, H at the same vertices.
    """
    return jnp.log1p(h / precision).sum()


def trace_ratio_gain(h: jax.Array, precision: jax.Array) -> jax.Array:
    """FisherRF's gain of one view, `tr(h H^-1) = sum h / H`; 0 for a view that meets nothing.

    H holds the prior already, FisherRF's `h / (H + lambda)`. It is the first-order term of
    `log_det_gain`, and no smaller. Arguments as there.
    """
    return (h / precision).sum()


@partial(jax.jit, static_argnames="gain")
def _gain_at(precision, rows, h, *, gain):
    return gain(h, precision[rows])


@jax.jit
def _add_at(precision, rows, h):
    return precision.at[rows].add(h)


def candidate_gains(information: Information, indices, *, gain: Gain) -> np.ndarray:
    """Gain [n] >= 0 of each candidate by itself, given all that is in `information`.

    Args:
      information: the field and the candidates.
      indices: [n] int, candidates.
      gain: `log_det_gain` or `trace_ratio_gain`; compiled once for each padded size.
    """
    gains = [
        float(_gain_at(information.precision, rows, h, gain=gain))
        for rows, h in information.curvature_fn(indices)
    ]
    return np.array(gains, np.float32)


def add_curvature(information: Information, index: int) -> Information:
    """What is known once candidate `index` has been taken: its h joins H."""
    ((rows, h),) = information.curvature_fn([index])
    return information._replace(precision=_add_at(information.precision, rows, h))


# --- how good a batch is ---------------------------------------------------------------------


def batch_upper_bound(information: Information, selected, candidates) -> BatchBound:
    """How close a batch comes to the D-optimal one, without a search for the latter.

    For the first j picks S_j of any batch and the best batch S* of k, monotonicity and
    submodularity give

        f(S*) <= f(S_j) + sum of the k largest f(S_j + c) - f(S_j) over candidates c,

    where f is `log_det_gain` of a set (Nemhauser, Wolsey and Fisher 1978; an online bound after
    Minoux 1978). The bound is the least of these over j = 0 .. k. For an exactly greedy batch it
    is at most `f(S_k) / (1 - (1 - 1/k)^k)`, so the ratio is above 1 - 1/e; a batch that a distance
    filter restricted may have less.

    Args:
      information: before the first pick.
      selected: [k] int, the batch in the order of picking.
      candidates: [n] int, what the best batch may be made of; holds all of `selected`.

    Raises:
      SelectionError: if a pick is not among the candidates.
    """
    rest = [int(index) for index in candidates]
    if strangers := {int(pick) for pick in selected} - set(rest):
        raise SelectionError(f"selected: {sorted(strangers)} are not in candidates; add them there")
    num_picks, gained, bounds = len(selected), 0.0, []
    for pick in [*selected, None]:
        gains = candidate_gains(information, rest, gain=log_det_gain).astype(np.float64)
        bounds.append(gained + np.sort(gains)[::-1][:num_picks].sum())
        if pick is not None:
            place = rest.index(int(pick))
            gained += gains[place]
            del rest[place]
            information = add_curvature(information, int(pick))
    # Rounding may put the bound of a best batch just below the batch itself.
    bound = max(min(bounds), gained)
    return BatchBound(float(gained), float(bound), float(gained / bound) if bound > 0.0 else 1.0)
