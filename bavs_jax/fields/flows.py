"""Triangular Sylvester flows (van den Berg et al. 2018): invertible maps that a network steers.

Arrays hold components first, `z [D, ...]`, and any points behind them: on a CPU the arithmetic then
runs along the points, not along the few components of each.
"""

import functools
import math
import operator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

# Bound of |r1_ii r2_ii|^(1/2). Below 1, so that the slope of one flow is at least 0.002.
MAX_DIAGONAL = 0.999
# Before the tanh: at r1 = 0 as at r2 = b = 0 nothing would have a gradient.
INITIAL_DIAGONAL = 0.5


class SylvesterFlow(NamedTuple):
    """F flows of D dimensions, each with parameters for every point it is applied to."""

    r1: jax.Array  # [F, D, D, ...] upper triangular
    r2: jax.Array  # [F, D, D, ...] upper triangular, r1_ii r2_ii > -1
    b: jax.Array  # [F, D, ...]


def num_flow_parameters(dim: int) -> int:
    """Outputs of a network that one flow of `dim` dimensions needs: two triangles and a shift."""
    return dim * (dim + 2)


def flow_from_raw(
    raw: jax.Array, *, dim: int, num_flows: int, amplitude: float = 1.0
) -> SylvesterFlow:
    """Invertible flows from any numbers: `r1_ii = a tanh(0.5 + .)`, `r2_ii = tanh(.) / a`.

    With `|r1_ii r2_ii| < 1` every flow is strictly increasing in each coordinate, given those
    after it, and so has an inverse (van den Berg et al. 2018, section 4.3). Where `raw` is 0 the
    flow is the identity.

    Args:
      raw: [..., F * num_flow_parameters(D)] outputs of a network.
      dim: D.
      num_flows: F.
      amplitude: a > 0, bound of what one flow moves a coordinate by its diagonal. In one dimension
        F flows move a point by at most `F a`, which is all that a network can say about it.

    Returns:
      `SylvesterFlow` with the leading axes of `raw` behind the components.

    Numerics: both tanh are scaled by 0.999, so that they do not round to 1 and the slope of a flow
    to 0.
    """
    raw = jnp.moveaxis(raw, -1, 0)
    points = raw.shape[1:]
    raw = raw.reshape(num_flows, num_flow_parameters(dim), *points)
    # One square holds both triangles: R1 above its diagonal, the transpose of R2 below it.
    square = raw[:, : dim * dim].reshape(num_flows, dim, dim, *points)
    diagonal2, b = jnp.split(raw[:, dim * dim :], 2, axis=1)

    def upper(diagonal, above):
        masks = np.eye(dim, dtype=bool), np.triu(np.ones((dim, dim), bool), k=1)
        on, over = (mask.reshape(dim, dim, *[1] * len(points)) for mask in masks)
        return jnp.where(on, diagonal, jnp.where(over, above, 0.0))

    scale1, scale2 = MAX_DIAGONAL * amplitude, MAX_DIAGONAL / amplitude
    return SylvesterFlow(
        r1=upper(scale1 * jnp.tanh(INITIAL_DIAGONAL + square), square),
        r2=upper(scale2 * jnp.tanh(diagonal2)[:, :, None], square.swapaxes(1, 2)),
        b=b,
    )


def _unstack(x: jax.Array) -> list[jax.Array]:
    """`[x[0], x[1], ...]`, with one concatenation as its gradient, not a padded sum for each."""
    return [row[0] for row in jax.lax.split(x, (1,) * x.shape[0])]


def _upper_product(matrix: list[list[jax.Array]], z: list[jax.Array]) -> list[jax.Array]:
    """`R z` for an upper triangular R, component by component.

    Spelt out, so that XLA for CPUs makes one loop along the points of it: a sum over the axis of
    components, be it of three, runs fifty times slower.
    """
    dim = len(z)
    rows = ((matrix[i][j] * z[j] for j in range(i, dim)) for i in range(dim))
    return [functools.reduce(operator.add, row) for row in rows]


def apply_flow(flow: SylvesterFlow, z: jax.Array, *, reverse: bool) -> tuple[jax.Array, jax.Array]:
    """One flow: `z' = z + Q R1 tanh(R2 Q^T z + b)`, and the logarithm of its volume change.

    The Jacobian is `I + Q R1 diag(h') R2 Q^T`, with `h' = 1 - tanh^2`, and the product of
    triangles is a triangle, so `|det| = prod_i (1 + r1_ii r2_ii h'_i)`, every factor positive.

    Args:
      flow: one flow, without the axis F.
      z: [D, ...], broadcastable against the flow's points.
      reverse: whether Q reverses the coordinates or leaves them alone.

    Returns:
      `z'` [D, ...] and `log |det dz'/dz|` [...].
    """
    r1, r2 = ([_unstack(row) for row in _unstack(matrix)] for matrix in (flow.r1, flow.r2))
    order = range(len(z))[:: -1 if reverse else 1]
    parts = _unstack(z)
    inner = _upper_product(r2, [parts[i] for i in order])
    hidden = [jnp.tanh(x + shift) for x, shift in zip(inner, _unstack(flow.b))]
    moved = _upper_product(r1, hidden)
    slopes = [1.0 + r1[i][i] * r2[i][i] * (1.0 - jnp.square(x)) for i, x in enumerate(hidden)]
    after = jnp.stack([part + moved[order[i]] for i, part in enumerate(parts)])
    return after, jnp.log(math.prod(slopes))


def apply_flows(flows: SylvesterFlow, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """All F flows in turn, every other one on reversed coordinates, so that all of them mix.

    Arguments and results are those of `apply_flow`, the logarithm summed over the flows.
    """
    log_dets = []
    for number, flow in enumerate(zip(*map(_unstack, flows))):
        z, change = apply_flow(SylvesterFlow(*flow), z, reverse=number % 2 == 1)
        log_dets.append(change)
    return z, functools.reduce(operator.add, log_dets)
