"""Scenes in the layout of LLFF: `poses_bounds.npy` beside folders of images."""

import pathlib

import numpy as np

from bavs_jax.scenes import checks, images, models, texts
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.capture import Capture, make_scene
from bavs_jax.scenes.folders import image_folder
from bavs_jax.scenes.splits import every_nth

TEST_EVERY = 8
COLUMNS = 17  # a 3 x 5 matrix [down, right, back, position, (height, width, focal)], near and far


def read_poses_bounds(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses in OpenGL axes [V, 4, 4], `(height, width, focal)` [V, 3] and bounds [V, 2]."""
    table = texts.read_array(path).astype(np.float64)
    if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table):
        raise SceneError(
            f"{path}: has shape {list(table.shape)}: give [views, {COLUMNS}]: "
            "a 3 x 5 matrix, near and far a view"
        )
    poses, sizes = [], []
    for view, row in enumerate(table):
        matrix = row[:15].reshape(3, 5)
        pose = np.stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2], matrix[:, 3]], axis=-1)
        poses.append(checks.check_pose(pose, path, f"row {view}"))
        height, width, focal = (
            checks.check_number(float(value), path, f"row {view}: {field}", positive=True)
            for value, field in zip(matrix[:, 4], ("height", "width", "focal"))
        )
        sizes.append((height, width, focal))
        near, far = row[15:]
        if not 1.0 / checks.LARGEST <= near < far <= checks.LARGEST:  # nor NaN
            raise SceneError(f"{path}: row {view}: bounds {near:g}, {far:g}: give 0 < near < far")
    return np.stack(poses), np.array(sizes), table[:, 15:]


def read_llff(root: pathlib.Path, *, downscale: int | None) -> Capture:
    """Reads `poses_bounds.npy`, whose rows belong to the images in the order of their names.

    Arguments as of `load_llff`.
    """
    path = root / "poses_bounds.npy"
    poses, stated, bounds = read_poses_bounds(path)
    folder = image_folder(root, downscale)
    files = images.list_images(folder)
    if len(files) != len(poses):
        raise SceneError(
            f"{path}: has {len(poses)} poses but {folder.name} has {len(files)} images: "
            "use the images that the poses were made from"
        )
    sizes = [images.image_size(file) for file in files]
    intrinsics = []
    for file, size, (height, width, focal) in zip(files, sizes, stated):
        full = (focal, focal, 0.5 * width, 0.5 * height)
        intrinsics.append(models.fit_to_image(full, (width, height), size, file, path))
    return Capture(
        root=root,
        source=path,
        files=tuple(files),
        poses=poses,
        cameras=checks.build_cameras(
            poses, intrinsics, sizes, names=[file.name for file in files], path=path
        ),
        bounds=bounds,
        split=every_nth(len(files), TEST_EVERY, path=path),
    )


@checks.name_refusals
def load_llff(root, *, downscale: int | None = None, **options) -> Scene:
    """Loads a scene in the layout of LLFF; every 8th image is a test view.

    It is in normalised coordinates with +z up; near and far are the bounds'.

    Args:
      root: the folder of `poses_bounds.npy`.
      downscale: N takes the images of `images_N`; None those of `images`, or else the largest.
      **options: of `make_scene`.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    return make_scene(read_llff(checks.scene_folder(root), downscale=downscale), **options)
