"""Scenes in the layout of Mip-NeRF 360: a COLMAP model beside `images`, `images_2`, ..."""

from __future__ import annotations

import dataclasses

from bavs_jax.scenes import checks
from bavs_jax.scenes.base import Scene
from bavs_jax.scenes.capture import make_scene
from bavs_jax.scenes.colmap import find_model, read_colmap
from bavs_jax.scenes.llff import TEST_EVERY, read_llff
from bavs_jax.scenes.splits import every_nth


@checks.name_refusals
def load_mipnerf360(
    root, *, downscale: int | None = None, strict: bool = False, **options
) -> Scene:
    """Loads a scene in the layout of Mip-NeRF 360; every 8th image is a test view.

    Where there is no COLMAP model, `poses_bounds.npy` gives the poses and the bounds.

    Args:
      root: the folder of `sparse` or `poses_bounds.npy`.
      downscale: N takes the images of `images_N`; None those of `images`, or else the largest.
      strict: an image without a file is an error, not a warning.
      **options: of `make_scene`.

    Returns:
      The scene, in normalised coordinates with +z up.

    Raises:
      SceneError: anything in the files that cannot be used.
    """
    root = checks.scene_folder(root)
    if find_model(root) is None and (root / "poses_bounds.npy").is_file():
        return make_scene(read_llff(root, downscale=downscale), **options)
    capture = read_colmap(root, downscale=downscale, strict=strict)
    split = every_nth(len(capture.files), TEST_EVERY, path=capture.source)
    return make_scene(dataclasses.replace(capture, split=split), **options)
