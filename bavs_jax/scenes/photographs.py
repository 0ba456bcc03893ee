"""Photographs and exact depth of a known surface from any pose, by sphere tracing."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import Cameras, pixel_rays, subpixel_offsets, take, view_pixels
from bavs_jax.scenes import sdf
from bavs_jax.scenes.sdf_surface import SignedDistance

BACKGROUND = (1.0, 1.0, 1.0)
SUBSAMPLES = 3  # per pixel and axis
CONE_CHUNK = 1 << 14  # pixels per call; a last chunk that is not full costs as much
RAY_CHUNK = 1 << 11  # pixels per call, each with SUBSAMPLES**2 rays
COLOUR_TOLERANCE = 3e-4  # scene units
COLOUR_BISECTIONS = 6
DEPTH_MIN_STEP = 1e-3  # scene units

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


class Subject(NamedTuple):
    """A surface with its paint and light, and where one stands to take pictures of it."""

    name: str  # of its `Scene`
    version: int  # raise it when the look of the scene changes: caches are then made anew
    distance: sdf.DistanceFn
    signed_distance: SignedDistance  # the same for points [..., 3]
    shade: Callable[[sdf.Point, sdf.Point], sdf.Point]  # colour by place and view direction
    interval: Callable[..., tuple[jax.Array, jax.Array]]  # of rays or cones: where to look
    draw_poses: Callable[[jax.Array, int], np.ndarray]  # key, num -> [num, 3, 4]
    closed: bool  # whether one stands within it, not around it: each ray ends on the surface
    field_of_view: float  # radians across the width
    box: Box  # lower and upper corner, scene units
    near: float  # scene units, as in `Scene`
    far: float
    num_train: int
    num_test: int


def components(vectors: Array) -> sdf.Point:
    """Components of [..., 3]."""
    vectors = jnp.asarray(vectors)
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def pixel_cones(cameras: Cameras, pixels: jax.Array):
    """The ray through each pixel's centre and a bound on how far its other rays spread from it.

    Returns:
      `(origins, directions, spread)`: components [N], and distance per unit of distance [N].
    """
    view_ids = jnp.arange(len(cameras))
    rays = pixel_rays(cameras, view_ids, pixels)
    offsets = subpixel_offsets(SUBSAMPLES**2)
    apart = [
        jnp.linalg.norm(
            pixel_rays(cameras, view_ids, pixels + offsets[corner]).directions - rays.directions,
            axis=-1,
        )
        for corner in (0, SUBSAMPLES - 1)  # both diagonals; the other ends mirror them
    ]
    spread = 1.05 * jnp.max(jnp.stack(apart), axis=0)
    return components(rays.origins), components(rays.directions), spread


def first_touch(subject: Subject, cameras: Cameras, pixels: jax.Array):
    """Where the cone of each pixel may first touch the surface: `(t, touches, spread)`, all [N]."""
    origins, directions, spread = pixel_cones(cameras, pixels)
    enter, leave = subject.interval(origins, directions, spread)
    _, t, touches = sdf.march(
        subject.distance, origins, directions, enter, leave, spread=spread, tolerance=2e-3
    )
    return t, touches, spread


def photograph(
    subject: Subject, cameras: Cameras, pixels: jax.Array, t_start: jax.Array, spread: jax.Array
):
    """Red, green, blue, opacity [N] in [0, 1], means over a pixel, and depth [N] at its centre."""
    offsets = subpixel_offsets(SUBSAMPLES**2)
    num, sub = pixels.shape[0], offsets.shape[0]
    places = (offsets[:, None, :] + pixels[None]).reshape(-1, 2)
    rays = pixel_rays(cameras, jnp.tile(jnp.arange(num), sub), places)
    origins, directions = components(rays.origins), components(rays.directions)
    _, leave = subject.interval(origins, directions)
    # What a ray clips by less than a small part of the pixel's width hardly changes its colour.
    t_before, t, hit = sdf.march(
        subject.distance,
        origins,
        directions,
        jnp.tile(t_start, sub),
        leave,
        tolerance=COLOUR_TOLERANCE,
        min_step=jnp.tile(0.25 * spread * t_start, sub),
    )
    t = sdf.bisect(subject.distance, origins, directions, t_before, t, steps=COLOUR_BISECTIONS)
    # The channels stay apart: stacked to [..., 3] here, XLA would shade once for each of them.
    shaded = subject.shade(sdf.at(origins, directions, t), directions)
    channels = [
        jnp.where(hit, c, b).reshape(sub, num).mean(axis=0) for c, b in zip(shaded, BACKGROUND)
    ]
    opacity = hit.astype(jnp.float32).reshape(sub, num).mean(axis=0)

    middle = slice(sub // 2 * num, (sub // 2 + 1) * num)
    origins, directions = ((x[middle], y[middle], z[middle]) for x, y, z in (origins, directions))
    t_before, t, hit = sdf.march(
        subject.distance,
        origins,
        directions,
        t_start,
        leave[middle],
        tolerance=0.0,
        min_step=DEPTH_MIN_STEP,
    )
    depth = sdf.bisect(subject.distance, origins, directions, t_before, t)
    return *channels, opacity, jnp.where(hit, depth, 0.0)


def in_chunks(
    fn, cameras: Cameras, view_ids: np.ndarray, arrays: list[np.ndarray], chunk: int
) -> list[np.ndarray]:
    """Calls `fn(cameras, *rows)` on slices of one fixed length, the last one padded.

    Each row brings its own camera, so that the number of views is no shape that `fn` is compiled
    for: the next capture, of any number of poses, compiles nothing.
    """
    num, outputs = len(view_ids), []
    for start in range(0, num, chunk):
        rows = np.minimum(np.arange(start, start + chunk), num - 1)
        outputs.append(fn(take(cameras, view_ids[rows]), *(a[rows] for a in arrays)))
    return [np.concatenate(parts)[:num] for parts in zip(*outputs)]


@functools.cache
def compiled_steps(subject: Subject):
    """The two passes, jitted once for all photographs of a subject."""
    return tuple(jax.jit(functools.partial(step, subject)) for step in (first_touch, photograph))


class Photos(NamedTuple):
    """Pictures of a subject; rows as in `Scene.pixels`."""

    pixels: np.ndarray  # [N, 3] uint8 sRGB over white, each the mean of 3 x 3 rays
    alpha: np.ndarray  # [N] uint8 share of these rays that meet the surface
    depth: np.ndarray  # [N] float32 along the ray through the centre, 0 where it meets nothing


def take_photos(subject: Subject, cameras: Cameras) -> Photos:
    """Takes pictures from any poses outside of matter.

    The V cameras may have any lens; sizes may differ.
    """
    touch_fn, photograph_fn = compiled_steps(subject)
    cameras = jax.tree.map(np.asarray, cameras)
    view_ids, centres = view_pixels(cameras, np.arange(len(cameras)))
    t_start, touches, spread = in_chunks(touch_fn, cameras, view_ids, [centres], CONE_CHUNK)
    colours = np.tile(np.array(BACKGROUND, np.float32), (len(centres), 1))
    opacity, depth = np.zeros((2, len(centres)), np.float32)
    seen = np.flatnonzero(touches)
    if len(seen):
        arrays = [centres[seen], t_start[seen], spread[seen]]
        *channels, opacity[seen], depth[seen] = in_chunks(
            photograph_fn, cameras, view_ids[seen], arrays, RAY_CHUNK
        )
        colours[seen] = np.stack(channels, axis=-1)
    pixels, alpha = (np.rint(255.0 * x).astype(np.uint8) for x in (colours, opacity))
    return Photos(pixels, alpha, depth)
