"""Scenes in the layout of nerfstudio and instant-ngp: one `transforms.json` with its images."""

from __future__ import annotations

import math
import pathlib

import numpy as np

from bavs_jax.cameras import Cameras, make_cameras, rescale
from bavs_jax.scenes import checks, images
from bavs_jax.scenes.base import Scene, SceneError, pixel_table
from bavs_jax.scenes.normalise import level_and_scale, transform_poses

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # in the order of `Cameras.distortion`
# The file's camera_model, and the lens of `cameras.LENSES` that it names.
CAMERA_MODELS = {
    "PINHOLE": "pinhole",
    "SIMPLE_PINHOLE": "pinhole",
    "SIMPLE_RADIAL": "opencv",
    "RADIAL": "opencv",
    "OPENCV": "opencv",
}
NEAR = 0.05  # scene units
ASPECT_TOLERANCE = 1.0  # pixels; image sizes are rounded when a data set is scaled down


class Frame:
    """One entry of `frames`: its own fields, and behind them those of the whole file."""

    def __init__(self, data: dict, index: int, path: pathlib.Path):
        self.data, self.index, self.path = data, index, path
        self.own = data["frames"][index]

    def field(self, key: str) -> str:
        """How messages name a field: by the place where it stands."""
        return f"frames[{self.index}].{key}" if key in self.own else key

    def get(self, key: str):
        return self.own.get(key, self.data.get(key))

    def number(self, key: str, default: float | None = None, *, positive: bool = False) -> float:
        """A finite number from the frame or the file; without a default it is required."""
        value = self.get(key)
        if value is None and default is not None:
            return default
        return checks.check_number(value, self.path, self.field(key), positive=positive)


def focal_from_angle(frame: Frame, key: str, size: float) -> float:
    """Focal length in pixels from a full angle of view in radians: `size / (2 tan(angle / 2))`."""
    angle = frame.number(key, positive=True)
    if angle >= math.pi:
        raise SceneError(f"{frame.path}: {frame.field(key)}: is {angle}: give radians below pi")
    return 0.5 * size / math.tan(0.5 * angle)


def focal_lengths(frame: Frame, width: float, height: float) -> tuple[float, float]:
    """`fx, fy` in pixels, from `fl_x, fl_y` or else from `camera_angle_x, camera_angle_y`."""
    if frame.get("fl_x") is not None:
        fx = frame.number("fl_x", positive=True)
    elif frame.get("camera_angle_x") is not None:
        fx = focal_from_angle(frame, "camera_angle_x", width)
    else:
        raise SceneError(f"{frame.path}: fl_x: missing: give fl_x or camera_angle_x")
    if frame.get("fl_x") is None and frame.get("fl_y") is None and frame.get("camera_angle_y"):
        return fx, focal_from_angle(frame, "camera_angle_y", height)
    return fx, frame.number("fl_y", fx, positive=True)


def intrinsics_of(frame: Frame, size: tuple[int, int], image_path: pathlib.Path) -> list[float]:
    """`fx, fy, cx, cy` for an image file of `size`, which may differ from the file's `w, h`.

    Raises:
      SceneError: a field is missing or no number, or the proportions differ by over a pixel.
    """
    width = frame.number("w", float(size[0]), positive=True)
    height = frame.number("h", float(size[1]), positive=True)
    if abs(size[1] - height * size[0] / width) > ASPECT_TOLERANCE:
        raise SceneError(
            f"{image_path}: image is {size[0]} x {size[1]}, not in proportion to w, h = "
            f"{width:g} x {height:g} in {frame.path.name}: mend the image or w, h"
        )
    fl_x, fl_y = focal_lengths(frame, width, height)
    scale_x, scale_y = size[0] / width, size[1] / height
    return [
        fl_x * scale_x,
        fl_y * scale_y,
        frame.number("cx", 0.5 * width) * scale_x,
        frame.number("cy", 0.5 * height) * scale_y,
    ]


def lens_of(frame: Frame, distortion: list[float]) -> str:
    """The lens of one frame; without a `camera_model`, distortion that is not 0 decides."""
    inferred = "opencv" if any(distortion) else "pinhole"
    model = frame.get("camera_model")
    if model is None:
        return inferred
    if model not in CAMERA_MODELS:
        raise SceneError(
            f"{frame.path}: {frame.field('camera_model')}: '{model}' is an unknown lens model: "
            f"use one of {', '.join(CAMERA_MODELS)}"
        )
    # As in nerfstudio, coefficients count under any perspective model.
    return inferred if CAMERA_MODELS[model] == "pinhole" else CAMERA_MODELS[model]


