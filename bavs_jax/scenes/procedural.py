"""A scene made on the spot: photographs and exact depth of the sculpture from any pose."""

import functools
import hashlib
import json
import os
import pathlib
import tempfile
import warnings
import zipfile
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.arrays import Array
from bavs_jax.cameras import (
    Cameras,
    hemisphere_poses,
    make_cameras,
    pixel_rays,
    subpixel_offsets,
    take,
    view_pixels,
)
from bavs_jax.scenes import sculpture, sdf
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.zoom import Zoom, magnifications

SOURCE_VERSION = 3  # raise it when the look of the scene changes: caches are then made anew
CAMERA_RADIUS = 3.2  # scene units
NEAR = 0.05  # scene units; least distance of a camera to what it may see
FIELD_OF_VIEW = 0.64  # radians across the width; holds the whole object from every side
BACKGROUND = (1.0, 1.0, 1.0)
MAX_PIXELS = 1 << 28  # of all views; each takes some 40 bytes on the way
SUBSAMPLES = 3  # per pixel and axis
CONE_CHUNK = 1 << 14  # pixels per call; a last chunk that is not full costs as much
RAY_CHUNK = 1 << 11  # pixels per call, each with SUBSAMPLES**2 rays
COLOUR_TOLERANCE = 3e-4  # scene units
COLOUR_BISECTIONS = 6
DEPTH_MIN_STEP = 1e-3  # scene units


