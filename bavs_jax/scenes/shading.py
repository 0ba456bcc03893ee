"""Paint and light on the surface of a signed distance field, as pure functions of components."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from bavs_jax.scenes import sdf
from bavs_jax.scenes.sdf import Point

Number = jax.Array | float
Colour = tuple[Number, Number, Number]  # sRGB components, one number for all points or an array


def mix(a: Colour, b: Colour, share: jax.Array) -> Point:
    """Colour between `a` (share 0) and `b` (share 1)."""
    red, green, blue = (x + (y - x) * share for x, y in zip(a, b))
    return red, green, blue


def nearest_paint(
    distances: Sequence[jax.Array], colours: Sequence[Colour], gloss: Sequence[float]
) -> tuple[Colour, jax.Array]:
    """Albedo (sRGB components) and strength of the highlight of the nearest of some parts.

    Where several are equally far the first one counts.
    """
    nearest, shine = jnp.full_like(distances[0], jnp.inf), jnp.zeros_like(distances[0])
    albedo: Colour = (0.0, 0.0, 0.0)
    for part, colour, strength in zip(distances, colours, gloss):
        closer = part < nearest
        red, green, blue = (jnp.where(closer, c, a) for c, a in zip(colour, albedo))
        albedo = red, green, blue
        shine = jnp.where(closer, strength, shine)
        nearest = jnp.minimum(nearest, part)
    return albedo, shine


def openness(distance_fn: sdf.DistanceFn, p: Point, normal: Point) -> jax.Array:
    """How open the surface is to what is around it, in [0.25, 1]: compares distances along the
    normal with those of a plane."""
    reach, weight = jnp.array([0.04, 0.12, 0.28]), jnp.array([3.0, 1.5, 0.8])

    def add(i, closed):
        return closed + weight[i] * (reach[i] - distance_fn(sdf.at(p, normal, reach[i])))

    closed = jax.lax.fori_loop(0, reach.shape[0], add, jnp.zeros_like(p[0]))
    return jnp.clip(1.0 - closed, 0.25, 1.0)


def mirrored(directions: Point, normal: Point, to_light: Point | Colour) -> jax.Array:
    """Cosine between the view direction reflected at the surface and the direction to a light."""
    along = directions[0] * normal[0] + directions[1] * normal[1] + directions[2] * normal[2]
    x, y, z = ((d - 2.0 * along * n) * s for d, n, s in zip(directions, normal, to_light))
    return x + y + z
