"""The chosen poses as files: nerfstudio's transforms and camera path, and CSV."""

from __future__ import annotations

import csv
import io
import math
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import Cameras
from experiments.files import write_atomic, write_json

SECONDS_PER_VIEW = 2.0
FPS = 24
CSV_COLUMNS = (
    *("order", "x", "y", "z", "qx", "qy", "qz", "qw", "look_x", "look_y", "look_z"),
    *("score", "share_of_best", "picked"),
)
# By our lens: nerfstudio's camera_model, and the camera_type of its camera paths.
LENS_NAMES = {
    "pinhole": ("OPENCV", "perspective"),
    "opencv": ("OPENCV", "perspective"),
    "fisheye": ("OPENCV_FISHEYE", "fisheye"),
}
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def write_transforms(path: pathlib.Path, poses, cameras: Cameras, rows: list[dict]) -> None:
    """A nerfstudio `transforms.json` of views that are yet to be taken.

    Args:
      path: the file.
      poses: [k, 4, 4] in the coordinates to write.
      cameras: [k] their lenses and image sizes.
      rows: [k] what else is known of each: `order`, `picked`, `score`, `share_of_best`.
    """
    frames = []
    for i, row in enumerate(rows):
        fx, fy, cx, cy = (float(x) for x in cameras.intrinsics[i])
        width, height = (int(n) for n in cameras.sizes[i])
        frame = {
            "file_path": f"next/{row['order']:03d}.png",
            "transform_matrix": np.asarray(poses[i], float).tolist(),
            **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height},
        }
        distortion = np.asarray(cameras.distortion[i], float)
        frames.append(frame | dict(zip(DISTORTION, distortion.tolist())) | row)
    model = LENS_NAMES[cameras.lens][0]
    write_json(path, {"camera_model": model, "frames": frames})


def write_camera_path(path: pathlib.Path, poses, cameras: Cameras) -> None:
    """A camera path as nerfstudio's viewer saves it: it stands at each pose in turn.

    `fov` is vertical, in degrees; the path renders without lens distortion.
    """
    width, height = (int(n) for n in cameras.sizes[0])
    views = []
    for i, pose in enumerate(poses):
        own_width, own_height = (int(n) for n in cameras.sizes[i])
        fov = 2.0 * math.degrees(math.atan(0.5 * own_height / float(cameras.intrinsics[i, 1])))
        matrix = np.asarray(pose, float).reshape(-1).tolist()
        views.append({"camera_to_world": matrix, "fov": fov, "aspect": own_width / own_height})
    value = {
        "camera_type": LENS_NAMES[cameras.lens][1],
        "render_height": height,
        "render_width": width,
        "fps": FPS,
        "seconds": SECONDS_PER_VIEW * len(views),
        "smoothness_value": 0.0,
        "is_cycle": False,
        "keyframes": [],
        "camera_path": views,
    }
    write_json(path, value)


def write_csv(path: pathlib.Path, poses, rows: list[dict]) -> None:
    """One line per pose: place, quaternion (OpenGL axes), look direction, and what it is worth."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(CSV_COLUMNS)
    for pose, row in zip(np.asarray(poses, float), rows):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()  # x, y, z, w
        numbers = [*pose[:3, 3], *quaternion, *-pose[:3, 2], row["score"], row["share_of_best"]]
        cells = ["" if n is None else f"{n:.9g}" for n in numbers]
        writer.writerow([row["order"], *cells, row["picked"]])
    write_atomic(path, lambda file: file.write(text.getvalue().encode()))
