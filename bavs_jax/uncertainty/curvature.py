"""Curvature of the colour loss in the deformation offsets (Eqs 10-13), as a raw sum over rays.

For ray r, channel c, vertex v, axis d and trilinear weights b,

    g_rcvd = sum_i b_iv dC_rc / dx_id        (samples i of the ray, summed *before* the square)
    jac_sq_sum_vd = sum_r sum_c g_rcvd^2     (the diagonal of sum_r J_r^T J_r)

No prior, factor or division is in `jac_sq_sum`; `posterior.py` adds them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Rays
from bavs_jax.fields.deformation import (
    DeformationGrid,
    corner_weights,
    surrounding_vertices,
    trilinear_weights,
    vertex_number,
)
from bavs_jax.numerics import computed_once
from bavs_jax.rendering.compositing import composite_colour, render_weights
from bavs_jax.rendering.sampling import Samples, flatten_inputs, sample_positions

WEIGHTINGS = ("eq13", "eq11", "empirical")


def colour_jacobian(
    field_fn: Callable, rays: Rays, samples: Samples, *, background, inputs: dict | None = None
) -> tuple[jax.Array, jax.Array]:
    """Derivative of each ray's colour by an offset of each of its samples.

    `dC_rc / dx_id` by `jax.vmap(jax.jacrev(...))` over rays of the whole way from offsets to
    colour, at offset 0. Sample positions are held fixed: what moves is where the field is read, as
    under `D_theta`. This is the definition; `split_colour_jacobian` is quicker and equal.

    Args:
      field_fn: (positions [S, 3], directions [S, 3], **inputs) -> (density [S], rgb [S, 3]).
      rays: R rays.
      samples: [R, S].
      background: [3] colour behind everything, or None (see `composite_colour`).
      inputs: what more the field reads at each sample, by name, [R, S, ...].

    Returns:
      jacobian [R, 3, S, 3] (channel, sample, axis), 1 / scene unit, and the colours [R, 3].
    """

    def ray_colour(offsets, origin, direction, t_mids, deltas, more):
        positions = origin + t_mids[:, None] * direction + offsets
        directions = jnp.broadcast_to(direction, positions.shape)
        density, rgb, *_ = field_fn(positions, directions, **more)
        colour = composite_colour(render_weights(density, deltas), rgb, background)
        return colour, colour

    zero = jnp.zeros((*samples.t_mids.shape, 3), samples.t_mids.dtype)
    # Invalid slots have deltas of 0, so their weight and derivative vanish.
    return jax.vmap(jax.jacrev(ray_colour, has_aux=True))(
        zero, rays.origins, rays.directions, samples.t_mids, samples.deltas, inputs or {}
    )


class FieldSlopes(NamedTuple):
    """A field at the samples of R rays, and its derivatives by their positions."""

    density: jax.Array  # [R, S]
    rgb: jax.Array  # [R, S, 3]
    density_slope: jax.Array  # [R, S, 3 axes]
    rgb_slope: jax.Array  # [R, S, 3 channels, 3 axes]


def field_slopes(
    field_fn: Callable, rays: Rays, samples: Samples, *, inputs: dict | None = None
) -> FieldSlopes:
    """Reads and differentiates a field at samples; arguments as in `colour_jacobian`.

    The field has three inputs per sample and is differentiated forwards, all samples of all rays
    at once, for which it is evaluated three times rather than differentiated four times in reverse.
    """
    positions = sample_positions(rays, samples)
    directions = jnp.broadcast_to(rays.directions[:, None], positions.shape)
    flat_directions = directions.reshape(-1, 3)
    flat_inputs = flatten_inputs(inputs or {})

    def field_at(flat_positions):
        return field_fn(flat_positions, flat_directions, **flat_inputs)[:2]

    def along(axis):
        tangent = jnp.broadcast_to(axis, flat_directions.shape)
        return jax.jvp(field_at, (positions.reshape(-1, 3),), (tangent,))

    values, slopes = zip(*(along(axis) for axis in jnp.eye(3, dtype=positions.dtype)))
    shape = samples.t_mids.shape
    return FieldSlopes(
        density=values[0][0].reshape(shape),
        rgb=values[0][1].reshape(*shape, 3),
        density_slope=jnp.stack([d for d, _ in slopes], -1).reshape(*shape, 3),
        rgb_slope=jnp.stack([c for _, c in slopes], -1).reshape(*shape, 3, 3),
    )


def split_colour_jacobian(
    field_fn: Callable, rays: Rays, samples: Samples, *, background, inputs: dict | None = None
) -> tuple[jax.Array, jax.Array]:
    """As `colour_jacobian`, by the chain rule at the samples' densities and colours.

    `dC / dx_i = dC / dsigma_i dsigma_i / dx_i + dC / dc_i dc_i / dx_i`: compositing has three
    outputs and is differentiated per ray by `jax.vmap(jax.jacrev(...))`, the field by
    `field_slopes`.
    """
    slopes = field_slopes(field_fn, rays, samples, inputs=inputs)
    return composited_jacobian(slopes, samples.deltas, background=background)


def composited_jacobian(
    slopes: FieldSlopes, deltas: jax.Array, *, background
) -> tuple[jax.Array, jax.Array]:
    """The Jacobian [R, 3, S, 3] and the colours [R, 3] of `split_colour_jacobian`."""

    def ray_colour(density, rgb, deltas):
        colour = composite_colour(render_weights(density, deltas), rgb, background)
        return colour, colour

    (by_density, by_rgb), colour = jax.vmap(jax.jacrev(ray_colour, argnums=(0, 1), has_aux=True))(
        slopes.density, slopes.rgb, deltas
    )
    jacobian = by_density[..., None] * slopes.density_slope[:, None]
    return jacobian + jnp.einsum("rcsk,rskd->rcsd", by_rgb, slopes.rgb_slope), colour


def weight_jacobian(jacobian: jax.Array, residual: jax.Array | None, weighting: str) -> jax.Array:
    """Folds a weighting into the Jacobian so that all of them end as a plain sum of squares.

    - `eq13`: unchanged; sum over channels of g^2.
    - `eq11`: times `sqrt(eps)`, `eps = |e|^2` (Eq 12); sum of `eps g^2`.
    - `empirical`: `sum_c e_c g_c` as a single channel; its square is the exact empirical Fisher.

    Args:
      jacobian: [R, 3, S, 3].
      residual: e = C - C* [R, 3]; None for `eq13` only.
      weighting: one of `WEIGHTINGS`.

    Returns:
      [R, 3 or 1, S, 3].

    Raises:
      ValueError: unknown weighting, or a residual is needed and missing.
    """
    if weighting not in WEIGHTINGS:
        raise ValueError(f"weighting: {weighting!r} is unknown; use one of {', '.join(WEIGHTINGS)}")
    if weighting == "eq13":
        return jacobian
    if residual is None:
        raise ValueError(f"weighting {weighting!r} needs the colour residual of each ray")
    if weighting == "eq11":
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
      grid: the deformation grid.
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
    field_fn: Callable,
    grid: DeformationGrid,
    rays: Rays,
    samples: Samples,
    *,
    background,
    target: jax.Array | None = None,
    ray_weight: jax.Array | None = None,
    first_row: jax.Array | None = None,
    weighting: str = "eq13",
    inputs: dict | None = None,
    jacobian_fn: Callable = split_colour_jacobian,
) -> jax.Array:
    """Adds R rays to the raw sum of squared Jacobians (Eqs 11-13).

    Args:
      jac_sq_sum: [G, 3] the sum so far; or several of them, one after another, [N G, 3].
      field_fn, rays, samples, background, inputs: see `colour_jacobian`.
      grid: the deformation grid of G vertices.
      target: [R, 3] true colours; needed by `eq11` and `empirical`.
      ray_weight: [R] factor of each ray's contribution, 0 for padding; 1 when None.
      first_row: [R] int, a multiple of G: where the sum of each ray begins; 0 when None.
      weighting: one of `WEIGHTINGS`.
      jacobian_fn: `split_colour_jacobian`, or `colour_jacobian` which it equals.

    Returns:
      The new sum, of the same shape.
    """
    jacobian, rgb = jacobian_fn(field_fn, rays, samples, background=background, inputs=inputs)
    residual = None if target is None else rgb - target
    jacobian = weight_jacobian(jacobian, residual, weighting)
    positions = computed_once(sample_positions(rays, samples))
    rows, added = jax.vmap(vertex_squares, in_axes=(None, 0, 0))(grid, positions, jacobian)
    if ray_weight is not None:
        added = added * ray_weight[:, None, None, None]
    if first_row is not None:
        rows = rows + first_row[:, None, None]
    return jac_sq_sum.at[rows.reshape(-1)].add(added.reshape(-1, 3))
