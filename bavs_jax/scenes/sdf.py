"""Signed distance fields: primitives, their combination, and how rays meet them.

A point is a tuple `(x, y, z)` of arrays of one shape rather than an array [..., 3]: long contiguous
axes are what CPUs vectorise. Every function here is 1-Lipschitz, `|f(p) - f(q)| <= |p - q|`, and so
is each combination, which is what makes sphere tracing safe.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

Point = tuple[jax.Array, jax.Array, jax.Array]
DistanceFn = Callable[[Point], jax.Array]


def norm(*components: jax.Array) -> jax.Array:
    """Euclidean length of components.

    *Numerics*: 1e-12 under the root keeps the gradient 0, not NaN, at the origin.
    """
    return jnp.sqrt(sum(c * c for c in components) + 1e-12)


# --- primitives ------------------------------------------------------------------------------


def sphere(p: Point, centre, radius: float) -> jax.Array:
    """Ball."""
    return norm(p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]) - radius


def box(p: Point, centre, half, rounding: float = 0.0) -> jax.Array:
    """Box of half sides `half`, rounding included."""
    x, y, z = (jnp.abs(a - c) - (h - rounding) for a, c, h in zip(p, centre, half))
    outside = norm(jnp.maximum(x, 0.0), jnp.maximum(y, 0.0), jnp.maximum(z, 0.0))
    inside = jnp.minimum(jnp.maximum(x, jnp.maximum(y, z)), 0.0)
    return outside + inside - rounding


def disc(p: Point, centre, radius: float, half_height: float, rounding: float = 0.0) -> jax.Array:
    """Cylinder along z, rounding included."""
    radial = norm(p[0] - centre[0], p[1] - centre[1]) - (radius - rounding)
    axial = jnp.abs(p[2] - centre[2]) - (half_height - rounding)
    outside = norm(jnp.maximum(radial, 0.0), jnp.maximum(axial, 0.0))
    return outside + jnp.minimum(jnp.maximum(radial, axial), 0.0) - rounding


def along_segment(p: Point, start, end) -> jax.Array:
    """Where on the segment the nearest point lies: 0 at `start`, 1 at `end`."""
    axis = [e - s for s, e in zip(start, end)]
    length2 = sum(a * a for a in axis)
    along = sum((c - s) * a for c, s, a in zip(p, start, axis)) / length2
    return jnp.clip(along, 0.0, 1.0)


def capsule(p: Point, start, end, radius: float) -> jax.Array:
    """All points within `radius` of a segment."""
    along = along_segment(p, start, end)
    return norm(*(c - s - (e - s) * along for c, s, e in zip(p, start, end))) - radius


def arch(p: Point, centre, ring: float, tube: float) -> jax.Array:
    """Upper half of a torus in the x-z plane, with round ends."""
    x, y, z = (a - c for a, c in zip(p, centre))
    upper = norm(norm(x, z) - ring, y)
    ends = norm(jnp.abs(x) - ring, y, z)
    return jnp.where(z > 0.0, upper, ends) - tube


def torus(p: Point, centre, ring: float, tube: float) -> jax.Array:
    """Torus in the x-z plane."""
    x, y, z = (a - c for a, c in zip(p, centre))
    return norm(norm(x, z) - ring, y) - tube


# --- combination -----------------------------------------------------------------------------


def subtract(a: jax.Array, b: jax.Array) -> jax.Array:
    """What is left of solid `a` where `b` is cut out."""
    return jnp.maximum(a, -b)


def smooth_union(a: jax.Array, b: jax.Array, width: float) -> jax.Array:
    """Union with a fillet: a convex mixture of both distances where they differ by < `width`."""
    blend = jnp.maximum(width - jnp.abs(a - b), 0.0) / width
    return jnp.minimum(a, b) - 0.25 * width * blend * blend


def turn(p: Point, angle: float) -> Point:
    """Coordinates of a point in a frame that is turned about z by `angle`, radians."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return (cos * p[0] + sin * p[1], cos * p[1] - sin * p[0], p[2])


