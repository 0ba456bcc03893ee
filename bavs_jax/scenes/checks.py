"""Checks on input files; every fault is a `SceneError` that names file, field and fix."""

import functools
import math
import os
import pathlib
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

import numpy as np

from bavs_jax.cameras import Cameras, make_cameras
from bavs_jax.scenes import images
from bavs_jax.scenes.base import SceneError, printable

# Poses written with six digits pass; a scaled or sheared rotation does not.
ORTHONORMAL_TOLERANCE = 1e-3
ONE_PLACE = 1e-6  # spread of camera positions, relative to their size, below which they coincide
SIZE_TOLERANCE = 1.0  # pixels; image sizes are rounded when a data set is scaled down
# Numbers become float32, of up to 3e38: squares of these are finite, and so are rays.
LARGEST, SMALLEST_FOCAL = 1e18, 1e-9


Args = ParamSpec("Args")
Loaded = TypeVar("Loaded")


def name_refusals(load_fn: Callable[Args, Loaded]) -> Callable[Args, Loaded]:
    """Wraps a loader: what the operating system refuses becomes a `SceneError` with the file."""

    @functools.wraps(load_fn)
    def load(*args: Args.args, **options: Args.kwargs) -> Loaded:
        try:
            return load_fn(*args, **options)
        except OSError as error:
            root = args[0] if args else options.get("root")
            path, reason = error.filename or root, error.strerror or error
            raise SceneError(f"{path}: {reason}: check the file and its permissions") from error

    return load


def scene_folder(root) -> pathlib.Path:
    """The scene's folder, which must exist."""
    root = pathlib.Path(os.path.expanduser(root))
    if not os.path.exists(root):  # nor can be, of such a name
        raise SceneError(f"{root}: folder is missing: check the path to the scene")
    if not root.is_dir():
        raise SceneError(f"{root}: is a file: give the scene's folder")
    return root


def check_frames(data: dict, path: pathlib.Path) -> list[dict]:
    """The `frames` of a transforms file: each an object with its own `file_path`."""
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path}: frames: missing or empty: list at least one frame")
    seen: dict[pathlib.PurePosixPath, int] = {}
    for index, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name:
            raise SceneError(f"{path}: frames[{index}].file_path: missing: name the frame's image")
        name = pathlib.PurePosixPath(name)
        if name in seen:
            raise SceneError(
                f"{path}: frames[{index}].file_path: '{name}' is a duplicate of "
                f"frames[{seen[name]}]: remove one"
            )
        seen[name] = index
    return frames


def check_inside(root: pathlib.Path, name: str, path: pathlib.Path, field: str) -> None:
    """A file that a scene names must lie in the scene's folder."""
    folder = os.path.abspath(root)
    if os.path.commonpath([folder, os.path.abspath(root / name)]) != folder:
        raise SceneError(
            f"{path}: {field}: '{name}' leads out of the scene's folder: move the file into it"
        )


