"""Small scenes in the real file layouts, written to a folder for tests."""

from __future__ import annotations

import json
import os
import pathlib

import imageio.v3 as iio
import numpy as np

from bavs_jax.cameras import look_at

DATA = pathlib.Path(os.environ.get("BAVS_DATA", pathlib.Path(__file__).parents[2] / "shared/data"))


def orbit(num: int, radius: float = 4.0, height: float = 1.0) -> list[list[list[float]]]:
    """Poses [4, 4] on a circle, looking at the origin, as JSON lists."""
    poses = []
    for angle in 2.0 * np.pi * np.arange(num) / num:
        position = [radius * np.cos(angle), radius * np.sin(angle), height]
        poses.append([*look_at(position, [0.0, 0.0, 0.0]).tolist(), [0.0, 0.0, 0.0, 1.0]])
    return poses


def random_image(seed: int, width: int, height: int, channels: int) -> np.ndarray:
    """An image of noise [height, width, channels] uint8."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), np.uint8)


def edit_json(path: pathlib.Path, change) -> None:
    """Lets `change` alter the content of a JSON file in place."""
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def write_blender(
    root: pathlib.Path, *, num_train: int = 3, num_test: int = 2, width: int = 8, height: int = 6
) -> pathlib.Path:
    """Writes RGBA images and their transforms in the layout of NeRF-synthetic."""
    for split, num in (("train", num_train), ("test", num_test)):
        (root / split).mkdir(parents=True)
        frames = []
        for i, pose in enumerate(orbit(num)):
            image = random_image(100 * len(split) + i, width, height, 4)
            iio.imwrite(root / split / f"r_{i}.png", image)
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose})
        transforms = {"camera_angle_x": 0.7, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(transforms))
    return root


def write_nerfstudio(
    root: pathlib.Path, *, num: int = 8, width: int = 12, height: int = 8, **fields
) -> pathlib.Path:
    """Writes RGB images and `transforms.json`; `fields` replace its top-level entries."""
    (root / "images").mkdir(parents=True)
    frames = []
    for i, pose in enumerate(orbit(num)):
        iio.imwrite(root / f"images/{i:03d}.png", random_image(i, width, height, 3))
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": pose})
    transforms = {"fl_x": 15.0, "fl_y": 16.0, "cx": 5.5, "cy": 4.5, "w": width, "h": height}
    transforms |= {"camera_model": "OPENCV", "k1": 0.1, "p2": 0.01, **fields, "frames": frames}
    transforms = {key: value for key, value in transforms.items() if value is not None}
    (root / "transforms.json").write_text(json.dumps(transforms))
    return root
