"""The object of the procedural scene: its shape, its paint and its light, as pure functions.

It is uneven on purpose, so that some views teach much more than others: a tower with one wall of
mosaic coffers behind a striped hook, one wall with a deep pocket, and two sides that are smooth; it
stands on a plinth that is tiled on one half only.
"""

import jax
import jax.numpy as jnp

from bavs_jax.scenes import sdf
from bavs_jax.scenes.sdf import Point
from bavs_jax.scenes.shading import Colour, mirrored, mix, nearest_paint, openness

SCENE_RADIUS = 0.99  # scene units; a ball around the origin that holds the object

# Shape, in the frame of the tower: u along its width, v out of the carved wall, w up.
TURN = 0.5  # radians about z, so that no wall faces an axis
LIFT = 0.05  # scene units along z, so that a ball around the origin holds the object closely
PLINTH = ((0.0, 0.0, -0.62), 0.74, 0.08, 0.03)
TOWER = ((0.0, 0.0, -0.1), (0.38, 0.3, 0.46), 0.05)
DOME = ((-0.3, -0.16, -0.2), 0.36)
DOME_FILLET = 0.16
COFFER_PERIOD, COFFER_COUNT = 0.13, (2, 2)  # (2 n + 1) cells along u and along w
COFFER_HALF = (0.048, 0.05, 0.048)
COFFER_CENTRE = (0.02, 0.3, -0.11)
POCKET = ((0.46, 0.02, 0.16), (-0.02, 0.0, -0.18), 0.17)
PEARL = ((0.06, 0.0, -0.1), 0.075)
HOOK_ARCH = ((-0.06, 0.5, 0.12), 0.2, 0.05)
HOOK_FOOT, HOOK_TIP = ((-0.26, 0.5, -0.6), (0.14, 0.5, -0.02))
LANTERN = ((0.14, 0.5, -0.1), 0.1)
RING = ((0.06, 0.02, 0.56), 0.19, 0.05)

# Paint, sRGB.
CREAM, SLATE, SAND = (0.93, 0.87, 0.74), (0.16, 0.22, 0.36), (0.80, 0.68, 0.52)
TEAL, MINT, GOLD = (0.04, 0.48, 0.62), (0.62, 0.90, 0.62), (0.95, 0.68, 0.16)
RED, IVORY, PURPLE = (0.83, 0.14, 0.16), (0.96, 0.94, 0.88), (0.48, 0.22, 0.66)
AMBER, MAROON, CYAN = (1.0, 0.72, 0.20), (0.42, 0.05, 0.12), (0.20, 0.75, 0.90)
SUN = (0.45, 0.35, 0.82)  # direction to the light, unit within 1e-3


# --- shape -----------------------------------------------------------------------------------


def to_tower(p: Point) -> Point:
    """Coordinates of a scene point in the tower's frame."""
    u, v, w = sdf.turn(p, TURN)
    return u, v, w - LIFT


def coffer_cell(q: Point) -> tuple[Point, jax.Array, jax.Array]:
    """A point of the tower's frame within its coffer's cell, and the cell's two indices."""
    u, v, w = (a - c for a, c in zip(q, COFFER_CENTRE))
    folded = [sdf.fold(a, COFFER_PERIOD, n) for a, n in zip((u, w), COFFER_COUNT)]
    index = [jnp.round((a - f) / COFFER_PERIOD) for a, f in zip((u, w), folded)]
    return (folded[0], v, folded[1]), index[0], index[1]


def part_distances(q: Point) -> list[jax.Array]:
    """Signed distance to each part, in the tower's frame; the order is that of `paint`."""
    tower = sdf.smooth_union(sdf.box(q, *TOWER), sdf.sphere(q, *DOME), DOME_FILLET)
    coffers = sdf.box(coffer_cell(q)[0], (0.0, 0.0, 0.0), COFFER_HALF)
    tower = sdf.subtract(tower, coffers)
    tower = sdf.subtract(tower, sdf.capsule(q, *POCKET))
    # The arch and its two straight legs are one tube.
    hook = sdf.arch(q, *HOOK_ARCH)
    arch_u, arch_w, ring, tube = HOOK_ARCH[0][0], HOOK_ARCH[0][2], *HOOK_ARCH[1:]
    foot = sdf.capsule(q, HOOK_FOOT, (arch_u - ring, HOOK_FOOT[1], arch_w), tube)
    tip = sdf.capsule(q, HOOK_TIP, (arch_u + ring, HOOK_TIP[1], arch_w), tube)
    return [
        sdf.disc(q, *PLINTH),
        tower,
        jnp.minimum(hook, jnp.minimum(foot, tip)),
        sdf.sphere(q, *LANTERN),
        sdf.sphere(q, *PEARL),
        sdf.torus(q, *RING),
    ]


