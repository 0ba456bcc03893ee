"""Scenes as COLMAP leaves them: a sparse model, text or binary, beside folders of images."""

from __future__ import annotations

import itertools
import pathlib

import numpy as np

from bavs_jax.cameras import make_cameras
from bavs_jax.scenes import checks, images, models
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.capture import Capture, make_scene
from bavs_jax.scenes.colmap_files import check_binary, check_text
from bavs_jax.scenes.folders import image_folder, match_names

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")
MODEL_FILES = ("cameras", "images", "points3D")


def find_model(root: pathlib.Path) -> pathlib.Path | None:
    """The folder of a scene's sparse model: the first that holds any of its files, or None."""
    for name in MODEL_FOLDERS:
        folder = root / name
        if any((folder / f"{f}{s}").is_file() for f in MODEL_FILES[:2] for s in (".bin", ".txt")):
            return folder
    return None


def read_model(root: pathlib.Path):
    """A scene's sparse model: `(folder, pycolmap.Reconstruction)`.

    Raises:
      SceneError: pycolmap is not installed, there is no model, or it cannot be read.
    """
    folder = find_model(root)
    if folder is None:
        raise SceneError(
            f"{root}: no COLMAP model (cameras.bin or cameras.txt) in "
            f"{', '.join(MODEL_FOLDERS[:-1])}: copy COLMAP's sparse folder here"
        )
    suffix = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    for name in MODEL_FILES:
        path = folder / f"{name}{suffix}"
        if not path.is_file():
            raise SceneError(f"{path}: file is missing: copy all of the COLMAP model")
    try:
        import pycolmap
    except ImportError as error:
        raise SceneError(
            f"{folder}: reading it needs pycolmap: pip install 'bavs_jax[colmap]'"
        ) from error
    check_binary(folder) if suffix == ".bin" else check_text(folder)
    model = pycolmap.Reconstruction()
    try:
        (model.read_binary if suffix == ".bin" else model.read_text)(str(folder))
    except (ValueError, IndexError, RuntimeError) as error:
        reason = images.one_line(error)
        raise SceneError(
            f"{folder}: COLMAP model cannot be read ({reason}): make it anew"
        ) from error
    return folder, model


def camera_of(camera, path: pathlib.Path) -> tuple[str, list[float], list[float]]:
    """Lens, `fx, fy, cx, cy` and the six coefficients of a `pycolmap.Camera`.

    Raises:
      SceneError: a lens model that is not supported, or parameters that cannot be.
    """
    field = f"camera {camera.camera_id}"
    name = camera.model_name
    if name not in models.MODELS:
        raise SceneError(
            f"{path}: {field}: '{name}' is an unsupported lens model: "
            f"use one of {', '.join(models.MODELS)}"
        )
    lens, coefficients = models.MODELS[name]
    extra = dict(zip(coefficients, camera.params[camera.extra_params_idxs()]))
    for key, value in extra.items():
        checks.check_number(float(value), path, f"{field}: {key}")
    if any(extra.pop(key, 0.0) for key in ("k5", "k6")) or (name == "FULL_OPENCV" and extra["k4"]):
        raise SceneError(
            f"{path}: {field}: FULL_OPENCV's k4, k5, k6 are not supported: calibrate with OPENCV"
        )
    for key, value in (
        ("focal length", camera.focal_length_x),
        ("focal length", camera.focal_length_y),
        ("width", camera.width),
        ("height", camera.height),
    ):
        checks.check_number(float(value), path, f"{field}: {key}", positive=True)
    intrinsics = [camera.focal_length_x, camera.focal_length_y]
    intrinsics += [camera.principal_point_x, camera.principal_point_y]
    for key, value in zip(("cx", "cy"), intrinsics[2:]):
        checks.check_number(float(value), path, f"{field}: {key}")
    return lens, intrinsics, [float(extra.get(key, 0.0)) for key in models.COEFFICIENTS]


def opengl_pose(image, path: pathlib.Path) -> np.ndarray:
    """Camera-to-world pose [4, 4] in OpenGL axes of a `pycolmap.Image`.

    COLMAP stores world-to-camera with y down and z forward: `R^T`, `-R^T t`, then y and z flip.
    """
    cam_from_world = np.asarray(image.cam_from_world().matrix(), np.float64)
    field = f"image '{image.name}'"
    rotation = checks.check_pose(cam_from_world, path, field)[:3, :3]
    position = -rotation.T @ cam_from_world[:, 3]
    pose = np.concatenate([rotation.T * [1.0, -1.0, -1.0], position[:, None]], axis=1)
    return checks.check_pose(pose, path, field)


def read_colmap(root: pathlib.Path, *, downscale: int | None, strict: bool) -> Capture:
    """Reads the registered images of a sparse model.

    Args:
      root: the scene's folder.
      downscale: N takes the images of `images_N`; None those of `images`, or else the largest.
      strict: an image without a file is an error, not a warning.
    """
    folder, model = read_model(root)
    views = sorted((v for v in model.images.values() if v.has_pose), key=lambda view: view.name)
    if not views:
        raise SceneError(f"{folder}: has no registered images: run COLMAP's mapper again")
    names = [view.name for view in views]
    for first, second in itertools.pairwise(names):
        if first == second:
            raise SceneError(f"{folder}: image '{first}' is a duplicate: remove one")
    pictures = image_folder(root, downscale)
    for name in names:
        checks.check_inside(pictures, name, folder, f"image '{name}'")
    found = match_names(names, pictures)
    listed = [{"file_path": name} for name in names]
    kept = checks.keep_existing(listed, found, folder, strict=strict)

    poses, intrinsics, distortion, sizes, lenses = [], [], [], [], []
    for index in kept:
        view = views[index]
        poses.append(opengl_pose(view, folder))
        lens, full, coefficients = camera_of(view.camera, folder)
        size, stated = images.image_size(found[index]), (view.camera.width, view.camera.height)
        intrinsics.append(models.fit_to_image(full, stated, size, found[index], folder))
        distortion.append(coefficients)
        sizes.append(size)
        lenses.append(lens)
    lens = models.common_lens(lenses, [names[index] for index in kept], folder)
    return Capture(
        root=root,
        source=folder,
        files=tuple(found[index] for index in kept),
        poses=np.stack(poses),
        cameras=make_cameras(poses, intrinsics, sizes, distortion=distortion, lens=lens),
    )


@checks.name_refusals
def load_colmap(root, *, downscale: int | None = None, strict: bool = False, **options) -> Scene:
    """Loads a COLMAP model, text or binary, from `sparse/0`, `sparse` or `colmap/sparse/0`.

    Args:
      root: the folder of `sparse` and `images`.
      downscale: N takes the images of `images_N`; None those of `images`, or else the largest.
      strict: an image without a file is an error, not a warning.
      **options: of `make_scene`.

    Returns:
      The scene, in normalised coordinates with +z up.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    capture = read_colmap(checks.scene_folder(root), downscale=downscale, strict=strict)
    return make_scene(capture, **options)
