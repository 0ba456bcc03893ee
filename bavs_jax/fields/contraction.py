"""Where in a unit cube a point is looked up: plainly in a box, or with all of space contracted.

The contraction is that of Mip-NeRF 360 (Eq 10) in the maximum norm, as nerfacto uses it, so that
space fills a cube and no corner of a grid is wasted:

    contract(x) = x                                     |x| <= 1
                  (2 - 1 / |x|) x / |x|                 |x| > 1,   |x| = max_d |x_d|

The box is what stays as it is, and becomes the middle half of the cube's sides.
"""

import jax
import jax.numpy as jnp

from bavs_jax.arrays import Array

RADIUS = 2.0  # contracted space is [-2, 2]^3
FARTHEST = 1e4  # half sides of the box; what stands for infinitely far


def contract(x: jax.Array) -> jax.Array:
    """Maps all of space [..., 3] into (-2, 2)^3; the identity in [-1, 1]^3.

    Numerics: the norm is clipped to at least 1, which makes both branches one formula, continuous
    with its radial derivative. Where two coordinates share the maximum there is a kink. The
    derivative of `max` asks which entry equals the maximum; a compiler that computes the entries
    anew, rounded otherwise, finds none and divides by 0. A comparison has no such gap.
    """
    norm: jax.Array | float = 1.0
    for axis in range(3):
        size = jnp.abs(x[..., axis : axis + 1])
        norm = jnp.where(size > norm, size, norm)
    return (2.0 - 1.0 / norm) / norm * x


def uncontract(y: jax.Array) -> jax.Array:
    """The inverse of `contract`: from the open cube (-2, 2)^3 [..., 3] to all of space."""
    norm = jnp.maximum(jnp.abs(y).max(-1, keepdims=True), 1.0)
    return y / (norm * (2.0 - norm))


def in_box(unit: jax.Array, *, contracted: bool) -> jax.Array:
    """Which points of the unit cube [..., 3] lie in the box itself, not in what is around it."""
    if not contracted:
        return jnp.ones(unit.shape[:-1], bool)
    return (jnp.abs(unit - 0.5) <= 0.25).all(-1)


def unit_coordinates(box: Array, positions: Array, *, contracted: bool) -> jax.Array:
    """Positions [..., 3] in scene units as coordinates in [0, 1]^3.

    Args:
      box: [2, 3] lower and upper corner, scene units.
      positions: [..., 3] scene units.
      contracted: false spreads the box over the unit cube, and points outside get the nearest
        face; true puts it into [1/4, 3/4]^3 and contracts the rest of space around it.
    """
    lower, upper = box
    if not contracted:
        return jnp.clip((positions - lower) / (upper - lower), 0.0, 1.0)
    centred = (2.0 * positions - lower - upper) / (upper - lower)
    return contract(centred) / (2.0 * RADIUS) + 0.5


def scene_positions(box: Array, unit: Array, *, contracted: bool) -> jax.Array:
    """The inverse of `unit_coordinates`: [..., 3] in [0, 1] as positions in scene units.

    Numerics: the faces of the unit cube, which stand for infinitely far in contracted space, are
    put `FARTHEST` half sides of the box away.
    """
    lower, upper = box
    if not contracted:
        return lower + unit * (upper - lower)
    most = RADIUS - 1.0 / FARTHEST
    centred = uncontract(jnp.clip(2.0 * RADIUS * (unit - 0.5), -most, most))
    return 0.5 * (lower + upper + centred * (upper - lower))
