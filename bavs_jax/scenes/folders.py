"""Image folders of a capture: `images` and its down-scaled copies `images_2`, `images_4`, ..."""

import pathlib
import re

from bavs_jax.scenes import images
from bavs_jax.scenes.base import SceneError


def scaled_names(name: str, downscale: int | None, *, kind: str = "images") -> list[str]:
    """Where a file's copy at 1 / downscale of its size may lie, best first.

    nerfstudio keeps `images/a/b.png` as `images_2/b.png`, others keep the folders in between.

    Args:
      name: path relative to the scene's folder.
      downscale: a whole number, or None for the file itself.
      kind: the folder's name where `name` has none.
    """
    if downscale is None or downscale == 1:
        return [name]
    path = pathlib.PurePosixPath(name)
    if len(path.parts) < 2:
        return [f"{kind}_{downscale}/{path.name}"]
    folder = f"{path.parts[0]}_{downscale}"
    inner = pathlib.PurePosixPath(folder, *path.parts[1:])
    return list(dict.fromkeys([str(inner), f"{folder}/{path.name}"]))


def check_downscale(root: pathlib.Path, downscale: int | None) -> None:
    """A down-scaling factor must be a whole number that has a folder of images."""
    if downscale is None:
        return
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise SceneError(f"{root}: downscale {downscale!r}: give 1, 2, 4 or 8")
    if downscale > 1 and not (root / f"images_{downscale}").is_dir():
        raise SceneError(
            f"{root / f'images_{downscale}'}: folder is missing: choose another downscale"
        )


def image_folder(root: pathlib.Path, downscale: int | None) -> pathlib.Path:
    """The folder of images at a scale; None takes `images`, or else the least scaled copy.

    Raises:
      SceneError: there is no such folder.
    """
    check_downscale(root, downscale)
    if downscale is not None and downscale > 1:
        return root / f"images_{downscale}"
    if (root / "images").is_dir():
        return root / "images"
    copies = {
        int(match[1]): folder
        for folder in root.glob("images_*")
        if folder.is_dir() and (match := re.fullmatch(r"images_(\d+)", folder.name))
    }
    if downscale == 1 or not copies:
        raise SceneError(f"{root}: has neither images nor images_2, _4, _8: add the photographs")
    return copies[min(copies)]


def match_names(names: list[str], folder: pathlib.Path) -> list[pathlib.Path | None]:
    """The file in a folder that each name means.

    By the name itself, else by the name without its suffix; and where none is found so but the
    numbers agree, by the sorted order, since down-scaled copies are renamed in some data sets.
    """
    found: list[pathlib.Path | None] = []
    for name in names:
        stem = str(pathlib.PurePosixPath(name).with_suffix(""))
        found.append(images.find_image(folder, name) or images.find_image(folder, stem))
    if any(found):
        return found
    files = images.list_images(folder)
    if len(files) != len(names):
        return found
    by_name = dict(zip(sorted(names), files))
    return [by_name[name] for name in names]