def check_number(value, path: pathlib.Path, field: str, *, positive: bool = False) -> float:
    """A finite number, or with `positive` one above 0."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        what = "missing" if value is None else f"{value!r} is no number"
        raise SceneError(f"{path}: {field}: {what}: give a number")
    try:
        value = float(value) if abs(value) > LARGEST else value
    except OverflowError:  # a whole number of hundreds of digits
        value = math.inf
    if not math.isfinite(value):
        raise SceneError(f"{path}: {field}: is {value}: give a finite number")
    if abs(value) > LARGEST:
        raise SceneError(f"{path}: {field}: is {value}: give a number of at most {LARGEST:g}")
    if positive and value <= 0:
        raise SceneError(f"{path}: {field}: is {value}: give a number above 0")
    return float(value)


def check_pose(value, path: pathlib.Path, field: str) -> np.ndarray:
    """A rigid camera-to-world pose [4, 4] float64 in OpenGL axes."""
    if value is None:
        raise SceneError(f"{path}: {field}: missing: give a 4 x 4 camera-to-world matrix")
    try:
        pose = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"{path}: {field}: not a matrix of numbers: give 4 x 4 numbers") from None
    if pose.shape not in ((3, 4), (4, 4)):
        raise SceneError(f"{path}: {field}: has shape {list(pose.shape)}: give a 4 x 4 matrix")
    if not np.isfinite(pose).all():
        raise SceneError(f"{path}: {field}: holds NaN or infinity: give finite numbers")
    largest = np.abs(pose).max()
    if largest > LARGEST:
        raise SceneError(f"{path}: {field}: holds {largest:g}: give at most {LARGEST:g}")
    rotation = pose[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > ORTHONORMAL_TOLERANCE:
        raise SceneError(
            f"{path}: {field}: rotation is not orthonormal (off by {error:.2g}): "
            "take scale and shear out of its columns"
        )
    if np.linalg.det(rotation) < 0:
        raise SceneError(f"{path}: {field}: rotation mirrors (determinant -1): flip one axis")
    last_row = [0.0, 0.0, 0.0, 1.0]
    if pose.shape[0] == 4 and np.abs(pose[3] - last_row).max() > ORTHONORMAL_TOLERANCE:
        raise SceneError(f"{path}: {field}: last row is {pose[3].tolist()}: make it [0, 0, 0, 1]")
    return np.concatenate([pose[:3], [last_row]])


def build_cameras(
    poses, intrinsics, sizes, *, names: list[str], path: pathlib.Path, **options
) -> Cameras:
    """`make_cameras`, of numbers that stay finite and rays that stay apart in float32.

    Args:
      names: [V] how to call the views in messages.
      path: what gives the cameras, for messages.
      poses, intrinsics, sizes, **options: of `make_cameras`, [V, 4, 4], [V, 4] and [V, 2].

    Raises:
      SceneError: a number that float32 cannot hold, or a focal length that is as good as 0.
    """
    for name, pose, values in zip(names, poses, intrinsics):
        largest = max(np.abs(pose).max(), np.abs(values).max())
        if not largest <= LARGEST:  # nor NaN
            raise SceneError(
                f"{path}: {name}: pose, focal length or centre reach {largest:g}: give numbers "
                f"of at most {LARGEST:g}"
            )
        if min(values[:2]) < SMALLEST_FOCAL:
            raise SceneError(
                f"{path}: {name}: focal length is {min(values[:2]):g} pixels: "
                f"give at least {SMALLEST_FOCAL:g}"
            )
    return make_cameras(poses, intrinsics, sizes, **options)


def check_places(poses: np.ndarray, path: pathlib.Path) -> None:
    """Cameras [V, 4, 4] must stand at more than one place, or nothing has a depth."""
    positions = np.asarray(poses)[:, :3, 3]
    spread = np.ptp(positions, axis=0).max()
    if len(positions) > 1 and spread <= ONE_PLACE * max(np.abs(positions).max(), 1.0):
        raise SceneError(
            f"{path}: all {len(positions)} cameras stand at one place: "
            "check the poses' last columns; views from several places are needed"
        )


def check_proportions(size, stated, image_path: pathlib.Path, path: pathlib.Path) -> None:
    """An image may be scaled down from the stated (width, height), but not cropped."""
    if abs(size[1] - stated[1] * size[0] / stated[0]) > SIZE_TOLERANCE:
        turned = images.orientation(image_path) != 1
        fix = "turn its pixels, as its EXIF orientation is not applied" if turned else "mend it"
        raise SceneError(
            f"{image_path}: image is {size[0]} x {size[1]}, not in proportion to w, h = "
            f"{stated[0]:g} x {stated[1]:g} in {path.name}: {fix} or w, h"
        )


def check_image_size(size, expected, path: pathlib.Path, field: str) -> None:
    """An image must have the (width, height) that `field` promises."""
    if tuple(size) != tuple(expected):
        raise SceneError(
            f"{path}: image is {size[0]} x {size[1]} but {field} says "
            f"{expected[0]} x {expected[1]}: use images of one size"
        )


def check_target_width(target: int | None, width: int, path: pathlib.Path) -> int:
    """The wanted image width in pixels; None asks for the original `width`."""
    if target is None:
        return width
    if not isinstance(target, int):
        raise SceneError(f"{path}: image_size {target!r} is no whole number: give one")
    if target < 1 or target > width:
        raise SceneError(f"{path}: image_size {target} is outside of 1 to {width}: choose within")
    return target


def view_name(file: pathlib.Path, root: pathlib.Path) -> str:
    """A view's name: its file relative to the scene's folder, with forward slashes, printable."""
    return printable(pathlib.PurePath(os.path.relpath(file, root)).as_posix())


def existing(files: Sequence[pathlib.Path | None]) -> dict[int, pathlib.Path]:
    """The files that there are, by the index of their frame."""
    return {index: file for index, file in enumerate(files) if file is not None}


def keep_existing(
    frames: list[dict], files: Sequence[pathlib.Path | None], path: pathlib.Path, *, strict: bool
) -> list[int]:
    """Indices of the frames whose image exists; one warning counts and names the others.

    Args:
      frames: the frames of a transforms file.
      files: the image file of each frame, or None where there is none.
      path: the transforms file, for messages.
      strict: missing images are an error rather than a warning.

    Raises:
      SceneError: images are missing under `strict`, or none is left.
    """
    kept = list(existing(files))
    missing = [frame["file_path"] for frame, file in zip(frames, files) if file is None]
    if not missing:
        return kept
    names = images.some_names(missing)
    fault = f"{path}: file_path: {len(missing)} of {len(frames)} images have no file ({names})"
    if strict:
        raise SceneError(f"{fault}: add them or load without strict")
    if not kept:
        raise SceneError(f"{fault}: the split is empty: add the images")
    images.warn(f"{fault}: skipped")
    return kept