def read_cameras(frames: list[Frame], files: list[pathlib.Path]) -> tuple[Cameras, np.ndarray]:
    """Cameras at the size of their image files, and their poses [V, 4, 4] in float64; both in the
    file's own coordinates."""
    poses, intrinsics, distortion, sizes, lenses = [], [], [], [], []
    for frame, image_path in zip(frames, files):
        field = f"frames[{frame.index}].transform_matrix"
        matrix = frame.own.get("transform_matrix")
        poses.append(checks.check_pose(matrix, frame.path, field))
        sizes.append(images.image_size(image_path))
        intrinsics.append(intrinsics_of(frame, sizes[-1], image_path))
        distortion.append([frame.number(key, 0.0) for key in DISTORTION])
        lenses.append(lens_of(frame, distortion[-1]))
    # A pinhole is an OPENCV lens without distortion, so that one lens serves a mixture.
    lens = "opencv" if "opencv" in lenses else "pinhole"
    return make_cameras(poses, intrinsics, sizes, distortion=distortion, lens=lens), np.stack(poses)


def split_views(num_views: int, pool_size: int | float, *, seed: int, path: pathlib.Path):
    """Pool and test views by a permutation from the seed, each sorted, int32.

    Args:
      num_views: how many there are.
      pool_size: an int takes that many, a float in (0, 1] that share of them.
      seed: of the permutation.
      path: for messages.
    """
    if isinstance(pool_size, float):
        num_pool = round(pool_size * num_views) if 0.0 < pool_size <= 1.0 else 0
    else:
        num_pool = pool_size
    if num_pool < 1:
        raise SceneError(f"{path}: pool_size {pool_size}: give a count or a share in (0, 1)")
    if num_pool >= num_views:
        raise SceneError(
            f"{path}: pool_size {pool_size} of {num_views} views: the test split is empty: "
            "choose a smaller pool"
        )
    order = np.random.default_rng(seed).permutation(num_views).astype(np.int32)
    return np.sort(order[:num_pool]), np.sort(order[num_pool:])


def load_nerfstudio(
    root,
    *,
    image_size: int | None = None,
    pool_size: int | float = 0.75,
    seed: int = 0,
    strict: bool = False,
    box_half_side: float = 1.5,
    background=(1.0, 1.0, 1.0),
) -> Scene:
    """Loads a scene in the layout of nerfstudio.

    Cameras are levelled, centred and scaled as by nerfstudio's defaults (`level_and_scale`);
    `Scene.user_from_scene` leads back. Views are sorted by file name, then split by the seed.

    Args:
      root: the folder of `transforms.json`.
      image_size: wanted width in pixels, at most the original; of the widest image where sizes
        differ. All images are scaled by one factor.
      pool_size: views in the pool: an int for a count, a float for a share.
      seed: draws the split.
      strict: an image without a file is an error, not a warning.
      box_half_side: half a side of the scene box, scene units.
      background: [3] sRGB in [0, 1] to put under transparent pixels.

    Returns:
      The scene, in normalised coordinates with +z up.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    root = pathlib.Path(root).expanduser()
    path = root / "transforms.json"
    data = checks.read_json(path)
    listed = checks.check_frames(data, path)
    found = [images.find_image(root, frame["file_path"]) for frame in listed]
    kept = checks.keep_existing(listed, found, path, strict=strict)
    kept = sorted(kept, key=lambda index: listed[index]["file_path"])
    files = [found[index] for index in kept]
    cameras, user_poses = read_cameras([Frame(data, index, path) for index in kept], files)
    pool, test = split_views(len(files), pool_size, seed=seed, path=path)

    widest = int(cameras.sizes[:, 0].max())
    factor = checks.check_target_width(image_size, widest, path) / widest
    cameras = rescale(cameras, np.maximum(np.rint(cameras.sizes * factor), 1))
    scene_from_user = level_and_scale(user_poses)
    poses = transform_poses(scene_from_user, user_poses).astype(np.float32)
    cameras = cameras.replace(world_from_cam=poses)
    table = [
        images.shrink_over(images.read_image(file), int(width), int(height), background)
        for file, (width, height) in zip(files, cameras.sizes)
    ]
    pixels, offsets = pixel_table(table)

    box = box_half_side * np.array([[-1.0] * 3, [1.0] * 3], np.float32)
    corner = np.abs(cameras.positions) + box_half_side  # vector to the box's farthest corner
    return Scene(
        name=root.resolve().name,
        cameras=cameras,
        pixels=pixels,
        offsets=offsets,
        pool=pool,
        test=test,
        box=box,
        near=NEAR,
        far=float(np.linalg.norm(corner, axis=-1).max()),
        background=np.asarray(background, np.float32),
        names=tuple(checks.view_name(file, root) for file in files),
        user_from_scene=np.linalg.inv(scene_from_user),
    )
