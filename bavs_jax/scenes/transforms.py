"""Cameras from the frames of a `transforms.json`."""

import math
import pathlib

import numpy as np

from bavs_jax.cameras import Cameras
from bavs_jax.scenes import checks, images, models
from bavs_jax.scenes.base import SceneError


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
    checks.check_proportions(size, (width, height), image_path, frame.path)
    centre = frame.number("cx", 0.5 * width), frame.number("cy", 0.5 * height)
    stated = (*focal_lengths(frame, width, height), *centre)
    return models.fit_to_image(stated, (width, height), size, image_path, frame.path)


def lens_of(frame: Frame, distortion: list[float]) -> str:
    """The lens of one frame; without a `camera_model`, distortion that is not 0 decides."""
    inferred = "opencv" if any(distortion) else "pinhole"
    model = frame.get("camera_model")
    if model is None:
        lens = "fisheye" if frame.get("is_fisheye") is True else inferred  # as instant-ngp says it
    elif not isinstance(model, str) or model not in models.MODELS:
        raise SceneError(
            f"{frame.path}: {frame.field('camera_model')}: '{model}' is an unknown lens model: "
            f"use one of {', '.join(models.MODELS)}"
        )
    else:
        lens = models.MODELS[model][0]
    if lens == "fisheye":
        models.check_fisheye(distortion, frame.path, f"frames[{frame.index}].")
    # As in nerfstudio, coefficients count under any perspective model.
    return inferred if lens == "pinhole" else lens


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
        distortion.append([frame.number(key, 0.0) for key in models.COEFFICIENTS])
        lenses.append(lens_of(frame, distortion[-1]))
    names = [frame.own["file_path"] for frame in frames]
    lens = models.common_lens(lenses, names, frames[0].path)
    cameras = checks.build_cameras(
        poses, intrinsics, sizes, names=names, path=frames[0].path, distortion=distortion, lens=lens
    )
    return cameras, np.stack(poses)
