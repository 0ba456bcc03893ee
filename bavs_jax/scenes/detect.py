"""What kind of scene a folder holds, by the files in it."""

import pathlib

from bavs_jax.scenes import checks, nerfplusplus
from bavs_jax.scenes.base import SceneError
from bavs_jax.scenes.colmap import find_model

LOOKED_FOR = (
    "transforms.json (nerfstudio), transforms_train.json (blender), "
    "sparse/0/cameras.bin or .txt (colmap; with poses_bounds.npy mipnerf360), "
    "poses_bounds.npy (llff), train/pose (lightfield)"
)


def has_kind(root: pathlib.Path, kind: str) -> bool:
    """Whether a folder has the files by which a kind of scene is known."""
    if kind == "nerfstudio":
        return (root / "transforms.json").is_file()
    if kind == "blender":
        return (root / "transforms_train.json").is_file()
    if kind == "llff":
        return (root / "poses_bounds.npy").is_file()
    if kind == "colmap":
        return find_model(root) is not None
    if kind == "mipnerf360":
        return has_kind(root, "colmap") or has_kind(root, "llff")
    if kind == "lightfield":
        others = ("nerfstudio", "colmap", "llff")
        return nerfplusplus.has_layout(root) or any(has_kind(root, other) for other in others)
    raise ValueError(f"kind {kind!r} is unknown")


@checks.name_refusals
def detect_kind(root) -> str:
    """A scene folder's key of `LOADERS`: the first that fits of those that say most about a scene.

    A Light Field scene looks like the layout that it is kept in, and has to be named.

    Raises:
      SceneError: the folder is missing, or holds no known layout.
    """
    root = checks.scene_folder(root)
    for kind in ("nerfstudio", "blender"):
        if has_kind(root, kind):
            return kind
    if has_kind(root, "colmap"):
        return "mipnerf360" if has_kind(root, "llff") else "colmap"
    for kind in ("llff", "lightfield"):
        if has_kind(root, kind):
            return kind
    raise SceneError(f"{root}: no known layout: looked for {LOOKED_FOR}: check the path")


@checks.name_refusals
def check_kind(root, kind: str) -> None:
    """A folder must hold the kind of scene that it is loaded as.

    Raises:
      SceneError: it holds another kind, which the message names, or none.
    """
    root = checks.scene_folder(root)
    if has_kind(root, kind):
        return
    found = detect_kind(root)
    raise SceneError(f"{root}: is no {kind} scene but a {found} one: load it as {found}")
