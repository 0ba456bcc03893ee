"""How much surface a view would look at from directions that nobody has, gated by visibility.

    gain(c) = sum_p w_p(c) g_p(c) [1 - max_s vis_s(p) exp(kappa (d_s . d_c - 1))]

over points p of the surface on the rays of a view c: w is the rendering weight, d the direction to
the point, s the views so far, `vis_s(p)` the transmittance to the point, and `g = min(1, (r_ref /
r)^2)` of the distance r, so that what is far counts less. The surface is the cells in which a
sample of some view so far had a weight above a threshold: fog has none, and matter that a field
made up where nobody looked is none either. As far as a ray meets no surface, it counts by the share
of its way through the box that no view has looked into.

After SBV, CONVERGE and AGILE; differs from `measures.direction_novelty`, which knows neither gate,
distance nor unknown space.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.fields.deformation import DeformationGrid, grid_coordinates
from bavs_jax.numerics import safe_divide
from bavs_jax.rendering.sampling import box_interval
from bavs_jax.uncertainty.measures import (
    DEFAULT_TOLERANCE,
    at_nearest_pixel,
    directions_from,
    least_over_cameras,
    look_at_points,
)

SURFACE_WEIGHT = 0.1  # of a sample, from which on its cell is surface
KAPPA = 4.0  # a look counts for one half at an angle of 34 degrees, as in `directional`
STEPS_THROUGH_BOX = 32  # of a ray, where it is asked whether a view has looked there


class Lookers(NamedTuple):
    """V cameras, and the reduced renders by which they see no more than is not hidden."""

    cameras: Cameras  # [V]
    mask: Array  # [V] bool, which of them count
    depth_maps: Array  # [V, H, W] distance along the ray, scene units, 0 where empty
    opacity_maps: Array  # [V, H, W] in [0, 1]


def transmittance_to(
    camera: Cameras,
    points: Array,
    depth_map: Array,
    opacity_map: Array,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> jax.Array:
    """Share of the light of points that reaches a camera, [...] in [0, 1]; 0 outside of its image.

    A ray is taken to be clear up to its rendered depth, and to let `1 - opacity` through behind it.

    Args:
      camera, points, depth_map, tolerance: see `look_at_points`.
      opacity_map: [H, W] of the same render.
    """
    in_image, pixels = look_at_points(camera, points)
    is_clear, _ = look_at_points(camera, points, depth_map, tolerance=tolerance)
    behind = jnp.where(in_image, 1.0 - at_nearest_pixel(opacity_map, pixels), 0.0)
    return jnp.where(is_clear, 1.0, jnp.clip(behind, 0.0, 1.0))


def surface_novelty(
    points: Array, directions: Array, lookers: Lookers, *, kappa: float = KAPPA
) -> jax.Array:
    """`1 - max_s vis_s exp(kappa (d_s . d - 1))`, [K] in [0, 1]; 1 where no view looks.

    Args:
      points: [K, 3] scene units.
      directions: [K, 3] unit, in which each point is looked at: from the camera to the point.
      lookers: the views so far.
      kappa: >= 0; how fast a look stops counting as the angle grows.

    Numerics: `1 - cos = |d - d_s|^2 / 2`, exact for near directions.
    """

    def novelty(camera, depth_map, opacity_map):
        difference = directions - directions_from(camera, points)
        apart = 0.5 * (difference * difference).sum(-1)
        seen = transmittance_to(camera, points, depth_map, opacity_map)
        return 1.0 - seen * jnp.exp(-kappa * apart)

    return _least(novelty, points, lookers)


def unseen(points: Array, lookers: Lookers) -> jax.Array:
    """`1 - max_s vis_s`, [K] in [0, 1]: 1 where no view has looked."""
    return _least(lambda *view: 1.0 - transmittance_to(view[0], points, *view[1:]), points, lookers)


def _least(value_fn, points, lookers: Lookers) -> jax.Array:
    sources = lookers.cameras, lookers.depth_maps, lookers.opacity_maps
    never_seen = jnp.ones(points.shape[:-1], points.dtype)
    return least_over_cameras(value_fn, never_seen, lookers.mask, sources)


def unknown_share(
    rays: Rays, box: jax.Array, lookers: Lookers, *, num_steps: int = STEPS_THROUGH_BOX
) -> jax.Array:
    """How much of each ray's way through a box nobody has looked into, [R] in [0, 1].

    Relative to the longest way through the box, its diagonal, so that a ray which grazes a corner
    counts little, and one which misses the box nothing.

    Args:
      rays: R rays.
      box: [2, 3] scene units.
      lookers: the views so far.
      num_steps: even steps through the box.
    """
    enter, leave = box_interval(rays, box, 0.0, jnp.inf)
    length = jnp.maximum(leave - enter, 0.0)
    middles = (jnp.arange(num_steps) + 0.5) / num_steps
    t = jnp.where(length > 0.0, enter, 0.0)[:, None] + length[:, None] * middles
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    return length / jnp.linalg.norm(box[1] - box[0]) * unseen(points, lookers).mean(-1)


def nearness(distance: Array, reference: Array) -> jax.Array:
    """`min(1, (r_ref / r)^2)`, [...]; 1 at a distance of 0."""
    far = jnp.maximum(distance, reference)
    return jnp.where(far > 0.0, jnp.square(safe_divide(reference, far)), 1.0)


def cell_number(grid: DeformationGrid, positions: jax.Array) -> jax.Array:
    """Which of the grid's cells each position [..., 3] is in, [...] int32, z fastest."""
    cell = jnp.floor(grid_coordinates(grid, positions)).astype(jnp.int32)
    x, y, z = jnp.moveaxis(jnp.clip(cell, 0, grid.cells - 1), -1, 0)
    return (x * grid.cells + y) * grid.cells + z
