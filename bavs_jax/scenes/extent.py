"""Near, far and box of a capture."""

import pathlib

import numpy as np

from bavs_jax.cameras import Cameras, pixel_rays
from bavs_jax.scenes.base import SceneError
from bavs_jax.scenes.checks import LARGEST
from bavs_jax.scenes.maps import GRAZING

NEAR = 0.05  # scene units
BOX_HALF_SIDE = 1.5  # scene units
NEAR_SHARE = 0.9  # of the nearest point that a camera is known to see, as in NeRF


def scene_extent(
    cameras: Cameras,
    bounds: np.ndarray | None,
    *,
    box_half_side: float | None,
    near: float | None,
    far: float | None,
    unbounded: bool,
    path: pathlib.Path,
) -> tuple[float, float, np.ndarray]:
    """Near, far and box [2, 3] of a capture, scene units; the options are those of `make_scene`.

    Args:
      cameras: [V] in scene coordinates.
      bounds: [V, 2] depths along the optical axis between which content lies, scene units, or
        None where they are not known.
    """
    if bounds is None:
        box = cube(BOX_HALF_SIDE if box_half_side is None else box_half_side, path)
        default_near, default_far = NEAR, farthest_corner(cameras, box)
    else:
        corners = image_corners(cameras)
        seen = seen_box(cameras, corners, bounds, unbounded=unbounded)
        box = seen if box_half_side is None else cube(box_half_side, path)
        default_near = NEAR_SHARE * float(bounds.min())
        default_far = float(bounds.max() * np.linalg.norm(corners, axis=-1).max())
    near = default_near if near is None else near
    far = default_far if far is None else far
    if not 1.0 / LARGEST <= near < far <= LARGEST:  # nor NaN
        raise SceneError(f"{path}: near {near:g}, far {far:g}: give 0 < near < far")
    return near, far, box


def cube(half_side: float, path: pathlib.Path) -> np.ndarray:
    """A box [2, 3] around the origin."""
    if not 1.0 / LARGEST <= half_side <= LARGEST:
        raise SceneError(f"{path}: box_half_side {half_side}: give a number above 0")
    return half_side * np.array([[-1.0] * 3, [1.0] * 3], np.float32)


def farthest_corner(cameras: Cameras, box: np.ndarray) -> float:
    """The largest distance from a camera to a corner of a box around the origin."""
    return float(np.linalg.norm(np.abs(cameras.positions) + box[1], axis=-1).max())


def seen_box(
    cameras: Cameras, corners: np.ndarray, bounds: np.ndarray, *, unbounded: bool
) -> np.ndarray:
    """The box [2, 3] around what cameras see from their least to their largest bound.

    For an unbounded scene it ends at the distance whose inverse lies midway: beyond it a
    forward-facing capture hardly tells depths apart.
    """
    first, last = bounds.min(), bounds.max()
    if unbounded:
        last = 2.0 / (1.0 / first + 1.0 / last)
    ends = [cameras.positions[:, None] + depth * corners for depth in (first, last)]
    seen = np.concatenate(ends).reshape(-1, 3)
    return np.stack([seen.min(axis=0), seen.max(axis=0)]).astype(np.float32)


def image_corners(cameras: Cameras) -> np.ndarray:
    """Vectors [V, 4, 3] from each camera to where its image corners are at depth 1.

    Numerics: corners at right angles to the optical axis, and beyond, count as almost so.
    """
    num = len(cameras)
    places = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]], np.float32)
    pixels = places * np.asarray(cameras.sizes, np.float32)[:, None]
    rays = pixel_rays(cameras, np.repeat(np.arange(num), 4), pixels.reshape(-1, 2))
    directions = np.asarray(rays.directions).reshape(num, 4, 3)
    forward = -np.asarray(cameras.world_from_cam)[:, None, :, 2]
    cosine = (directions * forward).sum(axis=-1, keepdims=True)
    return directions / np.maximum(cosine, GRAZING)
