"""Scenes as COLMAP leaves them: a sparse model, text or binary, beside folders of images."""

import dataclasses
import itertools
import pathlib

import numpy as np

from bavs_jax.scenes import checks, images, models, texts
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.capture import Capture, make_scene
from bavs_jax.scenes.colmap_files import check_binary, check_text, count_images
from bavs_jax.scenes.folders import image_folder, match_names
from bavs_jax.scenes.llff import TEST_EVERY, read_llff
from bavs_jax.scenes.splits import every_nth

# Where models lie, each in a folder with a number or in this one itself.
MODEL_PARENTS = ("sparse", "colmap/sparse", ".", "distorted/sparse")
# Of photos before their distortion was taken out; their model is no fit for the photos in `images`.
DISTORTED = ("distorted/sparse", "input")
MODEL_FILES = ("cameras", "images", "points3D")


def has_model(folder: pathlib.Path) -> bool:
    """Whether a folder holds any of a model's files."""
    return any((folder / f"{f}{s}").is_file() for f in MODEL_FILES[:2] for s in (".bin", ".txt"))


def find_models(root: pathlib.Path) -> list[pathlib.Path]:
    """The folders of a scene's sparse models, that of the most images first.

    COLMAP's mapper leaves several where it could not join all photos. Models in `distorted`
    come last.
    """
    folders = []
    for name in MODEL_PARENTS:
        parent = root / name
        inner = sorted(parent.glob("*")) if name != "." and parent.is_dir() else []
        folders += [folder for folder in (*inner, parent) if has_model(folder)]
    distorted = root / DISTORTED[0]
    return sorted(folders, key=lambda f: (f.is_relative_to(distorted), -count_images(f)))


def find_model(root: pathlib.Path) -> pathlib.Path | None:
    """The folder of a scene's sparse model of the most images, or None."""
    return next(iter(find_models(root)), None)


def read_model(root: pathlib.Path):
    """A scene's sparse model of the most images: `(folder, pycolmap.Reconstruction)`.

    Raises:
      SceneError: pycolmap is not installed, there is no model, or it cannot be read.
    """
    found = find_models(root)
    if not found:
        raise SceneError(
            f"{root}: no COLMAP model (cameras.bin or cameras.txt) in "
            f"{', '.join(p for p in MODEL_PARENTS if p != '.')}: copy COLMAP's sparse folder here"
        )
    folder, *others = found
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
        reason = texts.one_line(error)
        raise SceneError(
            f"{folder}: COLMAP model cannot be read ({reason}): make it anew"
        ) from error
    if others:
        left_out = [f"{f.relative_to(root)} with {count_images(f)}" for f in others]
        images.warn(
            f"{folder}: model taken, with {len(model.images)} images; left out: "
            f"{images.some_names(left_out)}"
        )
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
    """Reads the registered images of a sparse model; arguments as of `load_colmap`."""
    folder, model = read_model(root)
    views = sorted((v for v in model.images.values() if v.has_pose), key=lambda view: view.name)
    if not views:
        raise SceneError(f"{folder}: has no registered images: run COLMAP's mapper again")
    names = [view.name for view in views]
    for first, second in itertools.pairwise(names):
        if first == second:
            raise SceneError(f"{folder}: image '{first}' is a duplicate: remove one")
    distorted, photos = (root / name for name in DISTORTED)
    use_input = downscale is None and folder.is_relative_to(distorted) and photos.is_dir()
    pictures = photos if use_input else image_folder(root, downscale)
    for name in names:
        checks.check_inside(pictures, name, folder, f"image '{name}'")
    found = match_names(names, pictures)
    listed = [{"file_path": name} for name in names]
    kept = checks.keep_existing(listed, found, folder, strict=strict)
    files = checks.existing(found)

    poses, intrinsics, distortion, sizes, lenses = [], [], [], [], []
    for index in kept:
        view = views[index]
        poses.append(opengl_pose(view, folder))
        lens, full, coefficients = camera_of(view.camera, folder)
        size, stated = images.image_size(files[index]), (view.camera.width, view.camera.height)
        intrinsics.append(models.fit_to_image(full, stated, size, files[index], folder))
        distortion.append(coefficients)
        sizes.append(size)
        lenses.append(lens)
    warn_without_pose(pictures, found, folder)
    names = [names[index] for index in kept]
    lens = models.common_lens(lenses, names, folder)
    return Capture(
        root=root,
        source=folder,
        files=tuple(files[index] for index in kept),
        poses=np.stack(poses),
        cameras=checks.build_cameras(
            poses, intrinsics, sizes, names=names, path=folder, distortion=distortion, lens=lens
        ),
    )


def warn_without_pose(pictures: pathlib.Path, found: list, folder: pathlib.Path) -> None:
    """Warns of photos that the model has no pose for."""
    posed = set(found)
    photos = sorted(f for f in pictures.rglob("*") if f.suffix.lower() in images.IMAGE_SUFFIXES)
    left = [checks.view_name(file, pictures) for file in photos if file not in posed]
    if left:
        images.warn(
            f"{folder}: {len(left)} of {len(photos)} photos in {pictures.name} have no pose "
            f"({images.some_names(left)}): left out"
        )


@checks.name_refusals
def load_colmap(root, *, downscale: int | None = None, strict: bool = False, **options) -> Scene:
    """Loads a COLMAP model, text or binary, from `sparse/*`, `sparse` or `colmap/sparse/*`.

    Of several models that of the most images; a warning names the others, and photos without a
    pose. Without any of these, that in `distorted/sparse`, with the photos in `input`.
    The scene is in normalised coordinates with +z up.

    Args:
      root: the folder of `sparse` and `images`.
      downscale: N takes the images of `images_N`; None those of `images`, or else the largest.
      strict: an image without a file is an error, not a warning.
      **options: of `make_scene`.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    capture = read_colmap(checks.scene_folder(root), downscale=downscale, strict=strict)
    return make_scene(capture, **options)


@checks.name_refusals
def load_mipnerf360(
    root, *, downscale: int | None = None, strict: bool = False, **options
) -> Scene:
    """Loads a scene in the layout of Mip-NeRF 360; every 8th image is a test view.

    Where there is no COLMAP model, `poses_bounds.npy` gives the poses and the bounds.

    Args:
      root: the folder of `sparse` or `poses_bounds.npy`.
      downscale, strict, **options: as in `load_colmap`; so are the scene and its errors.
    """
    root = checks.scene_folder(root)
    if find_model(root) is None and (root / "poses_bounds.npy").is_file():
        return make_scene(read_llff(root, downscale=downscale), **options)
    capture = read_colmap(root, downscale=downscale, strict=strict)
    split = every_nth(len(capture.files), TEST_EVERY, path=capture.source)
    return make_scene(dataclasses.replace(capture, split=split), **options)
