"""Which points a camera sees: inside of its image, and not behind what it has rendered."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from bavs_jax.cameras import Cameras
from bavs_jax.projection import project

# Of a point's distance: how far behind the rendered surface it still counts as on it. A pixel of a
# reduced image covers as much of a slanted surface.
DEFAULT_TOLERANCE = 0.05


def at_nearest_pixel(image: jax.Array, pixels: jax.Array) -> jax.Array:
    """Values of an image [H, W] at pixels [..., 2] without blending: [...].

    For depth, where a blend of two surfaces lies on neither. Pixels outside get the edge's value.
    """
    column, row = (jnp.floor(pixels[..., i]).astype(jnp.int32) for i in (0, 1))
    height, width = image.shape
    return image[jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]


def look_at_points(
    camera: Cameras,
    points: jax.Array,
    depth_map: jax.Array | None = None,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
) -> tuple[jax.Array, jax.Array]:
    """Whether a camera sees each point, and at which pixel.

    A point is hidden if the camera's rendered surface is nearer than it by more than the
    tolerance. Where the camera rendered nothing, it looks through the point, and so it sees it.

    Args:
      camera: one camera without the axis of views, its image as large as `depth_map`.
      points: [..., 3] scene units.
      depth_map: [H, W] distance along the ray, scene units, 0 where empty; None: nothing hides.
      tolerance: share of the point's distance, in [0, 1]; 1 lets nothing hide.

    Returns:
      is_seen [...] bool, pixels [..., 2] (0 outside of the image).
    """
    pixels, is_seen = project(camera, points)
    if depth_map is not None:
        surface = at_nearest_pixel(depth_map, pixels)
        distance = jnp.linalg.norm(points - camera.positions, axis=-1)
        is_seen &= (surface == 0.0) | (surface >= (1.0 - tolerance) * distance)
    return is_seen, pixels
