"""How far, in angle, pixels of target views are from the views that see the same surface.

A pixel of a target view shows a point of the surface from one side. A view s that sees the point at
the angle theta from there, and from r_s / r_t times as far, has the gap

    gap^2 = theta^2 + LEAST^2 + (BLUR log2(max(r_s / r_t, 1)))^2

to it, and the closeness `vis_s / gap^POWER`, where `vis_s` is the share of the point's light that
reaches s. What follows for the choice of views is in `selection/gaps.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras
from bavs_jax.numerics import safe_divide
from bavs_jax.uncertainty.measures import directions_from
from bavs_jax.uncertainty.surface import Lookers, transmittance_to

LEAST = 0.3  # radians; a look from nearer by is hardly better
BLUR = 0.5  # radians that a look from twice as far is worse by
POWER = 3.0  # by which errors grow with the gap
UNSEEN = jnp.pi**-POWER  # the closeness of a look from the other side, which shows nothing


class TargetPixels(NamedTuple):
    """n pixels of each of T target views, and the points that they show."""

    points: Array  # [T, n, 3] scene units
    cameras: Array  # [T, 3] centres, scene units
    weight: Array  # [T, n] opacity in [0, 1]; 0 for a pixel that shows no surface


def closeness(pixels: TargetPixels, camera: Cameras, depth_map, opacity_map) -> jax.Array:
    """`vis / gap^POWER` of one view to each pixel, [T, n] in radians^-POWER; 0 where it is hidden.

    Args:
      pixels: of the targets.
      camera: one camera without the axis of views.
      depth_map, opacity_map: [H, W] its render (see `transmittance_to`).

    Numerics: the angle is `2 asin(|d - d_s| / 2)`, exact for near directions.
    """
    away = pixels.points - pixels.cameras[:, None]
    target_distance = jnp.linalg.norm(away, axis=-1)
    directions = safe_divide(away, target_distance[..., None])
    chord = jnp.linalg.norm(directions - directions_from(camera, pixels.points), axis=-1)
    angle = 2.0 * jnp.arcsin(jnp.clip(chord / 2.0, 0.0, 1.0))
    distance = jnp.linalg.norm(pixels.points - camera.positions, axis=-1)
    blur = BLUR * jnp.log2(jnp.maximum(safe_divide(distance, target_distance), 1.0))
    seen = transmittance_to(camera, pixels.points, depth_map, opacity_map)
    return seen * (angle**2 + LEAST**2 + blur**2) ** (-POWER / 2.0)


@jax.jit
def closeness_of_views(pixels: TargetPixels, lookers: Lookers) -> jax.Array:
    """`closeness` [V, T, n] of V views, whatever their mask; one view after another."""
    views = lookers.cameras, lookers.depth_maps, lookers.opacity_maps
    return jax.lax.map(lambda view: closeness(pixels, *view), views)