def components(vectors: Array) -> sdf.Point:
    """Components of [..., 3]."""
    vectors = jnp.asarray(vectors)
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def ball_interval(
    origins: sdf.Point, directions: sdf.Point, spread: jax.Array | float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Distances at which rays, or cones of some spread, enter and leave the object's ball.

    Both are 0 for rays that pass it by.
    """
    middle = -sum(o * d for o, d in zip(origins, directions))
    radius = sculpture.SCENE_RADIUS + spread * (middle + sculpture.SCENE_RADIUS)
    half2 = radius**2 - sum(o * o for o in origins) + middle**2
    half = jnp.sqrt(jnp.maximum(half2, 0.0))
    meets = (half2 > 0.0) & (middle + half > 0.0)
    return (
        jnp.where(meets, jnp.maximum(middle - half, 0.0), 0.0),
        jnp.where(meets, middle + half, 0.0),
    )


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


def first_touch(cameras: Cameras, pixels: jax.Array):
    """Where the cone of each pixel may first touch the object: `(t, touches, spread)`, all [N]."""
    origins, directions, spread = pixel_cones(cameras, pixels)
    enter, leave = ball_interval(origins, directions, spread)
    _, t, touches = sdf.march(
        sculpture.distance, origins, directions, enter, leave, spread=spread, tolerance=2e-3
    )
    return t, touches, spread


def photograph(cameras: Cameras, pixels: jax.Array, t_start: jax.Array, spread: jax.Array):
    """Red, green, blue, opacity [N] in [0, 1], means over a pixel, and depth [N] at its centre."""
    offsets = subpixel_offsets(SUBSAMPLES**2)
    num, sub = pixels.shape[0], offsets.shape[0]
    places = (offsets[:, None, :] + pixels[None]).reshape(-1, 2)
    rays = pixel_rays(cameras, jnp.tile(jnp.arange(num), sub), places)
    origins, directions = components(rays.origins), components(rays.directions)
    _, leave = ball_interval(origins, directions)
    # What a ray clips by less than a small part of the pixel's width hardly changes its colour.
    t_before, t, hit = sdf.march(
        sculpture.distance,
        origins,
        directions,
        jnp.tile(t_start, sub),
        leave,
        tolerance=COLOUR_TOLERANCE,
        min_step=jnp.tile(0.25 * spread * t_start, sub),
    )
    t = sdf.bisect(sculpture.distance, origins, directions, t_before, t, steps=COLOUR_BISECTIONS)
    # The channels stay apart: stacked to [..., 3] here, XLA would shade once for each of them.
    shaded = sculpture.shade(sdf.at(origins, directions, t), directions)
    channels = [
        jnp.where(hit, c, b).reshape(sub, num).mean(axis=0) for c, b in zip(shaded, BACKGROUND)
    ]
    opacity = hit.astype(jnp.float32).reshape(sub, num).mean(axis=0)

    middle = slice(sub // 2 * num, (sub // 2 + 1) * num)
    origins, directions = ((x[middle], y[middle], z[middle]) for x, y, z in (origins, directions))
    t_before, t, hit = sdf.march(
        sculpture.distance,
        origins,
        directions,
        t_start,
        leave[middle],
        tolerance=0.0,
        min_step=DEPTH_MIN_STEP,
    )
    depth = sdf.bisect(sculpture.distance, origins, directions, t_before, t)
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
def compiled_steps():
    """The two passes, jitted once for all captures."""
    return jax.jit(first_touch), jax.jit(photograph)


class Photos(NamedTuple):
    """Pictures of the sculpture; rows as in `Scene.pixels`."""

    pixels: np.ndarray  # [N, 3] uint8 sRGB over white, each the mean of 3 x 3 rays
    alpha: np.ndarray  # [N] uint8 share of these rays that meet the sculpture
    depth: np.ndarray  # [N] float32 along the ray through the centre, 0 where it meets nothing


def capture(cameras: Cameras) -> Photos:
    """Takes pictures of the sculpture from any poses outside of it, as an active robot would.

    The V cameras may have any lens; sizes may differ.
    """
    touch_fn, photograph_fn = compiled_steps()
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


def hemisphere_cameras(key: jax.Array, num: int, *, image_size: int) -> Cameras:
    """Square cameras on the upper hemisphere around the sculpture (Eq 14)."""
    poses = hemisphere_poses(key, num, centre=(0.0, 0.0, 0.0), radius=CAMERA_RADIUS)
    focal = 0.5 * image_size / np.tan(0.5 * FIELD_OF_VIEW)
    intrinsics = [[focal, focal, 0.5 * image_size, 0.5 * image_size]] * num
    return make_cameras(poses, intrinsics, [[image_size, image_size]] * num)


def at_distances(cameras: Cameras, zoom: Zoom | None) -> tuple[Cameras, float, float]:
    """Cameras moved along their lines of sight; their least and their largest possible distance."""
    factor = 1.0 if zoom is None else zoom.factor
    nearest, farthest = (CAMERA_RADIUS * factor**power for power in (-0.5, 0.5))
    if nearest < sculpture.SCENE_RADIUS + NEAR:
        largest = (CAMERA_RADIUS / (sculpture.SCENE_RADIUS + NEAR)) ** 2
        raise SceneError(
            f"procedural: pool.factor: zoom by {factor:g} puts cameras inside of the scene: "
            f"give at most {np.floor(10.0 * largest) / 10.0:g}"
        )
    poses = np.array(cameras.world_from_cam)
    # A larger picture from the same direction is one from nearer by.
    scale = factor**0.5 / magnifications(zoom, len(cameras))
    poses[:, :, 3] *= scale[:, None].astype(np.float32)
    return cameras.replace(world_from_cam=poses), nearest, farthest


def read_cache(path: pathlib.Path, num_pixels: int) -> Photos | None:
    """Photos from a cache file; None, after a warning, where it is damaged."""
    try:
        with np.load(path, allow_pickle=False) as data:
            photos = Photos(*(data[name] for name in Photos._fields))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        warnings.warn(f"{path}: cache is damaged ({error}): made anew", stacklevel=3)
        return None
    if [x.shape for x in photos] != [(num_pixels, 3), (num_pixels,), (num_pixels,)]:
        warnings.warn(
            f"{path}: cache has the wrong shape {photos.pixels.shape}: made anew", stacklevel=3
        )
        return None
    return photos


def write_cache(path: pathlib.Path, photos: Photos) -> None:
    """Writes a cache file in one go: a reader sees all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **photos._asdict())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def load_procedural(
    *,
    image_size: int = 100,
    num_train: int = 100,
    num_test: int = 25,
    cache_dir=None,
    seed: int = 0,
    zoom: Zoom | None = None,
) -> Scene:
    """Makes the scene that comes with the project: images and exact depth of the sculpture.

    Args:
      image_size: width and height in pixels.
      num_train: views of the pool.
      num_test: views that are only measured; from another random key.
      cache_dir: a folder that keeps the images for the next time, or None.
      seed: draws the poses.
      zoom: moves every camera, those to test with too, along its line of sight to a distance of its
        own, between `1 / sqrt(factor)` and `sqrt(factor)` times the common one; None leaves all
        there. They do not come nearer than just outside of the ball that holds the sculpture.

    Raises:
      SceneError: a size or count below 1, a seed below 0, more than `MAX_PIXELS` in all, or cameras
        that would be inside of the ball.
    """
    for field, value, least in (
        ("image_size", image_size, 1),
        ("num_train", num_train, 1),
        ("num_test", num_test, 1),
        ("seed", seed, 0),
    ):
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise SceneError(f"procedural: {field}: is {value!r}: give a whole number")
        if not least <= value < 1 << 32:
            raise SceneError(f"procedural: {field}: is {value}: give at least {least}, below 2^32")
    num_pixels = (num_train + num_test) * image_size**2
    if num_pixels > MAX_PIXELS:
        raise SceneError(
            f"procedural: image_size, num_train, num_test: ask for {num_pixels / 1e6:.0f} million "
            f"pixels: stay below {MAX_PIXELS / 1e6:.0f}"
        )
    key_train, key_test = jax.random.split(jax.random.key(seed))
    train = hemisphere_cameras(key_train, num_train, image_size=image_size)
    test = hemisphere_cameras(key_test, num_test, image_size=image_size)
    cameras = jax.tree.map(lambda a, b: np.concatenate([a, b]), train, test)
    num_views = num_train + num_test
    cameras, nearest, farthest = at_distances(cameras, zoom)

    cached, path = None, None
    if cache_dir is not None:
        arguments = [SOURCE_VERSION, image_size, num_train, num_test, seed, *(zoom or ())]
        digest = hashlib.sha256(json.dumps(arguments).encode()).hexdigest()[:16]
        path = pathlib.Path(cache_dir).expanduser() / f"procedural-{digest}.npz"
        cached = read_cache(path, num_pixels)
    photos = capture(cameras) if cached is None else cached
    if path is not None and cached is None:
        try:
            write_cache(path, photos)
        except OSError as error:  # such as a full disk
            warnings.warn(f"{path}: cannot be written ({error.strerror})", stacklevel=2)

    return Scene(
        name="procedural",
        cameras=cameras,
        pixels=photos.pixels,
        offsets=np.arange(num_views + 1, dtype=np.int64) * image_size**2,
        pool=np.arange(num_train, dtype=np.int32),
        test=np.arange(num_train, num_views, dtype=np.int32),
        box=np.array([[-1.0] * 3, [1.0] * 3], np.float32),
        near=max(nearest - np.sqrt(3.0), NEAR),  # the box's corners
        far=farthest + np.sqrt(3.0),
        background=np.array(BACKGROUND, np.float32),
        names=tuple(
            [f"train_{i:03d}" for i in range(num_train)]
            + [f"test_{i:03d}" for i in range(num_test)]
        ),
        depth=photos.depth,
        alpha=photos.alpha,
    )
