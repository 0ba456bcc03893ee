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


def write_images(
    folder: pathlib.Path, num: int, width: int, height: int, suffix=".png", seed: int = 0
) -> None:
    """Writes images of noise `000.png`, `001.png`, ..., of the seeds from `seed` on."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(num):
        iio.imwrite(folder / f"{i:03d}{suffix}", random_image(seed + i, width, height, 3))


def write_llff(
    root: pathlib.Path, *, num: int = 9, width: int = 12, height: int = 8, downscale: int = 2
) -> pathlib.Path:
    """Writes `poses_bounds.npy` for full-size images, `images`, and copies at 1 / downscale."""
    write_images(root / "images", num, width, height)
    write_images(root / f"images_{downscale}", num, width // downscale, height // downscale)
    rows = []
    for i, pose in enumerate(np.array(orbit(num))[:, :3]):
        right, up, back, position = pose.T
        matrix = np.stack([-up, right, back, position, [height, width, 15.0]], axis=1)
        rows.append([*matrix.ravel(), 2.0 + 0.1 * i, 7.0 - 0.1 * i])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def write_colmap_model(
    folder: pathlib.Path, *, num: int, cameras: list[dict], text: bool, poses=None
) -> None:
    """Writes a sparse model with pycolmap; image i has the camera i modulo their number.

    The poses [num, 4, 4] are camera-to-world in OpenGL axes; the orbit by default.
    """
    import pycolmap

    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, start=1):
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=number, **camera))
    for i, pose in enumerate(np.array(orbit(num) if poses is None else poses)):
        rotation = (pose[:3, :3] * [1.0, -1.0, -1.0]).T  # y down, z forward
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:3, 3])
        image = pycolmap.Image(
            name=f"{i:03d}.png", camera_id=1 + i % len(cameras), image_id=num - i
        )
        model.add_image_with_trivial_frame(image, cam_from_world)
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.array([1, 2, 3], np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder))


def write_colmap(
    root: pathlib.Path,
    *,
    num: int = 9,
    width: int = 12,
    height: int = 8,
    text: bool = False,
    model: str = "OPENCV",
    params=(15.0, 16.0, 5.5, 4.5, 0.1, 0.0, 0.0, 0.01),
    folder: str = "sparse/0",
) -> pathlib.Path:
    """Writes images and their COLMAP model of one camera."""
    write_images(root / "images", num, width, height)
    camera = {"model": model, "width": width, "height": height, "params": list(params)}
    write_colmap_model(root / folder, num=num, cameras=[camera], text=text)
    return root


def write_colmap_text(root: pathlib.Path) -> pathlib.Path:
    """The text form, of the three files that every COLMAP version writes."""
    write_colmap(root, text=True)
    for name in ("rigs.txt", "frames.txt"):
        (root / "sparse/0" / name).unlink()
    return root


def write_mipnerf360(root: pathlib.Path) -> pathlib.Path:
    """COLMAP, `poses_bounds.npy` and copies at half the size."""
    write_llff(root)
    camera = {"model": "PINHOLE", "width": 12, "height": 8, "params": [15.0, 15.0, 6.0, 4.0]}
    write_colmap_model(root / "sparse/0", num=9, cameras=[camera], text=False)
    return root


def write_nerfplusplus(root: pathlib.Path, *, num_train: int = 4, num_test: int = 2):
    """Writes `{train,test}/{rgb,pose,intrinsics}`, y down and z forward."""
    poses = np.array(orbit(num_train + num_test)) * [1.0, -1.0, -1.0, 1.0]
    camera = np.eye(4)
    camera[0, 0], camera[1, 1], camera[:2, 2] = 15.0, 16.0, [5.5, 4.5]
    for split, first, num in (("train", 0, num_train), ("test", num_train, num_test)):
        write_images(root / split / "rgb", num, 12, 8, seed=first)
        for kind in ("pose", "intrinsics"):
            (root / split / kind).mkdir()
        for i in range(num):
            np.savetxt(root / split / f"pose/{i:03d}.txt", poses[first + i].reshape(1, -1))
            np.savetxt(root / split / f"intrinsics/{i:03d}.txt", camera.reshape(1, -1))
    return root
