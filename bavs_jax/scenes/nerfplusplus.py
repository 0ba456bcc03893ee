"""Scenes in the layout of NeRF++: `{train,test}/{rgb,pose,intrinsics}`, one text file a view."""

import pathlib

import numpy as np

from bavs_jax.scenes import checks, images, texts
from bavs_jax.scenes.base import SceneError
from bavs_jax.scenes.capture import Capture

SPLITS = ("train", "test")


def has_layout(root: pathlib.Path) -> bool:
    """Whether a folder holds a scene in this layout."""
    return all((root / split / "pose").is_dir() for split in SPLITS)


def read_matrix(path: pathlib.Path) -> np.ndarray:
    """A 4 x 4 matrix written as 16 numbers."""
    if not path.is_file():
        raise SceneError(f"{path}: file is missing: every image needs one of its name")
    words = texts.read_text(path).split()
    try:
        values = np.array(words, np.float64)
    except ValueError as error:
        raise SceneError(f"{path}: holds what is no number: write 16 numbers") from error
    if values.size != 16:
        raise SceneError(f"{path}: has {values.size} numbers: write the 16 of a 4 x 4 matrix")
    return values.reshape(4, 4)


def read_intrinsics(path: pathlib.Path) -> list[float]:
    """`fx, fy, cx, cy` from a camera matrix."""
    matrix = read_matrix(path)
    fx, fy = (
        checks.check_number(float(matrix[i, i]), path, f"[{i}][{i}]", positive=True) for i in (0, 1)
    )
    cx, cy = (checks.check_number(float(matrix[i, 2]), path, f"[{i}][2]") for i in (0, 1))
    return [fx, fy, cx, cy]


def read_nerfplusplus(root: pathlib.Path) -> Capture:
    """Reads camera-to-world poses with y down and z forward; the folders are the split."""
    files: list[pathlib.Path] = []
    poses, intrinsics, split = [], [], []
    for name in SPLITS:
        folder = root / name
        if not (folder / "rgb").is_dir():
            raise SceneError(f"{folder / 'rgb'}: folder is missing: add the photographs")
        listed = images.list_images(folder / "rgb")
        num_poses = len(list((folder / "pose").glob("*.txt")))
        if num_poses != len(listed):
            raise SceneError(
                f"{folder}: rgb has {len(listed)} images but pose has {num_poses} files: "
                "give every image its pose"
            )
        split.append(range(len(files), len(files) + len(listed)))
        for file in listed:
            path = folder / "pose" / f"{file.stem}.txt"
            poses.append(checks.check_pose(read_matrix(path), path, "pose"))
            poses[-1][:3, 1:3] *= -1.0
            intrinsics.append(read_intrinsics(folder / "intrinsics" / f"{file.stem}.txt"))
        files += listed
    sizes = [images.image_size(file) for file in files]
    return Capture(
        root=root,
        source=root,
        files=tuple(files),
        poses=np.stack(poses),
        cameras=checks.build_cameras(
            poses, intrinsics, sizes, names=[checks.view_name(f, root) for f in files], path=root
        ),
        split=(split[0], split[1]),
    )
