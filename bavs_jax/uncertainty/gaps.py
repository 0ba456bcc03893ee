"""How far, in angle, pixels of target views are from the views that see the same surface.

A pixel of a target view t shows a point of the surface from one side. A view s that sees the point
at the angle theta from there has the closeness

    c = vis_s / (theta^2 + LEAST^2 + (BLUR log2(max(b_s / b_t, 1)))^2)

to it, where `vis_s` is the share of the point's light that reaches s, and b the width of a pixel
where the point is, its distance over the focal length: what s sees more coarsely than t shows it is
not known in full. What follows for the choice of views is in `selection/gaps.py`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array
from bavs_jax.numerics import safe_divide, unit_vectors
from bavs_jax.uncertainty.surface import Lookers, transmittance_to

LEAST = 0.2  # radians; a look from nearer by is hardly better
BLUR = 0.25  # radians that a look with pixels twice as wide is worse by
UNSEEN = jnp.pi**-2  # the closeness of a look from the other side, which shows nothing


class TargetPixels(NamedTuple):
    """n pixels of each of T target views, and the points that they show."""

    points: Array  # [T, n, 3] scene units
    cameras: Array  # [T, 3] centres, scene units
    focal: Array  # [T] focal lengths, pixels of the images that views are looked at in
    weight: Array  # [T, n] opacity in [0, 1]; 0 for a pixel that shows no surface


def gap_of(angle, coarser) -> jax.Array:
    """`theta^2 + LEAST^2 + (BLUR log2(max(b_s / b_t, 1)))^2` of theta and b_s / b_t, radians^2."""
    return jnp.square(angle) + LEAST**2 + jnp.square(BLUR * jnp.log2(jnp.maximum(coarser, 1.0)))


def squared_gap(pixels: TargetPixels, position, focal=None) -> jax.Array:
    """`theta^2 + LEAST^2 + blur^2` of a camera at `position` [3], were nothing hidden; [T, n].

    Args:
      pixels: of the targets.
      position: [3] scene units.
      focal: [] the camera's focal length, pixels; None leaves out the blur.

    Numerics: the angle is `2 asin(|d - d_s| / 2)`, exact for near directions.
    """
    wanted, looked = pixels.points - pixels.cameras[:, None], pixels.points - position
    chord = jnp.linalg.norm(unit_vectors(wanted) - unit_vectors(looked), axis=-1)
    angle = 2.0 * jnp.arcsin(jnp.clip(chord / 2.0, 0.0, 1.0))
    if focal is None:
        return gap_of(angle, 1.0)
    width = jnp.linalg.norm(looked, axis=-1) / focal
    wanted_width = jnp.linalg.norm(wanted, axis=-1) / pixels.focal[:, None]
    return gap_of(angle, safe_divide(width, wanted_width))


@jax.jit
def closeness_of_views(pixels: TargetPixels, lookers: Lookers) -> jax.Array:
    """The closeness [V, T, n] of V views, whatever their mask; one view after another."""

    def of_view(view):
        camera, depth_map, opacity_map = view
        seen = transmittance_to(camera, pixels.points, depth_map, opacity_map)
        return seen / squared_gap(pixels, camera.positions, camera.intrinsics[0])

    return jax.lax.map(of_view, (lookers.cameras, lookers.depth_maps, lookers.opacity_maps))


@jax.jit
def target_shares(pixels: TargetPixels) -> jax.Array:
    """Weights [T] of targets by which each region of views counts as much as any other.

    Targets that look from one side share what one of them would have, so that a pool which is
    crowded on one side does not say that this side is wanted most: `1 / sum_s k_ts`, with `k_ts`
    the mean `1 / squared_gap` of target s to the pixels of t, as a share of the largest there
    is. Which part of the scene they show, and from how far, plays no part. 0 for a target that
    shows no surface.
    """
    closeness = 1.0 / jax.lax.map(lambda position: squared_gap(pixels, position), pixels.cameras)
    total = pixels.weight.sum(-1)
    likeness = LEAST**2 * safe_divide((closeness * pixels.weight).sum(-1), total)  # [s, t]
    return safe_divide(jnp.where(total > 0.0, 1.0, 0.0), likeness.sum(0))