def fold(a: jax.Array, period: float, count: int) -> jax.Array:
    """Coordinate within the nearest of `2 count + 1` cells centred on multiples of `period`."""
    cell = jnp.clip(jnp.round(a / period), -count, count)
    return a - period * cell


# --- rays ------------------------------------------------------------------------------------


def at(origins: Point, directions: Point, t: jax.Array) -> Point:
    """The point at distance `t` along each ray."""
    x, y, z = (o + t * d for o, d in zip(origins, directions))
    return x, y, z


def march(
    distance_fn: DistanceFn,
    origins: Point,
    directions: Point,
    t_start: jax.Array,
    t_end: jax.Array,
    *,
    spread: jax.Array | float = 0.0,
    tolerance: float = 1e-3,
    min_step: jax.Array | float = 0.0,
    max_steps: int = 256,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Sphere tracing: steps by the distance to the surface, which can never pass it.

    With `spread > 0` it traces a cone around the ray and stops where the cone may first touch the
    surface: no ray within the cone meets it earlier. With `min_step > 0` rays that graze a surface
    do not creep along it; what a ray clips by less than that may be missed.

    Args:
      distance_fn: 1-Lipschitz signed distance.
      origins: ray starts, components of shape [R].
      directions: unit, components of shape [R].
      t_start: [R] distance to begin at; must lie outside of the surface.
      t_end: [R] distance at which a ray has missed.
      spread: [R] or a number: radius of the cone divided by the distance.
      tolerance: stop at this distance to the surface, scene units.
      min_step: shortest step, scene units.
      max_steps: bound on the number of steps.

    Returns:
      `(t_before, t, hit)`: the last two distances along each ray [R], the first of them outside of
      the surface, and whether the ray stopped before `t_end` [R] bool; a ray that runs out of steps
      counts as a hit where it stands.
    """

    # The gap is that at `t_before`, or unknown at first: the distance is compiled only once.
    def unfinished(carry):
        step, _, t, gap = carry
        return (step < max_steps) & jnp.any((gap > tolerance) & (t < t_end))

    def advance(carry):
        step, t_before, t, gap = carry
        go = (gap > tolerance) & (t < t_end)
        gap = jnp.where(go, distance_fn(at(origins, directions, t)) - spread * t, gap)
        go &= gap > tolerance
        # The cone widens while it advances: dividing by 1 + spread keeps the step safe.
        t_next = t + jnp.maximum(gap / (1.0 + spread), min_step)
        return step + 1, jnp.where(go, t, t_before), jnp.where(go, t_next, t), gap

    start = (0, t_start, t_start, jnp.full_like(t_start, jnp.inf))
    _, t_before, t, _ = jax.lax.while_loop(unfinished, advance, start)
    return t_before, t, t < t_end


def bisect(
    distance_fn: DistanceFn,
    origins: Point,
    directions: Point,
    t_outside: jax.Array,
    t_inside: jax.Array,
    *,
    steps: int = 16,
) -> jax.Array:
    """Where each ray enters the surface between two distances, to `2^-steps` of their gap."""

    def halve(_, bounds):
        outside, inside = bounds
        middle = 0.5 * (outside + inside)
        is_outside = distance_fn(at(origins, directions, middle)) > 0.0
        return jnp.where(is_outside, middle, outside), jnp.where(is_outside, inside, middle)

    return jax.lax.fori_loop(0, steps, halve, (t_outside, t_inside))[1]


def normals(distance_fn: DistanceFn, p: Point, step: float = 1e-3) -> Point:
    """Unit normals from four distances at the corners of a small tetrahedron."""
    corners = jnp.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], p[0].dtype)

    # A loop rather than four calls: the distance is compiled once, and its result kept.
    def add(k, gradient):
        corner = corners[k]
        x, y, z = (a + step * corner[i] for i, a in enumerate(p))
        value = distance_fn((x, y, z))
        return tuple(g + corner[i] * value for i, g in enumerate(gradient))

    gradient = jax.lax.fori_loop(0, corners.shape[0], add, tuple(jnp.zeros_like(a) for a in p))
    length = norm(*gradient)
    x, y, z = (g / length for g in gradient)
    return x, y, z
