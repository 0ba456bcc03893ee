"""Normalised distance `s` in [0, 1] along a ray, and the way back to `t`.

`s = (g(t) - g(near)) / (g(far) - g(near))` for a rising function g: even steps of s are even in t,
in inverse distance, or even nearby and by inverse distance beyond.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from bavs_jax.cameras import Rays
from bavs_jax.rendering.sampling import box_interval


class Spacing(NamedTuple):
    """A rising function and its inverse, of distances > 0."""

    warp: Callable[[jax.Array], jax.Array]
    unwarp: Callable[[jax.Array], jax.Array]


def _piecewise_warp(t):
    return jnp.where(t < 1.0, 0.5 * t, 1.0 - 0.5 / jnp.maximum(t, 1.0))


def _piecewise_unwarp(g):
    return jnp.where(g < 0.5, 2.0 * g, 0.5 / (1.0 - jnp.maximum(g, 0.5)))


SPACINGS = {
    "linear": Spacing(lambda t: t, lambda g: g),
    "disparity": Spacing(lambda t: -1.0 / t, lambda g: -1.0 / g),
    # Half of all steps before t = 1, the others by inverse distance, as in nerfacto.
    "piecewise": Spacing(_piecewise_warp, _piecewise_unwarp),
}


class Interval(struct.PyTreeNode):
    """The part of each ray that is looked at, and how steps are spaced on it."""

    near: jax.Array  # [R] scene units
    far: jax.Array  # [R]
    unit: float = struct.field(pytree_node=False, default=1.0)  # scene units that count as 1
    spacing: str = struct.field(pytree_node=False, default="linear")  # a key of SPACINGS

    def distance(self, s: jax.Array) -> jax.Array:
        """From s [R, S] in [0, 1] to t [R, S] in scene units."""
        spacing = SPACINGS[self.spacing]
        lower, upper = (spacing.warp(t / self.unit)[:, None] for t in (self.near, self.far))
        t = self.unit * spacing.unwarp(lower + s * (upper - lower))
        # Rounding may otherwise lead out of the interval by an ulp of far.
        return jnp.clip(t, self.near[:, None], self.far[:, None])

    @property
    def is_empty(self) -> jax.Array:
        """[R] bool, where there is nothing to look at."""
        return self.near >= self.far


IntervalFn = Callable[[Rays], Interval]  # what of each of R rays is looked at


def box_intervals(rays: Rays, box, *, near: float, far: float) -> Interval:
    """What of each ray lies in a box and within [near, far], evenly spaced."""
    enter, leave = box_interval(rays, jnp.asarray(box), near, far)
    return Interval(enter, leave)


def open_intervals(rays: Rays, *, near: float, far: float, unit: float) -> Interval:
    """All of each ray within [near, far], evenly spaced up to `unit` and by disparity beyond."""
    shape = rays.origins.shape[:1]
    return Interval(jnp.full(shape, near), jnp.full(shape, far), unit=unit, spacing="piecewise")