def distance(p: Point) -> jax.Array:
    """Signed distance of points given as components, scene units."""
    parts = part_distances(to_tower(p))
    nearest = parts[0]
    for part in parts[1:]:
        nearest = jnp.minimum(nearest, part)
    return nearest


def signed_distance(points: jax.Array) -> jax.Array:
    """Signed distance [...] of points [..., 3] to the surface: negative inside, 1-Lipschitz.

    It is a bound, not always the exact distance: cuts and unions keep it safe from above.
    """
    return distance((points[..., 0], points[..., 1], points[..., 2]))


# --- paint and light -------------------------------------------------------------------------


def rainbow(phase: jax.Array) -> Point:
    """A saturated colour from a phase with period 1."""
    shifts = (0.0, 0.35, 0.7)
    red, green, blue = (0.58 + 0.42 * jnp.cos(2.0 * jnp.pi * (phase + s)) for s in shifts)
    return red, green, blue


def paint_plinth(q: Point) -> Point:
    """Fine polar tiles on the half in front of the carved wall, plain sand on the other."""
    radius, angle = sdf.norm(q[0], q[1]), jnp.arctan2(q[1], q[0])
    sector, ring = jnp.floor(angle * (18.0 / jnp.pi)), jnp.floor(radius / 0.1)
    odd = jnp.mod(sector + ring, 2.0)
    tiled = (q[1] > 0.0) & (radius > 0.3)
    return mix(SAND, mix(CREAM, SLATE, odd), tiled.astype(odd.dtype))


def paint_tower(q: Point) -> Point:
    """Teal on the smooth sides, a mosaic in the coffers, amber to maroon down the pocket."""
    teal = mix(TEAL, MINT, jnp.clip(0.5 + q[2], 0.0, 1.0))
    carved = q[1] > COFFER_CENTRE[1] - COFFER_HALF[1] - 0.01
    colour = mix(teal, CREAM, jnp.clip((q[1] - 0.2) * 20.0, 0.0, 1.0))
    cell, column, row = coffer_cell(q)
    in_coffer = (sdf.box(cell, (0.0, 0.0, 0.0), COFFER_HALF) < 0.004) & carved
    mosaic = rainbow(0.37 * column + 0.61 * row)
    colour = mix(colour, mosaic, in_coffer.astype(q[0].dtype))
    depth = sdf.along_segment(q, *POCKET[:2])
    rings = 0.85 + 0.15 * jnp.sign(jnp.sin(60.0 * depth))
    red, green, blue = (c * rings for c in mix(AMBER, MAROON, depth))
    in_pocket = (sdf.capsule(q, *POCKET) < 0.004).astype(q[0].dtype)
    return mix(colour, (red, green, blue), in_pocket)


def paint_hook(q: Point) -> Point:
    """Stripes along the length of the tube."""
    u, w = q[0] - HOOK_ARCH[0][0], q[2] - HOOK_ARCH[0][2]
    ring = HOOK_ARCH[1]
    bent = ring * jnp.arctan2(w, -u)
    along = jnp.where(w > 0.0, bent, jnp.where(u < 0.0, w, ring * jnp.pi - w))
    return mix(RED, IVORY, (jnp.sin(along * (2.0 * jnp.pi / 0.12)) > 0.0).astype(u.dtype))


def paint(q: Point) -> tuple[Colour, jax.Array]:
    """Albedo (sRGB components) and strength of the highlight, in the tower's frame."""
    colours: list[Colour] = [paint_plinth(q), paint_tower(q), paint_hook(q), PURPLE, CYAN, GOLD]
    gloss = [0.05, 0.25, 0.35, 0.6, 0.6, 0.7]
    return nearest_paint(part_distances(q), colours, gloss)


def shade(p: Point, directions: Point) -> Point:
    """Colour of surface points seen along `directions`: Lambert, sky, and a Phong highlight."""
    albedo, shine = paint(to_tower(p))
    normal = sdf.normals(distance, p)
    open_share = openness(distance, p, normal)
    facing = sum(n * s for n, s in zip(normal, SUN))
    diffuse = jnp.maximum(facing, 0.0)
    mirror = jnp.maximum(mirrored(directions, normal, SUN), 0.0)
    highlight = shine * mirror**20 * (facing > 0.0)
    light = open_share * (0.62 + 0.10 * normal[2] + 0.45 * diffuse)
    red, green, blue = (jnp.clip(a * light + highlight * open_share, 0.0, 1.0) for a in albedo)
    return red, green, blue
