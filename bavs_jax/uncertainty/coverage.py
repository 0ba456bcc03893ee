"""Coverage of points by viewing directions (CONVERGE): how new is it to look from there."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Cameras
from bavs_jax.numerics import safe_divide
from bavs_jax.uncertainty.visibility import DEFAULT_TOLERANCE, look_at_points


def direction_novelty(
    points: jax.Array,
    directions: jax.Array,
    cameras: Cameras,
    mask: jax.Array,
    depth_maps: jax.Array | None = None,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> jax.Array:
    """How differently points are looked at than from any camera that sees them.

    `1 - (1 + max_c d_c . d) / 2`, the squared sine of half the angle to the nearest direction
    from which the point is seen: 0 if it is seen from just there, 1/2 at a right angle, 1 from the
    opposite side, and 1 where no camera sees it. Composited along a ray over a floor of 0
    (`sum_i w_i value_i`), a ray that meets nothing is worth 0.

    Args:
      points: [K, 3] scene units.
      directions: [K, 3] unit, in which each point is looked at: from the camera to the point.
      cameras: V cameras.
      mask: [V] bool, which of them count; the others cost nothing.
      depth_maps: [V, H, W] rendered distances along the rays of `cameras`, whose images must be of
        that size, 0 where empty; with them a camera does not see what is hidden from it.
      tolerance: see `look_at_points`.

    Returns:
      [K] in [0, 1].

    Numerics: computed as `min_c |d - d_c|^2 / 4`, exact for near directions.
    """

    def add_camera(novelty, source):
        camera, is_used, depth_map = source

        def look(novelty):
            is_seen, _ = look_at_points(camera, points, depth_map, tolerance=tolerance)
            towards = points - camera.positions
            seen_from = safe_divide(towards, jnp.linalg.norm(towards, axis=-1, keepdims=True))
            difference = directions - seen_from
            apart = 0.25 * (difference * difference).sum(-1)
            return jnp.where(is_seen, jnp.minimum(novelty, apart), novelty)

        return jax.lax.cond(is_used, look, lambda novelty: novelty, novelty), None

    # One camera after the other: memory does not grow with V.
    never_seen = jnp.ones(points.shape[:-1], points.dtype)
    novelty, _ = jax.lax.scan(add_camera, never_seen, (cameras, mask, depth_maps))
    return novelty
