"""WarpRF (Safadoust et al. 2025): does a render agree with the training views, warped into it?"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.ndimage import map_coordinates

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, Rays
from bavs_jax.numerics import safe_divide
from bavs_jax.registry import check_known
from bavs_jax.uncertainty.measures import DEFAULT_TOLERANCE, at_nearest_pixel, look_at_points

QUANTITIES = ("colour", "depth")
COMBINATIONS = ("min", "mean")


class WarpSources(NamedTuple):
    """Renders of the V views that may be warped; fixed shapes, only the mask changes."""

    cameras: Cameras  # V cameras, their images H x W
    rgb: Array  # [V, H, W, 3] in [0, 1]
    depth: Array  # [V, H, W] distance along the ray, scene units; 0 where empty
    mask: Array  # [V] bool, which are trained on; the others cost nothing


def sample_bilinear(image: jax.Array, pixels: jax.Array) -> jax.Array:
    """Colours of an image [H, W, C] at pixels [..., 2] (first centre 0.5): [..., C].

    Pixels beyond the outermost centres get the edge's colour.
    """
    coordinates = [pixels[..., 1] - 0.5, pixels[..., 0] - 0.5]
    channels = [
        map_coordinates(image[..., c], coordinates, order=1, mode="nearest")
        for c in range(image.shape[-1])
    ]
    return jnp.stack(channels, axis=-1)


def warp_disagreement(
    rays: Rays,
    rgb: jax.Array,
    depth: jax.Array,
    opacity: jax.Array,
    sources: WarpSources,
    *,
    quantity: str = "colour",
    combine: str = "min",
    tolerance: float = DEFAULT_TOLERANCE,
) -> jax.Array:
    """How far what a ray sees differs from what training views show at the same place.

    The ray's surface point `o + t d` at its rendered depth t is looked up in the render of each
    training view that sees it. `colour`: the mean absolute difference over the channels. `depth`:
    the difference between that view's depth and its distance from the point, relative to the
    latter, at most 1. `min` takes the view that agrees best, as the authors do to choose views by
    colour, `mean` the average over views, as they do to judge depth. A point that no view sees
    gets 1. The value counts in proportion to the ray's opacity.

    Args:
      rays: R rays of the candidates.
      rgb: [R, 3] rendered colours in [0, 1].
      depth: [R] rendered distances, scene units.
      opacity: [R] in [0, 1].
      sources: renders of the training views. Where a view rendered nothing, it looks through the
        point: its background disagrees with the surface that the candidate sees.
      quantity: one of `QUANTITIES`.
      combine: one of `COMBINATIONS`.
      tolerance: how far behind a view's surface a point is hidden from it (`look_at_points`); 1
        lets it look through everything, as published.

    Returns:
      [R] in [0, 1], larger is less certain; 0 on a ray that meets nothing.

    Raises:
      ValueError: unknown quantity or combination.

    Differs from the published code, which takes the colour at the edge of a view's image for
    points outside of it, and has no test for what is hidden.
    """
    check_known("quantity", quantity, QUANTITIES)
    check_known("combine", combine, COMBINATIONS)
    points = rays.origins + depth[:, None] * rays.directions

    def difference(camera, image, depth_map, pixels):
        if quantity == "colour":
            return jnp.abs(sample_bilinear(image, pixels) - rgb).mean(-1)
        distance = jnp.linalg.norm(points - camera.positions, axis=-1)
        apart = jnp.abs(at_nearest_pixel(depth_map, pixels) - distance)
        return jnp.minimum(safe_divide(apart, distance), 1.0)

    def add_view(state, source):
        camera, image, depth_map, is_used = source

        def compare(state):
            least, total, num_seeing = state
            is_seen, pixels = look_at_points(camera, points, depth_map, tolerance=tolerance)
            apart = difference(camera, image, depth_map, pixels)
            return (
                jnp.where(is_seen, jnp.minimum(least, apart), least),
                total + jnp.where(is_seen, apart, 0.0),
                num_seeing + is_seen,
            )

        return jax.lax.cond(is_used, compare, lambda state: state, state), None

    # One view after the other: memory does not grow with V.
    zero = jnp.zeros_like(depth)
    start = (zero + 1.0, zero, zero)
    (least, total, num_seeing), _ = jax.lax.scan(add_view, start, tuple(sources))
    mean = jnp.where(num_seeing > 0.0, total / jnp.maximum(num_seeing, 1.0), 1.0)
    return opacity * (least if combine == "min" else mean)
