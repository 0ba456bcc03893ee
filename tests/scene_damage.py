"""Ways to damage a scene's files, each a function of the scene's folder and its layout."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable

import imageio.v3 as iio
import numpy as np
from PIL import Image

from tests.scene_files import edit_json, random_image, write_colmap_model, write_colmap_text


def image_bytes(content: bytes) -> Callable:
    """Replaces the second view's image."""
    return lambda root, layout: (root / layout.image).write_bytes(content)


def encoded(image: Image.Image, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def picture(width: int = 12, height: int = 8, mode: str = "RGB") -> Image.Image:
    return Image.fromarray(random_image(0, width, height, 3)).convert(mode)


def nothing(root, layout) -> None:
    """The fault is in the options."""


def image(name: str, content: np.ndarray) -> Callable:
    """Writes another image."""
    return lambda root, layout: iio.imwrite(root / name, content)


def cut_image(root, layout) -> None:
    path = root / layout.image
    path.write_bytes(path.read_bytes()[:-100])


def image_to_folder(root, layout) -> None:
    (root / layout.image).unlink()
    (root / layout.image).mkdir()


def remove_images(root, layout) -> None:
    for file in (root / layout.image).parent.iterdir():
        file.unlink()


def remove_image_folder(root, layout) -> None:
    for folder in root.glob("images*"):
        shutil.rmtree(folder)


def write(name: str, content: str | bytes) -> Callable:
    """Replaces a file by its name; `{poses}` is the layout's file with poses."""
    data = content.encode() if isinstance(content, str) else content
    return lambda root, layout: (root / name.format(poses=layout.poses)).write_bytes(data)


def remove(name: str) -> Callable:
    def damage(root, layout):
        path = root / name.format(poses=layout.poses)
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def prepend(text: str) -> Callable:
    def damage(root, layout):
        path = root / layout.poses
        path.write_text(text + path.read_text())

    return damage


def cut(name: str, count: int) -> Callable:
    """Keeps the first `count` bytes of a file; a negative count drops as many."""

    def damage(root, layout):
        path = root / name
        path.write_bytes(path.read_bytes()[:count])

    return damage


def replace(name: str, old: str, new: str) -> Callable:
    """Replaces the first occurrence in a text file."""

    def damage(root, layout):
        text = (root / name).read_text()
        assert old in text
        (root / name).write_text(text.replace(old, new, 1))

    return damage


def fields(**values) -> Callable:
    """Sets fields of the layout's JSON file; None removes one."""

    def damage(root, layout):
        def change(data):
            data.update(values)
            for key in [key for key, value in values.items() if value is None]:
                del data[key]

        edit_json(root / layout.poses, change)

    return damage


def frame(**values) -> Callable:
    """Sets fields of the second frame."""
    return lambda root, layout: edit_json(
        root / layout.poses, lambda data: data["frames"][1].update(values)
    )


def first_frame_only(root, layout) -> None:
    edit_json(root / layout.poses, lambda data: data.update(frames=data["frames"][:1]))


def every_frame(**values) -> Callable:
    """Sets fields of every frame; `{i}` in text is the frame's number."""

    def damage(root, layout):
        def change(data):
            for i, one in enumerate(data["frames"]):
                one.update({k: v.format(i=i) for k, v in values.items()})

        edit_json(root / layout.poses, change)

    return damage


def both(*damages: Callable) -> Callable:
    def damage(root, layout):
        for one in damages:
            one(root, layout)

    return damage


def pose(change: Callable) -> Callable:
    """Changes the second pose [4, 4] in place."""

    def damage(root, layout):
        def edit(poses):
            change(poses[1])
            return poses

        layout.edit_poses(root, edit)

    return damage


def one_place(root, layout) -> None:
    def edit(poses):
        poses = poses.copy()
        poses[:, :3, 3] = [1.0, 2.0, 3.0]
        return poses

    layout.edit_poses(root, edit)
    if layout.kind == "lightfield" and "train" in layout.image:
        for file in (root / "test/pose").iterdir():
            shutil.copy(root / "train/pose/000.txt", file)


def scaled(matrix) -> None:
    matrix[:3, :3] *= 1.1


def mirrored(matrix) -> None:
    matrix[:3, 0] *= -1.0


def not_a_number(matrix) -> None:
    matrix[1, 3] = np.nan


def infinite(matrix) -> None:
    matrix[0, 0] = np.inf


def array(name: str, values) -> Callable:
    return lambda root, layout: np.save(root / name, values, allow_pickle=True)


def bounds(change: Callable) -> Callable:
    """Changes the table of `poses_bounds.npy`."""

    def damage(root, layout):
        table = np.load(root / "poses_bounds.npy")
        changed = change(table)
        np.save(root / "poses_bounds.npy", table if changed is None else changed)

    return damage


def put(row: int, column: int, value: float) -> Callable:
    def change(table):
        table[row, column] = value

    return bounds(change)


def mask(content: np.ndarray) -> Callable:
    """Gives every frame the same mask."""

    def damage(root, layout):
        iio.imwrite(root / "mask.png", content)
        every_frame(mask_path="mask.png")(root, layout)

    return damage


def depth(name: str, content: np.ndarray) -> Callable:
    """Gives the second frame a depth map."""

    def damage(root, layout):
        if name.endswith(".npy"):
            np.save(root / name, content)
        else:
            iio.imwrite(root / name, content)
        frame(depth_file_path=name)(root, layout)

    return damage


def model(*cameras: dict) -> Callable:
    """Writes another COLMAP model."""
    return lambda root, layout: write_colmap_model(
        root / "sparse/0", num=9, cameras=list(cameras), text=layout.write is write_colmap_text
    )


def camera(name: str, *params: float) -> dict:
    return {"model": name, "width": 12, "height": 8, "params": list(params)}


def duplicate_overlap(root, layout) -> None:
    """Lists a training image among the test images."""
    train = json.loads((root / "transforms_train.json").read_text())
    edit_json(root / "transforms_test.json", lambda data: data["frames"].append(train["frames"][0]))
