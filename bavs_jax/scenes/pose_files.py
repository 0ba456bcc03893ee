"""Files of camera poses that a user can reach: JSON or CSV, camera-to-world with OpenGL axes."""

import csv
import os
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation

from bavs_jax.scenes import texts
from bavs_jax.scenes.base import SceneError
from bavs_jax.scenes.checks import LARGEST

QUATERNION_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
ORTHONORMAL_TOLERANCE = 1e-3  # of R R^T from the identity; files hold few digits


def read_pose_file(path) -> np.ndarray:
    """Reads camera poses [N, 3, 4] float64, in the coordinates of the file.

    A JSON file holds nerfstudio's `{"frames": [{"transform_matrix": ...}]}` or a list; an entry of
    the list is a matrix (3x4 or 4x4) or an object with x, y, z, qx, qy, qz, qw. A CSV file has
    either a header with those seven names, or rows of 12 or 16 numbers, a matrix row by row.

    Raises:
      SceneError: anything that is no pose; it names the entry.
    """
    path = pathlib.Path(os.path.expanduser(path))
    try:
        entries = _json_entries(path) if path.suffix.lower() == ".json" else _csv_entries(path)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error}): give a JSON or CSV file") from error
    if not entries:
        raise SceneError(f"{path}: holds no pose: list at least one")
    return np.stack([_pose(entry, f"{path}: {name}") for name, entry in entries])


def _json_entries(path: pathlib.Path) -> list[tuple[str, object]]:
    data = texts.parse_json(path)
    if isinstance(data, dict):
        frames = data.get("frames")
        if not isinstance(frames, list):
            raise SceneError(f"{path}: frames: missing: give a list of frames or of poses")
        return [
            (
                f"frames[{i}].transform_matrix",
                frame.get("transform_matrix") if isinstance(frame, dict) else None,
            )
            for i, frame in enumerate(frames)
        ]
    if not isinstance(data, list):
        raise SceneError(f"{path}: is no list of poses: give one, or nerfstudio's frames")
    return [(f"entry {i}", entry) for i, entry in enumerate(data)]


def _csv_entries(path: pathlib.Path) -> list[tuple[str, object]]:
    lines = texts.read_text(path).splitlines()
    try:
        rows = [row for row in csv.reader(lines) if any(cell.strip() for cell in row)]
    except csv.Error as error:  # a field longer than the 131,072 characters that csv allows
        raise SceneError(f"{path}: is no CSV ({error}): mend the file") from error
    if not rows:
        return []
    head = [cell.strip() for cell in rows[0]]
    if set(QUATERNION_COLUMNS) <= set(head):
        return [(f"row {i}", dict(zip(head, row))) for i, row in enumerate(rows[1:], start=2)]
    try:
        numbers = [[float(cell) for cell in row] for row in rows]
    except ValueError as error:
        raise SceneError(
            f"{path}: {error}: give a header with {','.join(QUATERNION_COLUMNS)}, or rows of 12 "
            "or 16 numbers"
        ) from error
    return [
        (f"row {i}", [row[k : k + 4] for k in range(0, len(row), 4)])
        for i, row in enumerate(numbers, start=1)
    ]


def _pose(entry, where: str) -> np.ndarray:
    """One entry as a pose [3, 4]."""
    try:
        if isinstance(entry, dict):
            values = np.array([float(entry[name]) for name in QUATERNION_COLUMNS])
            if not np.linalg.norm(values[3:]) > 0.0:
                raise SceneError(f"{where}: the quaternion has no length: give a rotation")
            rotation = Rotation.from_quat(values[3:]).as_matrix()  # x, y, z, w
            pose = np.concatenate([rotation, values[:3, None]], axis=1)
        else:
            pose = np.array(entry, np.float64)
    except KeyError as error:
        raise SceneError(f"{where}: {error.args[0]}: missing: give a number") from error
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{where}: is no pose ({error}): give numbers only") from error
    if pose.shape not in ((3, 4), (4, 4)):
        raise SceneError(f"{where}: has shape {pose.shape}: give a 3 x 4 or 4 x 4 matrix")
    pose = pose[:3]
    if not np.isfinite(pose).all():
        raise SceneError(f"{where}: holds a number that is not finite: give finite numbers")
    largest = np.abs(pose).max()
    if largest > LARGEST:
        raise SceneError(f"{where}: holds {largest:g}: give numbers of at most {LARGEST:g}")
    rotation = pose[:, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise SceneError(
            f"{where}: its 3 x 3 part is no rotation (off by {off:.3g}): give a camera-to-world "
            "matrix without scale or mirror"
        )
    return pose
