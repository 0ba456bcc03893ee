"""Scenes made on the spot, with true depth and a true surface: what there is, their loader."""

import hashlib
import json
import os
import pathlib
import tempfile
import warnings
import zipfile

import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.cameras import Cameras, hemisphere_poses, make_cameras
from bavs_jax.scenes import interior, sculpture, sdf
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.photographs import BACKGROUND, Photos, Subject, take_photos
from bavs_jax.scenes.zoom import Zoom, magnifications

CAMERA_RADIUS = 3.2  # scene units
NEAR = 0.05  # scene units; least distance of a camera to what it may see
FIELD_OF_VIEW = 0.64  # radians across the width; holds the whole object from every side
MAX_PIXELS = 1 << 28  # of all views; each takes some 40 bytes on the way


# --- what there is to photograph -------------------------------------------------------------


def ball_interval(
    origins: sdf.Point, directions: sdf.Point, spread: jax.Array | float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """Distances at which rays, or cones of some spread, enter and leave the sculpture's ball.

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


def room_interval(
    origins: sdf.Point, directions: sdf.Point, spread: jax.Array | float = 0.0
) -> tuple[jax.Array, jax.Array]:
    """The whole way from a camera to beyond the walls of the interior."""
    del directions, spread
    return jnp.zeros_like(origins[0]), jnp.full_like(origins[0], box_diagonal(interior.SCENE_BOX))


def box_diagonal(box) -> float:
    """Length of the diagonal of a box [2, 3], in its unit."""
    return float(np.linalg.norm(np.subtract(*box)))


def orbit_poses(key: jax.Array, num: int) -> np.ndarray:
    """Poses [num, 3, 4] on the upper hemisphere around the sculpture (Eq 14)."""
    return hemisphere_poses(key, num, centre=(0.0, 0.0, 0.0), radius=CAMERA_RADIUS)


SUBJECTS = {
    "sculpture": Subject(
        name="procedural",  # as results have it since there was no other
        version=3,
        distance=sculpture.distance,
        signed_distance=sculpture.signed_distance,
        shade=sculpture.shade,
        interval=ball_interval,
        draw_poses=orbit_poses,
        closed=False,
        field_of_view=FIELD_OF_VIEW,
        box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        near=CAMERA_RADIUS - np.sqrt(3.0),  # the box's corners
        far=CAMERA_RADIUS + np.sqrt(3.0),
        num_train=100,
        num_test=25,
    ),
    "interior": Subject(
        name="interior",
        version=2,
        distance=interior.distance,
        signed_distance=interior.signed_distance,
        shade=interior.shade,
        interval=room_interval,
        draw_poses=interior.room_poses,
        closed=True,
        field_of_view=interior.FIELD_OF_VIEW,
        box=interior.SCENE_BOX,
        near=0.9 * interior.CLEARANCE,  # cameras stand free
        far=box_diagonal(interior.SCENE_BOX),
        num_train=150,
        num_test=50,
    ),
}


def subject(scene: str) -> Subject:
    """What a procedural scene is made of; SceneError for a name that there is not."""
    if not isinstance(scene, str) or scene not in SUBJECTS:
        raise SceneError(f"procedural: scene: is {scene!r}: use one of {', '.join(SUBJECTS)}")
    return SUBJECTS[scene]


def capture(cameras: Cameras, scene: str = "sculpture") -> Photos:
    """Takes pictures of a scene from any poses outside of matter, as an active robot would."""
    return take_photos(subject(scene), cameras)


def draw_cameras(key: jax.Array, num: int, *, image_size: int, scene: str = "sculpture") -> Cameras:
    """Square cameras by the law of a scene: all its views, and any others, are drawn by it."""
    seen = subject(scene)
    focal = 0.5 * image_size / np.tan(0.5 * seen.field_of_view)
    intrinsics = [[focal, focal, 0.5 * image_size, 0.5 * image_size]] * num
    return make_cameras(seen.draw_poses(key, num), intrinsics, [[image_size, image_size]] * num)


# --- scene and cache -------------------------------------------------------------------------


def at_distances(
    seen: Subject, cameras: Cameras, zoom: Zoom | None
) -> tuple[Cameras, float, float]:
    """Cameras moved along their lines of sight; and what is nearest and farthest for them."""
    if zoom is None:
        return cameras, seen.near, seen.far
    if seen.closed:
        raise SceneError(
            f"pool.kind: in the {seen.name} distances are free already: use another than 'zoom'"
        )
    nearest, farthest = (CAMERA_RADIUS * zoom.factor**power for power in (-0.5, 0.5))
    if nearest < sculpture.SCENE_RADIUS + NEAR:
        largest = (CAMERA_RADIUS / (sculpture.SCENE_RADIUS + NEAR)) ** 2
        raise SceneError(
            f"procedural: pool.factor: zoom by {zoom.factor:g} puts cameras inside of the scene: "
            f"give at most {np.floor(10.0 * largest) / 10.0:g}"
        )
    poses = np.array(cameras.world_from_cam)
    # A larger picture from the same direction is one from nearer by.
    scale = zoom.factor**0.5 / magnifications(zoom, len(cameras))
    poses[:, :, 3] *= scale[:, None].astype(np.float32)
    corner = 0.5 * box_diagonal(seen.box)
    moved = cameras.replace(world_from_cam=poses)
    return moved, max(nearest - corner, NEAR), farthest + corner


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
    scene: str = "sculpture",
    image_size: int = 100,
    num_train: int | None = None,
    num_test: int | None = None,
    cache_dir=None,
    seed: int = 0,
    zoom: Zoom | None = None,
) -> Scene:
    """Makes a scene that comes with the project: images and exact depth of a known surface.

    Args:
      scene: "sculpture", an object on a plinth seen from around it, or "interior", a room with
        partitions seen from within. All rays of the latter end on a surface: it has no alpha.
      image_size: width and height in pixels.
      num_train: views of the pool; None: 100 of the sculpture, 150 of the interior.
      num_test: views that are only measured, drawn by the same law from another random key; None:
        25 of the sculpture, 50 of the interior.
      cache_dir: a folder that keeps the images for the next time, or None.
      seed: draws the poses.
      zoom: moves every camera, those to test with too, along its line of sight to a distance of its
        own, between `1 / sqrt(factor)` and `sqrt(factor)` times the common one; None leaves all
        there. They do not come nearer than just outside of the ball that holds the sculpture.

    Raises:
      SceneError: an unknown scene, a size or count below 1, a seed below 0, more than `MAX_PIXELS`
        in all, or a zoom that would bring cameras into matter.
    """
    seen = subject(scene)
    num_train = seen.num_train if num_train is None else num_train
    num_test = seen.num_test if num_test is None else num_test
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
    train = draw_cameras(key_train, num_train, image_size=image_size, scene=scene)
    test = draw_cameras(key_test, num_test, image_size=image_size, scene=scene)
    cameras = jax.tree.map(lambda a, b: np.concatenate([a, b]), train, test)
    num_views = num_train + num_test
    cameras, near, far = at_distances(seen, cameras, zoom)

    cached, path = None, None
    if cache_dir is not None:
        arguments = [scene, seen.version, image_size, num_train, num_test, seed, *(zoom or ())]
        digest = hashlib.sha256(json.dumps(arguments).encode()).hexdigest()[:16]
        path = pathlib.Path(cache_dir).expanduser() / f"procedural-{digest}.npz"
        cached = read_cache(path, num_pixels)
    photos = capture(cameras, scene) if cached is None else cached
    if path is not None and cached is None:
        try:
            write_cache(path, photos)
        except OSError as error:  # such as a full disk
            warnings.warn(f"{path}: cannot be written ({error.strerror})", stacklevel=2)

    return Scene(
        name=seen.name,
        cameras=cameras,
        pixels=photos.pixels,
        offsets=np.arange(num_views + 1, dtype=np.int64) * image_size**2,
        pool=np.arange(num_train, dtype=np.int32),
        test=np.arange(num_train, num_views, dtype=np.int32),
        box=np.array(seen.box, np.float32),
        near=near,
        far=far,
        background=np.array(BACKGROUND, np.float32),
        names=tuple(
            [f"train_{i:03d}" for i in range(num_train)]
            + [f"test_{i:03d}" for i in range(num_test)]
        ),
        depth=photos.depth,
        alpha=None if seen.closed else photos.alpha,
        closed=seen.closed,
    )
