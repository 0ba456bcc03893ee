"""Curvature of the colour loss in the deformation offsets (Eqs 10-13), as a raw sum over rays.

For ray r, channel c, vertex v, axis d and trilinear weights b,

    g_rcvd = sum_i b_iv dC_rc / dx_id        (samples i of the ray, summed *before* the square)
    jac_sq_sum_vd = sum_r sum_c g_rcvd^2     (the diagonal of sum_r J_r^T J_r)

No prior, factor or division is in `jac_sq_sum`; `posterior.py` adds them.
"""

import jax
import jax.numpy as jnp

from bavs_jax.fields.deformation import (
    DeformationGrid,
    corner_weights,
    surrounding_vertices,
    trilinear_weights,
    vertex_number,
)
from bavs_jax.models.base import RayTerms
from bavs_jax.numerics import materialize
from bavs_jax.registry import check_known

WEIGHTINGS = ("gauss_newton", "residual_weighted", "empirical_fisher")


def weight_jacobian(jacobian: jax.Array, residual: jax.Array | None, weighting: str) -> jax.Array:
    """Folds a weighting into the Jacobian so that all of them end as a plain sum of squares.

    - `gauss_newton` (Eq 13): unchanged; sum over channels of g^2.
    - `residual_weighted` (Eq 11): times `sqrt(eps)`, `eps = |e|^2` (Eq 12); sum of `eps g^2`.
    - `empirical_fisher`: `sum_c e_c g_c` as a single channel; its square is the exact empirical
      Fisher.

    Args:
      jacobian: [R, 3, S, 3].
      residual: e = C - C* [R, 3]; None for `gauss_newton` only.
      weighting: one of `WEIGHTINGS`.

    Returns:
      [R, 3 or 1, S, 3].

    Raises:
      ValueError: unknown weighting, or a residual is needed and missing.
    """
    check_known("weighting", weighting, WEIGHTINGS)
    if weighting == "gauss_newton":
        return jacobian
    if residual is None:
        raise ValueError(f"weighting {weighting!r} needs the colour residual of each ray")
    if weighting == "residual_weighted":
        return jacobian * jnp.linalg.norm(residual, axis=-1)[:, None, None, None]
    return jnp.einsum("rc,rcsd->rsd", residual, jacobian)[:, None]


def vertex_squares(
    grid: DeformationGrid, positions: jax.Array, jacobian: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Chain rule to the vertices of one ray, samples summed first, then squared.

    `sum_v g_v^2` is written without a list of distinct vertices: sample i adds `b_iv a_i g_v` to
    each of its own vertices v, where `a_i = dC / dx_i` and `g_v = sum_j b_jv a_j` runs over the
    whole ray. Summed over i that is `g_v * g_v`. The weights `b_jv` of every sample at the
    vertices of every other one are products of hat functions, so no sort is needed.

    Args:
      positions: [S, 3] scene units.
      jacobian: [C, S, 3] derivative of C channels by each sample's offset.

    Returns:
      rows [S, 8] in the grid, and what to add there [S, 8, 3].
    """
    vertices = surrounding_vertices(grid, positions)  # [S, 8, 3]
    b = corner_weights(grid, vertices[:, 0], positions)  # [S, 8, S]: vertex of i, sample j
    vertex_jacobian = jnp.einsum("ikj,cjd->ikcd", b, jacobian)
    own = trilinear_weights(grid, positions[:, None], vertices)  # [S, 8]
    added = own[..., None] * jnp.einsum("cid,ikcd->ikd", jacobian, vertex_jacobian)
    return vertex_number(grid, vertices), added


def add_jac_sq_sum(
    jac_sq_sum: jax.Array,
    terms: RayTerms,
    grid: DeformationGrid,
    *,
    target: jax.Array | None = None,
    ray_weight: jax.Array | None = None,
    first_row: jax.Array | None = None,
    weighting: str = "gauss_newton",
) -> jax.Array:
    """Adds R rays to the raw sum of squared Jacobians (Eqs 11-13).

    Args:
      jac_sq_sum: [G, 3] the sum so far; or several of them, one after another, [N G, 3].
      terms: of the R rays, from `RadianceModel.ray_terms`.
      grid: the deformation grid of G vertices.
      target: [R, 3] true colours; needed by `residual_weighted` and `empirical_fisher`.
      ray_weight: [R] factor of each ray's contribution, 0 for padding; 1 when None.
      first_row: [R] int, a multiple of G: where the sum of each ray begins; 0 when None.
      weighting: one of `WEIGHTINGS`.
    """
    residual = None if target is None else terms.rgb - target
    jacobian = weight_jacobian(terms.colour_jacobian, residual, weighting)
    positions = materialize(terms.positions)
    rows, added = jax.vmap(vertex_squares, in_axes=(None, 0, 0))(grid, positions, jacobian)
    if ray_weight is not None:
        added = added * ray_weight[:, None, None, None]
    if first_row is not None:
        rows = rows + first_row[:, None, None]
    return jac_sq_sum.at[rows.reshape(-1)].add(added.reshape(-1, 3))
