"""The Light Field dataset (Yücer et al. 2016), in the layouts that NeRF papers pass it around in.

Bayes' Rays keeps a `transforms.json`, FisherRF a COLMAP model, CF-NeRF a `poses_bounds.npy`, and
NeRF++ a text file a view.
"""

import dataclasses
import functools
import pathlib
from typing import NamedTuple

from bavs_jax.scenes import checks, maps, nerfplusplus, texts
from bavs_jax.scenes.base import Scene, SceneError
from bavs_jax.scenes.capture import Capture, make_scene
from bavs_jax.scenes.colmap import find_model, read_colmap
from bavs_jax.scenes.llff import read_llff
from bavs_jax.scenes.nerfstudio import read_nerfstudio


class Convention(NamedTuple):
    """Views by their place in the order of file names, and half a side of the box."""

    pool: range
    test: range
    box_half_side: float  # units of the poses


# Published splits. CF-NeRF tests the basket on three views, Bayes' Rays and FisherRF on four.
SPLITS = {
    "africa": Convention(range(5, 14, 2), range(6, 14, 2), 36.0),
    "basket": Convention(range(43, 50, 2), range(42, 50, 2), 50.0),
    "basket-cfnerf": Convention(range(43, 50, 2), range(44, 50, 2), 50.0),
    "statue": Convention(range(67, 76, 2), range(68, 76, 2), 50.0),
    "torch": Convention(range(8, 17, 2), range(9, 17, 2), 72.0),
}
NEAR, FAR = 1.0, 100.0  # units of the poses
BOX_HALF_SIDE = 50.0  # units of the poses, where no split says it
DOWNSCALE = 2  # at which the papers work, where the images are at hand
LAYOUTS = ("transforms.json", "sparse/0/cameras.bin", "poses_bounds.npy", "train/pose")


def read_any(root: pathlib.Path, *, downscale: int | None, strict: bool) -> Capture:
    """Reads whichever layout a folder has."""
    if (root / "transforms.json").is_file():
        return read_nerfstudio(root, downscale=downscale, strict=strict)
    if find_model(root) is not None:
        return read_colmap(root, downscale=downscale, strict=strict)
    if (root / "poses_bounds.npy").is_file():
        capture = read_llff(root, downscale=downscale)
        return dataclasses.replace(capture, bounds=None, split=None)
    if nerfplusplus.has_layout(root):
        return nerfplusplus.read_nerfplusplus(root)
    raise SceneError(f"{root}: has none of {', '.join(LAYOUTS)}: check the path to the scene")


def true_depths(root: pathlib.Path, capture: Capture, test) -> tuple:
    """How to read `depth_gt_<n>.npy`, the true depth of the n-th test view as Bayes' Rays keeps it.

    `scale_parameters.txt` says how many of its units are one of the poses.
    """
    paths = {int(view): root / f"depth_gt_{n:02d}.npy" for n, view in enumerate(test)}
    if not any(path.is_file() for path in paths.values()):
        return capture.depths
    path = root / "scale_parameters.txt"
    if not path.is_file():
        raise SceneError(f"{path}: file is missing: add it, it scales the depth_gt files")
    text = texts.read_text(path).strip()
    try:
        scale = float(text)
    except ValueError as error:
        raise SceneError(f"{path}: is no number: write the scale of depth_gt") from error
    unit = 1.0 / checks.check_number(scale, path, "scale", positive=True)
    return tuple(
        functools.partial(maps.read_depth, paths[view], image_path=file, unit=unit)
        if view in paths
        else None
        for view, file in enumerate(capture.files)
    )


@checks.name_refusals
def load_lightfield(
    root, *, split: str | None = None, downscale: int | None = None, strict: bool = False, **options
) -> Scene:
    """Loads a scene of the Light Field dataset, levelled and centred.

    Units stay those of the poses, near is 1, far 100, and the scene bounded, as in Bayes' Rays;
    but a scene in the layout of NeRF++, whose units are others, is taken for any other capture.

    Args:
      root: a folder with any of `LAYOUTS`.
      split: a published split, a key of `SPLITS`; None for the files' own, or the options'.
      downscale: N takes the images of `images_N`; None those of `images_2` where it exists.
      strict: an image without a file is an error, not a warning.
      **options: of `make_scene`.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    root = checks.scene_folder(root)
    if downscale is None and (root / f"images_{DOWNSCALE}").is_dir():
        downscale = DOWNSCALE
    capture = read_any(root, downscale=downscale, strict=strict)
    if split is not None:
        if split not in SPLITS:
            raise SceneError(f"{root}: split '{split}' is unknown: use one of {', '.join(SPLITS)}")
        given = [key for key in ("pool_size", "test_every") if options.get(key) is not None]
        if given:
            raise SceneError(f"{root}: split and {given[0]} are both given: choose one")
        chosen = SPLITS[split]
        depths = true_depths(root, capture, chosen.test)
        capture = dataclasses.replace(capture, split=(chosen.pool, chosen.test), depths=depths)
    if capture.source == root:  # NeRF++
        return make_scene(capture, **options)
    side = SPLITS[split].box_half_side if split else BOX_HALF_SIDE
    defaults = {"scale": 1.0, "near": NEAR, "far": FAR, "box_half_side": side, "unbounded": False}
    return make_scene(capture, **(defaults | options))
