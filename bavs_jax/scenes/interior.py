"""The room of the interior scene: its shape, its paint, its light and where cameras may stand.

Occlusion decides here what a view teaches: two partitions, one of them with a window, leave a way
around them; columns, a niche in a wall and furniture hide what is behind. The room is closed: each
ray ends on a surface. One unit is some two metres.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import look_at
from bavs_jax.scenes import sdf
from bavs_jax.scenes.sdf import Point
from bavs_jax.scenes.shading import Colour, mirrored, mix, nearest_paint, openness

# Shape; half sides, radii and places in scene units. The niche reaches into the room, so that its
# opening is no surface.
ROOM = ((0.0, 0.0, 0.0), (1.4, 1.1, 0.6))
NICHE = ((0.95, 1.1, -0.02), (0.28, 0.25, 0.3))
LEFT_PARTITION = ((-0.45, 0.75, 0.0), (0.06, 0.45, 0.7))
RIGHT_PARTITION = ((0.5, -0.75, 0.0), (0.06, 0.45, 0.7))
WINDOW = ((0.5, -0.72, 0.1), (0.2, 0.22, 0.22))
ROUND_COLUMN = ((-0.5, -0.35, 0.0), 0.1, 0.7)
SQUARE_COLUMN = ((0.4, 0.5, 0.0), (0.1, 0.1, 0.7))
TABLE_TOP = ((-1.0, 0.62, -0.24), 0.27, 0.035)
TABLE_LEG = ((-1.0, 0.62, -0.45), 0.07, 0.22)
RING = ((-1.0, 0.62, -0.045), 0.12, 0.045)
BENCH = ((-0.15, -0.86, -0.47), (0.3, 0.16, 0.13))
BALL = ((1.0, -0.65, -0.36), 0.24)
URN = ((0.95, 1.18, -0.2), (0.95, 1.18, -0.05), 0.11)
ROUNDING = 0.02
SCENE_BOX = ((-1.45, -1.15, -0.65), (1.45, 1.4, 0.65))  # holds all surfaces that can be seen

# Paint, sRGB.
OAK, STRAW = (0.50, 0.33, 0.20), (0.80, 0.66, 0.44)
CEILING, SKY = (0.84, 0.84, 0.80), (0.62, 0.74, 0.84)
TEAL, MINT = (0.10, 0.45, 0.52), (0.58, 0.80, 0.62)
BRICK, PEACH = (0.62, 0.24, 0.18), (0.90, 0.62, 0.46)
NAVY, LILAC = (0.20, 0.24, 0.50), (0.70, 0.62, 0.84)
OLIVE, LEMON = (0.36, 0.42, 0.18), (0.86, 0.80, 0.42)
PLUM, ROSE = (0.42, 0.16, 0.40), (0.88, 0.58, 0.66)
SLATE, ICE = (0.26, 0.32, 0.38), (0.72, 0.82, 0.86)
RED, IVORY = (0.74, 0.16, 0.16), (0.88, 0.84, 0.74)
GOLD, CYAN = (0.88, 0.62, 0.18), (0.20, 0.62, 0.76)
LAMP = (0.05, 0.05, 0.5)  # a point of light under the ceiling; it throws no shadows

# Cameras: a phone's wide lens, held by someone who walks about.
FIELD_OF_VIEW = math.radians(69.0)
CLEARANCE = 0.2  # scene units around a camera that hold no matter
HEIGHTS = (-0.25, 0.3)
TILT = 15.0  # degrees, standard deviation of the gaze's elevation
ARM = 0.7  # scene units: no camera looks straight at something nearer than that
NUM_DRAWN = 256  # poses drawn at a time; about a third of them can be used


# --- shape -----------------------------------------------------------------------------------


def part_distances(p: Point) -> list[jax.Array]:
    """Signed distance to each part; the order is that of `paint`."""
    air = jnp.minimum(sdf.box(p, *ROOM), sdf.box(p, *NICHE))
    right_partition = sdf.subtract(sdf.box(p, *RIGHT_PARTITION, ROUNDING), sdf.box(p, *WINDOW))
    table = jnp.minimum(sdf.disc(p, *TABLE_TOP, ROUNDING), sdf.disc(p, *TABLE_LEG))
    return [
        -air,
        sdf.box(p, *LEFT_PARTITION, ROUNDING),
        right_partition,
        sdf.disc(p, *ROUND_COLUMN),
        sdf.box(p, *SQUARE_COLUMN, ROUNDING),
        table,
        sdf.torus(p, *RING),
        sdf.box(p, *BENCH, ROUNDING),
        sdf.sphere(p, *BALL),
        sdf.capsule(p, *URN),
    ]


def distance(p: Point) -> jax.Array:
    """Signed distance of points given as components, scene units."""
    nearest, *others = part_distances(p)
    for part in others:
        nearest = jnp.minimum(nearest, part)
    return nearest


def signed_distance(points: jax.Array) -> jax.Array:
    """Signed distance [...] of points [..., 3] to the surface: negative inside, 1-Lipschitz.

    It is a bound, not always the exact distance: cuts and unions keep it safe from above. All
    beyond the walls is solid.
    """
    return distance((points[..., 0], points[..., 1], points[..., 2]))


# --- paint and light -------------------------------------------------------------------------


def soft(wave: jax.Array) -> jax.Array:
    """A wave in [-1, 1] as a share in [0, 1], with flat tops and edges a third of a period wide.

    A hard edge would hold details of all sizes, finer than pixels too.
    """
    return jnp.clip(0.5 + 0.9 * wave, 0.0, 1.0)


def waves(along: jax.Array, up: jax.Array, phase: float) -> jax.Array:
    """A pattern in [0, 1] without a period that one would notice: two waves across each other."""
    return 0.5 + 0.25 * (
        jnp.sin(9.0 * along + 4.0 * up + phase) + jnp.sin(-5.0 * along + 9.0 * up + 2.0 * phase)
    )


def paint_walls(p: Point) -> Point:
    """Checks on the floor, broad bands on the ceiling, two colours of its own on each wall."""
    x, y, z = p
    beyond = [jnp.abs(a - c) - h for a, c, h in zip(p, *ROOM)]
    checks = mix(OAK, STRAW, soft(jnp.sin(x * (jnp.pi / 0.3)) * jnp.sin(y * (jnp.pi / 0.3))))
    bands = mix(CEILING, SKY, soft(jnp.sin(7.0 * x + 5.0 * y)))
    level = choose(z > 0.0, bands, checks)
    ends = choose(x > 0.0, mix(TEAL, MINT, waves(y, z, 0.5)), mix(BRICK, PEACH, waves(y, z, 1.7)))
    sides = choose(y > 0.0, mix(NAVY, LILAC, waves(x, z, 0.0)), mix(OLIVE, LEMON, waves(x, z, 2.9)))
    upright = choose(beyond[0] > beyond[1], ends, sides)
    walls = choose(beyond[2] > jnp.maximum(beyond[0], beyond[1]), level, upright)
    # What lies behind the wall's plane belongs to the niche.
    return choose(beyond[1] > 1e-2, mix(GOLD, BRICK, waves(x + y, z, 1.0)), walls)


def choose(condition: jax.Array, a: Colour, b: Colour) -> Point:
    """Colour `a` where the condition holds, else `b`."""
    red, green, blue = (jnp.where(condition, x, y) for x, y in zip(a, b))
    return red, green, blue


def paint_partition(p: Point, middle: float, left: Colour, right: Colour, other: Colour) -> Point:
    """Slanting stripes of one colour on the left side, of another one on the right."""
    stripes = soft(jnp.sin(10.0 * p[1] + 10.0 * p[2]))
    return mix(choose(p[0] < middle, left, right), other, stripes)


def paint(p: Point) -> tuple[Colour, jax.Array]:
    """Albedo (sRGB components) and strength of the highlight."""
    x, y, z = p
    around = jnp.arctan2(y - ROUND_COLUMN[0][1], x - ROUND_COLUMN[0][0])
    column = mix(RED, IVORY, soft(jnp.sin(2.0 * around + 12.0 * z)))
    table = mix(OAK, GOLD, waves(x, y, 0.4))
    ball = mix(CYAN, NAVY, soft(jnp.sin(12.0 * z + 8.0 * x)))
    colours: list[Colour] = [
        paint_walls(p),
        paint_partition(p, LEFT_PARTITION[0][0], ROSE, ICE, SLATE),
        paint_partition(p, RIGHT_PARTITION[0][0], LEMON, LILAC, PLUM),
        column,
        mix(SLATE, MINT, soft(jnp.sin(12.0 * z))),
        table,
        RED,
        mix(PLUM, PEACH, soft(jnp.sin(14.0 * x))),
        ball,
        mix(IVORY, TEAL, soft(jnp.sin(25.0 * z))),
    ]
    gloss = [0.08, 0.08, 0.08, 0.3, 0.2, 0.3, 0.5, 0.2, 0.5, 0.4]
    return nearest_paint(part_distances(p), colours, gloss)


def shade(p: Point, directions: Point) -> Point:
    """Colour of surface points seen along `directions`: Lambert, half-light, a Phong highlight."""
    albedo, shine = paint(p)
    normal = sdf.normals(distance, p)
    open_share = openness(distance, p, normal)
    to_lamp = [c - a for a, c in zip(p, LAMP)]
    away = sdf.norm(*to_lamp)
    x, y, z = (a / away for a in to_lamp)
    facing = normal[0] * x + normal[1] * y + normal[2] * z
    bright = 1.0 / (1.0 + (0.7 * away) ** 2)  # falls off as from a lamp of some size
    mirror = jnp.maximum(mirrored(directions, normal, (x, y, z)), 0.0)
    highlight = shine * bright * mirror**12 * (facing > 0.0)
    light = open_share * (0.62 + 0.08 * normal[2] + 0.8 * bright * jnp.maximum(facing, 0.0))
    red, green, blue = (jnp.clip(a * light + highlight * open_share, 0.0, 1.0) for a in albedo)
    return red, green, blue


# --- cameras ---------------------------------------------------------------------------------


def room_poses(key: jax.Array, num: int) -> np.ndarray:
    """Poses [num, 3, 4] of someone who walks about and looks around, by one law for all views.

    Places are uniform in what is at least `CLEARANCE` from any matter, between two heights. Gazes
    are uniform in azimuth, and normal in elevation about the horizon; where one meets something
    nearer than `ARM`, it is drawn again, place and all. Cameras are upright.
    """
    poses: list[np.ndarray] = []
    for number in itertools.count():
        drawn = draw_gazes(jax.random.fold_in(key, number))
        positions, directions, is_free = (np.asarray(a, np.float64) for a in drawn)
        for i in np.flatnonzero(is_free):
            poses.append(look_at(positions[i], positions[i] + directions[i]))
        if len(poses) >= num:
            break
    return np.stack(poses[:num]).astype(np.float32)


@jax.jit
def draw_gazes(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Places and gazes [NUM_DRAWN, 3], and which of them are free of matter [NUM_DRAWN]."""
    place_key, turn_key, tilt_key = jax.random.split(key, 3)
    lower, upper = (np.array(ROOM[0]) + side * np.array(ROOM[1]) for side in (-1.0, 1.0))
    lower[2], upper[2] = HEIGHTS
    positions = jax.random.uniform(place_key, (NUM_DRAWN, 3), minval=lower, maxval=upper)
    azimuth = jax.random.uniform(turn_key, (NUM_DRAWN,), maxval=2.0 * np.pi)
    elevation = jnp.radians(TILT) * jax.random.normal(tilt_key, (NUM_DRAWN,))
    level = jnp.cos(elevation)
    gaze = level * jnp.cos(azimuth), level * jnp.sin(azimuth), jnp.sin(elevation)
    place = positions[:, 0], positions[:, 1], positions[:, 2]
    start, arm = jnp.zeros(NUM_DRAWN), jnp.full(NUM_DRAWN, ARM)
    _, _, is_met = sdf.march(distance, place, gaze, start, arm)
    return positions, jnp.stack(gaze, axis=-1), (distance(place) >= CLEARANCE) & ~is_met
