"""Free distance to the scene: by a longer lens, where photos have pixels to spare, or by a walk.

The middle `1 / ratio` of a photo is what a lens of `ratio` times the focal length takes from the
same place. Where the photo is larger than what is trained on, it has that picture exactly.
"""

import pathlib
from typing import NamedTuple

import numpy as np

from bavs_jax.cameras import Cameras
from bavs_jax.scenes.base import SceneError


class Zoom(NamedTuple):
    """How far apart the nearest and the farthest view of a scene may be."""

    factor: float  # of magnification between the two, above 1
    seed: int  # draws where each of them is


def magnifications(zoom: Zoom | None, num: int, first: int = 0) -> np.ndarray:
    """Of views `first` to `first + num`, [num] in [1, factor]; all 1 without a zoom.

    `factor^u` with `u ~ U[0, 1]`: every doubling is as likely as any other.
    """
    if zoom is None:
        return np.ones(num)
    return zoom.factor ** np.random.default_rng(zoom.seed).random(first + num)[first:]


def check_zoom(zoom: Zoom, reduction: float, width: int, path: pathlib.Path) -> None:
    """Raises SceneError where a magnified view would have fewer pixels than are trained on.

    Args:
      zoom: what is asked for.
      reduction: pixels trained on for each pixel of a photo's width, at most 1.
      width: of the photo, pixels.
      path: of the photo or of its scene, for the message.
    """
    if zoom.factor * reduction <= 1.0:
        return
    smaller = int(width / zoom.factor)
    fix = f"give an image_size of at most {smaller}, or a" if smaller else "give a"
    raise SceneError(
        f"{path}: pool.factor: zoom by {zoom.factor:g} needs photos that many times as wide as "
        f"image_size, but this is {round(width * reduction)} and they are {width} pixels wide: "
        f"{fix} smaller factor"
    )


def photo_windows(sizes, ratios) -> np.ndarray:
    """The middle of each of V photos, [V, 2, 2] int32: its first corner, and one past its last.

    Args:
      sizes: [V, 2] width and height, pixels.
      ratios: [V] magnification, at least 1; 1 takes all of the photo.
    """
    sizes = np.asarray(sizes)
    inner = np.maximum(np.rint(sizes / np.asarray(ratios)[:, None]), 1).astype(np.int32)
    first = (sizes - inner) // 2
    return np.stack([first, first + inner], axis=1).astype(np.int32)


def cut(image: np.ndarray, window: np.ndarray) -> np.ndarray:
    """What a window (see `photo_windows`) shows of an image [H, W, ...]."""
    (left, top), (right, bottom) = window
    return image[top:bottom, left:right]


def cut_cameras(cameras: Cameras, windows: np.ndarray) -> Cameras:
    """The cameras of what windows [V, 2, 2] show: the principal point moves with the corner."""
    intrinsics = np.array(cameras.intrinsics)
    intrinsics[:, 2:] -= windows[:, 0]
    return cameras.replace(intrinsics=intrinsics, sizes=windows[:, 1] - windows[:, 0])
