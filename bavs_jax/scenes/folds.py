"""Pixels at which a lens shows no direction: beyond where its distortion folds back over itself."""

import functools
import pathlib

import jax
import numpy as np

from bavs_jax.cameras import Cameras, image_pixels
from bavs_jax.lenses import LENSES, rising_radii, undistort
from bavs_jax.scenes import images
from bavs_jax.scenes.base import SceneError

LARGEST_MISS = 0.1  # pixels between a pixel and where its own ray is seen
NEARLY = 0.8  # of the lens's range: images that stay within it are not looked at any closer


def shown_pixels(intrinsics, distortion, size, *, lens: str) -> np.ndarray | None:
    """Which pixels of a camera have a direction of their own, or None where all of them do.

    Elsewhere `undistort` gives the edge of the lens's range, which is seen at another place.

    Args:
      intrinsics: [4] fx, fy, cx, cy in pixels.
      distortion: [6] coefficients.
      size: (width, height) in pixels.
      lens: "opencv" or "fisheye".

    Returns:
      [H, W] bool, of pixel centres: whether each is seen again along its own ray, to within
      `LARGEST_MISS`, and not by a branch of the polynomial beyond its fold.
    """
    width, height = (int(n) for n in size)
    focal, centre = (np.asarray(x, np.float32) for x in (intrinsics[:2], intrinsics[2:]))
    distortion = np.asarray(distortion, np.float32)
    edge = float(rising_radii(distortion, lens=lens)[-1])
    turn = np.linspace(0.0, 2.0 * np.pi, 64, dtype=np.float32)
    seen_edge = LENSES[lens](edge * np.stack([np.cos(turn), np.sin(turn)], axis=-1), distortion)
    # No pixel is farther from the axis than a corner.
    corners = (np.array([[0, 0], [width, 0], [0, height], [width, height]]) - centre) / focal
    if np.hypot(*corners.T).max() < NEARLY * np.hypot(*np.asarray(seen_edge).T).min():
        return None
    seen = (image_pixels(width, height) - centre) / focal
    xy = np.asarray(_undistort(seen, distortion, lens))
    miss = focal * np.abs(np.asarray(LENSES[lens](xy, distortion)) - seen)
    shown = (miss.max(axis=-1) < LARGEST_MISS) & (np.hypot(*xy.T) <= (1.0 + 1e-4) * edge)
    return None if shown.all() else shown.reshape(height, width)


@functools.partial(jax.jit, static_argnames="lens")
def _undistort(seen, distortion, lens):
    return jax.vmap(lambda xy: undistort(xy, distortion, lens=lens))(seen)


def shown_masks(
    cameras: Cameras, names: tuple[str, ...], path: pathlib.Path
) -> list[np.ndarray] | None:
    """`shown_pixels` of each of V cameras, after a warning; None where none loses any.

    Args:
      names: [V] how to call the views in messages.
      path: the file that gives the lenses, for messages.

    Raises:
      SceneError: a view has no pixel with a direction.
    """
    if cameras.lens == "pinhole":
        return None
    own = np.concatenate([cameras.intrinsics, cameras.distortion, cameras.sizes], axis=-1)
    kinds, kind_of = np.unique(own, axis=0, return_inverse=True)
    kind_of = kind_of.ravel()
    shown = [shown_pixels(k[:4], k[4:10], k[10:], lens=cameras.lens) for k in kinds]
    own_masks = [shown[kind] for kind in kind_of]
    views = []
    for view, mask in enumerate(own_masks):
        if mask is None:
            continue
        views.append(view)
        if not mask.any():
            raise SceneError(
                f"{path}: {names[view]}: no pixel lies within the range of its lens: "
                "check cx, cy and the distortion"
            )
    if not views:
        return None
    masks = [
        np.ones((height, width), bool) if mask is None else mask
        for mask, (width, height) in zip(own_masks, cameras.sizes)
    ]
    hidden = sum(int(np.count_nonzero(~mask)) for mask in masks)
    total = sum(mask.size for mask in masks)
    listed = images.some_names([names[view] for view in views])
    images.warn(
        f"{path}: {hidden / total:.1%} of all pixels lie beyond where the lens's distortion folds "
        f"back, in {len(views)} of {len(names)} views ({listed}): left out; calibrate the lens "
        "anew to use them"
    )
    return masks
