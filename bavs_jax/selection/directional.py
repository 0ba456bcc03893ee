"""Information by direction: a look at a point tells little about how it looks from elsewhere.

The posterior of `information.py` adds up what all views say about a vertex. Yet a surface that was
seen from its front alone is not known from its side: there it may be hidden, shine, or lie at
another depth than what one direction could place. So the curvature of earlier looks counts here
only as far as they came from the same side,

    gain(c) = sum_vd log(1 + h_cvd / (2 lambda + sum_s k(c, s; v) h_svd)),
    k(c, s; v) = ((1 + cos angle) / 2)^sharpness,

with the angle at vertex v between the directions to cameras c and s, and s over the training views
and the picks so far. With `sharpness` 0 it is `log_det_gain` of the plain posterior (POp-GS); as it
grows, looks from different sides become independent.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array, Indices
from bavs_jax.numerics import unit_vectors
from bavs_jax.selection.information import DEFAULT_MAX_BYTES, log_det_gain

SHARPNESS = 8.0  # the kernel falls to one half at an angle of 33 degrees
GROUP_SIZE = 32  # candidates that a look is added to at once


class Look(NamedTuple):
    """The curvature of one view, where it stands."""

    rows: Array  # [n] int32, vertices of the grid; padded as in `sparse_curvature`
    h: Array  # [n, 3] >= 0
    position: Array  # [3] scene units


LookFn = Callable[[Indices], Iterable[Look]]  # the look of each candidate, one after another
# From the looks so far, a precision [n, 3] > 0 at the rows of each candidate, one after another.
PrecisionFn = Callable[[tuple[Look, ...], Indices], Iterable[jax.Array]]


class DirectionalInformation(NamedTuple):
    """The looks so far, and what each candidate would add to them."""

    looks: tuple[Look, ...]  # of the training views, then of the picks
    look_fn: LookFn
    precision_fn: PrecisionFn


def directions_to(points, position) -> jax.Array:
    """Unit vectors [n, 3] from points [n, 3] to a position [3]; 0 for a point that lies there."""
    return unit_vectors(position - points)


def direction_kernel(cosine, *, sharpness) -> jax.Array:
    """`((1 + cos angle) / 2)^sharpness`, [...] in [0, 1]."""
    return jnp.clip((1.0 + cosine) / 2.0, 0.0, 1.0) ** sharpness


def same_side(points, camera, other, *, sharpness: float = SHARPNESS) -> jax.Array:
    """How far a look from `other` stands for one from `camera`: `((1 + cos angle) / 2)^sharpness`.

    Args:
      points: [n, 3] scene units, where the angle is.
      camera, other: [3] scene units.
      sharpness: >= 0.

    Returns:
      [n] in [0, 1]; 1 in the same direction, and with a sharpness of 0 everywhere. A point on a
      camera has no direction to it, and counts as at a right angle.
    """
    cosine = (directions_to(points, camera) * directions_to(points, other)).sum(-1)
    return direction_kernel(cosine, sharpness=sharpness)


@jax.jit
def _add_look(precision, rows, camera, dense, other, vertices, sharpness):
    weight = same_side(vertices[rows], camera, other, sharpness=sharpness)
    return precision + weight[:, None] * dense[rows]


@jax.jit
def _dense(rows, h, like):
    return jnp.zeros_like(like).at[rows].add(h)


def make_precision_fn(
    look_fn: LookFn,
    vertices,
    *,
    prior: float | Array,
    sharpness: float = SHARPNESS,
    max_bytes: int = DEFAULT_MAX_BYTES,
) -> PrecisionFn:
    """Makes `DirectionalInformation.precision_fn`, which remembers what it has added up.

    A greedy batch asks again after each pick, with one more look: then only that look is added.
    What does not fit into `max_bytes` is added up anew each time.

    Args:
      look_fn: see `DirectionalInformation`.
      vertices: [G, 3] positions of the grid's vertices, scene units.
      prior: 2 lambda > 0, the precision where nothing has looked; one number, or [3] by axis.
      sharpness: see `same_side`.
      max_bytes: of remembered precisions.
    """
    vertices = jnp.asarray(vertices, jnp.float32)
    kept: dict[int, tuple[tuple[Look, ...], jax.Array]] = {}  # looks that are in, precision

    def known(index, look, looks):
        """What is remembered of a candidate, if all that went in is still among the looks."""
        done, precision = kept.get(index, ((), None))
        is_start = len(done) <= len(looks) and all(a is b for a, b in zip(done, looks))
        if precision is None or not is_start:
            return 0, jnp.full_like(look.h, prior)
        return len(done), precision

    def remember(index, looks, precision):
        if (len(kept) + (index not in kept)) * precision.nbytes <= max_bytes:
            kept[index] = looks, precision

    def group_precisions(looks, indices, candidates):
        state = [known(i, c, looks) for i, c in zip(indices, candidates)]
        first = min(num for num, _ in state)
        precisions = [precision for _, precision in state]
        for number, look in enumerate(looks[first:], first):
            dense = _dense(look.rows, look.h, vertices)
            for place, candidate in enumerate(candidates):
                if state[place][0] <= number:
                    precisions[place] = _add_look(
                        precisions[place],
                        candidate.rows,
                        candidate.position,
                        dense,
                        look.position,
                        vertices,
                        sharpness,
                    )
        for index, precision in zip(indices, precisions):
            remember(index, looks, precision)
        return precisions

    def precision_fn(looks, indices):
        for start in range(0, len(indices), GROUP_SIZE):
            group = [int(index) for index in indices[start : start + GROUP_SIZE]]
            yield from group_precisions(looks, group, list(look_fn(group)))

    return precision_fn


_gain = jax.jit(log_det_gain)


def directional_gains(information: DirectionalInformation, indices) -> np.ndarray:
    """What each candidate by itself would tell, given the looks so far, nats [n]; >= 0.

    A view that meets nothing has no curvature and gains 0.
    """
    precisions = information.precision_fn(information.looks, indices)
    looks = information.look_fn(indices)
    return np.array([float(_gain(look.h, p)) for look, p in zip(looks, precisions)], np.float32)


class KnowsLooks(Protocol):
    """A named tuple of what follows from looks, and of what candidates would see."""

    @property
    def looks(self) -> tuple[Look, ...]: ...

    @property
    def look_fn(self) -> LookFn: ...

    def _replace(self, *, looks: tuple[Look, ...]) -> Self: ...


AnyInformation = TypeVar("AnyInformation", bound=KnowsLooks)


def add_look(information: AnyInformation, index: int) -> AnyInformation:
    """What is known once candidate `index` has been taken."""
    (look,) = information.look_fn([index])
    return information._replace(looks=(*information.looks, look))
