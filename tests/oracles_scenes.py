"""Slow references for the procedural scenes, in float64."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.scenes import sculpture
from bavs_jax.scenes.photographs import components


def distances(
    points: np.ndarray, signed_distance: Callable = sculpture.signed_distance
) -> np.ndarray:
    """A signed distance in float64, [...]; the sculpture's by default."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(signed_distance)(jnp.asarray(points, jnp.float64)))


def surface_colour(shade: Callable, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The scene's own colour, [..., 3], of points [..., 3] seen along unit directions [..., 3]."""
    colour = jax.jit(shade)(components(points), components(directions))
    return np.stack(np.broadcast_arrays(*colour), axis=-1)


def brute_force_depth(
    origins: np.ndarray,
    directions: np.ndarray,
    *,
    near: float,
    far: float,
    step: float,
    signed_distance: Callable = sculpture.signed_distance,
) -> tuple[np.ndarray, np.ndarray]:
    """First surface along each ray, by equal small steps and then bisection.

    Args:
      origins: [R, 3].
      directions: [R, 3] unit.
      near: where to begin, scene units.
      far: where to end, scene units.
      step: what a ray clips by less may be missed, scene units.
      signed_distance: of the scene.

    Returns:
      `(depth, clipped)`: [R] scene units, 0 where nothing is met, and whether a ray meets or only
      just misses something thinner than a few steps on its way, which no marcher decides alike.
    """
    origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
    t = np.arange(near, far, step)
    values = distances(origins[:, None] + t[:, None] * directions[:, None], signed_distance)
    inside = values < 0.0
    hit, first = inside.any(axis=1), inside.argmax(axis=1)
    before = np.arange(len(t)) < np.where(hit, first - 4, len(t))[:, None]
    grazes = (before & (values < 2.0 * step) & (np.gradient(values, axis=1) > 0.0)).any(axis=1)
    thin = hit & ~np.take_along_axis(inside, np.minimum(first + 4, len(t) - 1)[:, None], 1)[:, 0]

    outer, inner = t[np.maximum(first - 1, 0)], t[first]
    for _ in range(30):
        middle = 0.5 * (outer + inner)
        outside = distances(origins + middle[:, None] * directions, signed_distance) > 0.0
        outer, inner = np.where(outside, middle, outer), np.where(outside, inner, middle)
    return np.where(hit, inner, 0.0), grazes | thin
