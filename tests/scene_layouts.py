"""Every layout that a loader reads, with a way to change the poses in it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tests.scene_files import (
    edit_json,
    orbit,
    write_blender,
    write_colmap,
    write_colmap_model,
    write_colmap_text,
    write_llff,
    write_mipnerf360,
    write_nerfplusplus,
    write_nerfstudio,
)


class Layout(NamedTuple):
    """A loader with one of the layouts that it reads."""

    kind: str  # of `load_scene`
    write: Callable  # root -> root
    image: str  # the second view's image
    poses: str  # the file with its pose
    edit_poses: Callable  # (root, fn on [V, 4, 4] OpenGL poses)


# --- editing poses ---------------------------------------------------------------------------


def edit_json_poses(name: str) -> Callable:
    def edit(root, change):
        def frames(data):
            poses = np.array([frame["transform_matrix"] for frame in data["frames"]], float)
            for frame, pose in zip(data["frames"], change(poses)):
                frame["transform_matrix"] = np.asarray(pose).tolist()

        edit_json(root / name, frames)

    return edit


def edit_bounds_poses(root, change) -> None:
    table = np.load(root / "poses_bounds.npy")
    matrices = table[:, :15].reshape(-1, 3, 5)
    down, right, back, position = (matrices[:, :, i] for i in range(4))
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = np.stack([right, -down, back, position], axis=-1)
    poses = np.asarray(change(poses))[:, :3]
    matrices[:, :, :4] = np.stack(
        [-poses[..., 1], poses[..., 0], poses[..., 2], poses[..., 3]], axis=-1
    )
    table[:, :15] = matrices.reshape(len(table), 15)
    np.save(root / "poses_bounds.npy", table)


def edit_nerfplusplus_poses(root, change) -> None:
    files = sorted((root / "train/pose").iterdir())
    flip = np.array([1.0, -1.0, -1.0, 1.0])
    poses = np.array([np.loadtxt(file).reshape(4, 4) for file in files]) * flip
    for file, pose in zip(files, change(poses) * flip):
        np.savetxt(file, pose.reshape(1, -1))


def edit_colmap_poses(text: bool) -> Callable:
    def edit(root, change):
        camera = {"model": "PINHOLE", "width": 12, "height": 8, "params": [15.0, 15.0, 6.0, 4.0]}
        write_colmap_model(
            root / "sparse/0", num=9, cameras=[camera], text=text, poses=change(np.array(orbit(9)))
        )

    return edit


JSON_POSES = edit_json_poses("transforms.json")
SECOND = "images/001.png"
LAYOUTS = {
    "blender": Layout(
        "blender",
        write_blender,
        "train/r_1.png",
        "transforms_train.json",
        edit_json_poses("transforms_train.json"),
    ),
    "nerfstudio": Layout("nerfstudio", write_nerfstudio, SECOND, "transforms.json", JSON_POSES),
    "llff": Layout("llff", write_llff, SECOND, "poses_bounds.npy", edit_bounds_poses),
    "colmap": Layout("colmap", write_colmap, SECOND, "sparse/0", edit_colmap_poses(False)),
    "colmap text": Layout("colmap", write_colmap_text, SECOND, "sparse/0", edit_colmap_poses(True)),
    "mipnerf360": Layout(
        "mipnerf360", write_mipnerf360, SECOND, "sparse/0", edit_colmap_poses(False)
    ),
    "mipnerf360 bounds": Layout(
        "mipnerf360", write_llff, SECOND, "poses_bounds.npy", edit_bounds_poses
    ),
    "lightfield json": Layout(
        "lightfield", write_nerfstudio, SECOND, "transforms.json", JSON_POSES
    ),
    "lightfield colmap": Layout(
        "lightfield", write_colmap, SECOND, "sparse/0", edit_colmap_poses(False)
    ),
    "lightfield nerf++": Layout(
        "lightfield",
        write_nerfplusplus,
        "train/rgb/001.png",
        "train/pose/001.txt",
        edit_nerfplusplus_poses,
    ),
}
ALL = tuple(LAYOUTS)
TRANSFORMS = ("nerfstudio", "lightfield json")
JSON = ("blender", *TRANSFORMS)
BOUNDS = ("llff", "mipnerf360 bounds")
BINARY = ("colmap", "mipnerf360", "lightfield colmap")
TEXT = ("colmap text",)
COLMAP = (*BINARY, *TEXT)
NERFPP = ("lightfield nerf++",)
FREE_POSES = (*JSON, *BOUNDS, *NERFPP)  # whose poses are matrices, which may be anything


class Fault(NamedTuple):
    """What to damage, which message must come, and in which layouts it can happen."""

    damage: Callable  # (root, layout)
    message: str  # a regular expression
    layouts: tuple[str, ...] = ALL
    options: dict = {}  # of the loader  # noqa: RUF012
