"""Information about target views: what a look tells about the pixels that are wanted.

`information.py` and `directional.py` ask what a view tells about the offsets, also about those that
no wanted view will ever show. Here the question is about declared target views t. To first order a
target's pixels move with the offsets by its own raw curvature `T_tvd` (Eq 13, from its pose alone),
so with looks s that brought the raw curvatures `h_svd`

    P_tvd = 1 / std^2 + sum_s k(t, s; v) h_svd / noise^2
    V_t = sum_vd T_tvd / P_tvd,

the variance of the target's colours, summed over its pixels and channels. The kernel k, of
`directional.py`, lets a look count as far as it came from the target's side of the vertex. A look
from c lowers V_t by

    D_tc = sum_vd T_tvd [1 / P_tvd - 1 / (P_tvd + k(t, c; v) h_cvd / noise^2)].

The `linear_gain` (I-optimal design) is `sum_t D_tc`. The `log_gain` (after the expected predictive
information gain, view by view) is

    1/2 sum_t n_t log((n_t noise^2 + V_t) / (n_t noise^2 + V_t - D_tc))

with the n_t colour values of a target: being badly known counts by the logarithm.

A candidate counts where it sees a vertex and the more the nearer it comes (h), for the targets that
show the vertex (T) from the same side (k). The linear gain is monotone and submodular: each term is
concave in its own P, to which looks are added. The logarithm of sums is monotone alone.

Units: `Look.h` holds curvatures divided by noise^2, in 1 / scene unit^2, of targets too. `V_t` and
`D_tc` are then in units of noise^2.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.numerics import safe_divide
from bavs_jax.selection.directional import (
    SHARPNESS,
    Look,
    LookFn,
    PrecisionFn,
    direction_kernel,
    directions_to,
)

TARGETS_AT_ONCE = 32  # whose curvature is held while candidates go by
TARGETS_SIDE_BY_SIDE = 8  # of these, in one compiled call


class TargetInformation(NamedTuple):
    """The looks so far, what each candidate would see, and the N targets that are asked about."""

    looks: tuple[Look, ...]  # of the training views, then of the picks
    look_fn: LookFn  # of candidates
    target_fn: LookFn  # of targets 0 .. N - 1: T / noise^2, where each stands
    precision_fn: PrecisionFn  # P of targets, at the rows of each
    num_values: np.ndarray  # [N] n_t, pixels times channels of each target
    vertices: Array  # [G, 3] positions of the grid's vertices, scene units
    sharpness: float = SHARPNESS  # of the kernel; that of `precision_fn`


class TargetVariances(NamedTuple):
    """What N targets do not know, and what each of n candidates would take away; noise^2."""

    variances: np.ndarray  # [N] float64, V_t
    drops: np.ndarray  # [n, N] float64, D_tc


class _Targets(NamedTuple):
    """Some targets as the inner loop reads them: by components, which a CPU does several at once.

    Padded to the m rows of the longest with rows of no curvature.
    """

    rows: Array  # [t, m] int32
    points: jax.Array  # [3, t, m] the vertices at these rows
    directions: jax.Array  # [3, t, m] from there to the target's camera
    curvature: jax.Array  # [3, t, m] T / noise^2
    precision: jax.Array  # [3, t, m] P


@jax.jit
def _by_components(rows, curvature, precision, positions, vertices) -> _Targets:
    points = vertices[rows]
    directions = jax.vmap(directions_to)(points, positions)
    parts = (points, directions, curvature, precision)
    return _Targets(rows, *(jnp.moveaxis(x, -1, 0) for x in parts))


def _side_by_side(looks: list[Look], precisions: list, vertices) -> _Targets:
    most = max(len(look.rows) for look in looks)

    def stacked(parts, fill):
        padded = []
        for part in map(np.asarray, parts):
            widths = [(0, most - len(part))] + [(0, 0)] * (part.ndim - 1)
            padded.append(np.pad(part, widths, constant_values=fill))
        return np.stack(padded)

    return _by_components(
        stacked([look.rows for look in looks], 0),
        stacked([look.h for look in looks], 0.0),
        stacked(precisions, 1.0),
        np.stack([look.position for look in looks]),
        vertices,
    )


@jax.jit
def _dense(rows, h, vertices):
    return jnp.zeros_like(vertices).at[rows].add(h).T


@partial(jax.jit, static_argnames="sharpness")
def _drop_terms(targets: _Targets, dense, position, *, sharpness) -> jax.Array:
    """The terms [t, m] of `D_tc`, summed over axes alone: a CPU adds long sums up one by one.

    Args:
      targets: what is asked about.
      dense: [3, G] what the candidate's look brings, divided by noise^2.
      position: [3] where the candidate stands, scene units.
      sharpness: of the kernel; whole numbers are much faster.
    """
    away = [position[i] - targets.points[i] for i in range(3)]
    along = sum(a * b for a, b in zip(away, targets.directions))
    distance = jnp.sqrt(sum(a * a for a in away))
    weight = direction_kernel(safe_divide(along, distance), sharpness=sharpness)
    terms = jnp.zeros_like(distance)
    for axis in range(3):
        added = weight * dense[axis][targets.rows]
        before = targets.precision[axis]
        # No difference of near numbers.
        terms += targets.curvature[axis] * added / (before * (before + added))
    return terms


def target_variances(information: TargetInformation, indices) -> TargetVariances:
    """`V_t` of all targets now, and `D_tc` of n candidates, each by itself.

    Memory is that of a few targets and of one candidate, whatever the number of both: targets are
    taken a few at once, and candidates go by.

    Args:
      information: the looks so far.
      indices: [n] int, candidates.
    """
    num = len(information.num_values)
    vertices = jnp.asarray(information.vertices, jnp.float32)
    sharpness = float(information.sharpness)
    power = int(sharpness) if sharpness.is_integer() else sharpness
    variances, drops = np.zeros(num), np.zeros((len(indices), num))
    for held in _parts(np.arange(num), TARGETS_AT_ONCE):
        looks = list(information.target_fn(held))
        precisions = list(information.precision_fn(information.looks, held))
        for number, look, precision in zip(held, looks, precisions):
            variances[number] = (look.h / np.asarray(precision)).sum(dtype=np.float64)
        groups = [
            (
                held[part],
                _side_by_side([looks[i] for i in part], [precisions[i] for i in part], vertices),
            )
            for part in _parts(np.arange(len(held)), TARGETS_SIDE_BY_SIDE)
        ]
        for place, look in enumerate(information.look_fn(indices)):
            dense = _dense(look.rows, look.h, vertices)
            for numbers, targets in groups:
                terms = _drop_terms(targets, dense, look.position, sharpness=power)
                drops[place, numbers] = np.asarray(terms).sum(-1, dtype=np.float64)
    return TargetVariances(variances, drops)


def _parts(numbers: np.ndarray, size: int) -> list[np.ndarray]:
    return [numbers[start : start + size] for start in range(0, len(numbers), size)]


def linear_gain(information: TargetInformation, indices) -> np.ndarray:
    """By how much each candidate lowers the summed variance of the targets, `sum_t D_tc`, [n].

    In units of noise^2; >= 0, and 0 for a view that meets nothing.
    """
    return target_variances(information, indices).drops.sum(-1)


def log_gain(information: TargetInformation, indices) -> np.ndarray:
    """Information of each candidate about the targets, view by view, nats [n]; >= 0.

    `-1/2 sum_t n_t log(1 - D_tc / (n_t + V_t))` in units where noise^2 is 1.
    """
    variances, drops = target_variances(information, indices)
    num_values = np.asarray(information.num_values, np.float64)
    share = drops / (num_values + variances)
    return -0.5 * (num_values * np.log1p(-share)).sum(-1)
