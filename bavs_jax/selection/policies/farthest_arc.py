"""Farthest-view sampling on the sphere of directions: only where a view looks from counts."""

import jax.numpy as jnp

from bavs_jax.selection.policies.farthest import make_farthest


def great_circle(a, b, centre):
    """Angles [N, M] at the scene centre [3] between camera centres [N, 3] and [M, 3], radians.

    `atan2(|a x b|, a . b)`, which is as exact for neighbours as for opposite views; a camera at
    the centre itself, which has no direction, is at the angle 0 from all.
    """
    a, b = (a - centre)[:, None], (b - centre)[None]
    sine = jnp.linalg.norm(jnp.cross(a, b), axis=-1)
    return jnp.arctan2(sine, (a * b).sum(-1))


POLICY = make_farthest(
    name="farthest_arc",
    summary="Greedily the view whose nearest chosen view is farthest along the great circle.",
    distance=great_circle,
)
