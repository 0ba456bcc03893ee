"""Pools that people have: views crowded at one height, or a start from one side.

The test views stay those of the scene: whatever the pool, all directions are asked for. Directions
are seen from the scene's focus, the point that its cameras look at: the centre of an orbit around
one object. The middle of a capture's box is where its cameras are, and says nothing of their sides.
"""

import dataclasses

import numpy as np

from bavs_jax.placement.seen import focus_point
from bavs_jax.scenes.base import Scene, SceneError

KINDS = ("even", "unbalanced", "arc", "reachable", "zoom")
BANDS = ("lowest", "middle", "highest")
LEAST_SPREAD = 1e-3  # radians of elevation, and the sine of an angle to the vertical


def elevations(scene: Scene, view_ids) -> np.ndarray:
    """Angles [n] of cameras above the horizon of the scene's focus, radians in float64."""
    across, above = _across_and_above(scene, view_ids)
    return np.arctan2(above, np.linalg.norm(across, axis=-1))


def azimuths(scene: Scene, view_ids, reference: int) -> np.ndarray:
    """Angles [n] around `up` from one camera to others, radians in [-pi, pi], float64.

    NaN for a camera that is straight above or below the scene's focus, or the reference is.
    """
    across, above = _across_and_above(scene, [reference, *view_ids])
    length = np.linalg.norm(across, axis=-1)
    is_vertical = length <= LEAST_SPREAD * np.hypot(length, above)
    ahead = across @ across[0]
    aside = np.cross(across[0], across) @ np.asarray(scene.up, np.float64)
    return np.where(is_vertical | is_vertical[0], np.nan, np.arctan2(aside, ahead))[1:]


def crowded_band(seed: int) -> int:
    """Which of `BANDS` an unbalanced pool crowds."""
    return int(np.random.default_rng(seed).integers(len(BANDS)))


def unbalanced(scene: Scene, *, share: float, seed: int) -> Scene:
    """A scene whose pool is thinned until most of it lies in one of three bands of elevation.

    Elevation is measured from the scene's focus by its `up`. Sorted by it, the pool is cut into
    three bands of equally many views, which on an even hemisphere are of equal area. The seed draws
    which band is crowded, and which views stay: as many as leave `share` of the pool in that band
    and half of the rest in each other one. That is 40 of 100 views for a share of 0.75, the setting
    of SBV.

    Args:
      share: of the views in the crowded band, from 1/3 to below 1.
      seed: of both draws.

    Raises:
      SceneError: all views have one elevation, or there are too few for the share.
    """
    pool, heights = np.asarray(scene.pool), elevations(scene, scene.pool)
    if np.ptp(heights) < LEAST_SPREAD:
        raise SceneError(
            f"{scene.name}: pool.kind: 'unbalanced' needs a pool of several elevations, but all "
            f"{len(pool)} views have one: use another kind"
        )
    bands = np.array_split(pool[np.argsort(heights, kind="stable")], len(BANDS))
    crowd = bands.pop(crowded_band(seed))
    per_other = 2.0 * share / (1.0 - share)
    num_other = min(int(len(crowd) / per_other + 1e-9), *map(len, bands))
    if num_other < 1:
        raise SceneError(
            f"{scene.name}: pool.share: of {share:g} takes {int(np.ceil(per_other))} views in a "
            f"third of the pool, which has {len(crowd)}: give a smaller share, or more views"
        )
    rng = np.random.default_rng([seed, len(pool)])
    counts = [min(round(num_other * per_other), len(crowd)), num_other, num_other]
    kept = [rng.permutation(np.sort(band))[:n] for band, n in zip((crowd, *bands), counts)]
    return dataclasses.replace(scene, pool=np.sort(np.concatenate(kept)))


def arc(scene: Scene, *, degrees: float, seed: int) -> Scene:
    """A scene in which runs begin with views of one side; candidates are everywhere.

    The seed draws a view of the pool. Runs begin with views whose azimuth around `up`, seen from
    the scene's focus, is within `degrees / 2` of that view's, so that no two are more than
    `degrees` apart. Views straight above or below have no azimuth and are not among them.

    Args:
      degrees: width of the arc, above 0 to 360.
      seed: draws where it is.

    Raises:
      SceneError: the whole pool is straight above or below.
    """
    pool = np.asarray(scene.pool)
    for middle in np.random.default_rng(seed).permutation(pool):
        inside = np.abs(azimuths(scene, pool, middle)) <= np.radians(degrees) / 2.0
        if inside.any():
            return dataclasses.replace(scene, start=pool[inside])
    raise SceneError(
        f"{scene.name}: pool.kind: 'arc' needs views around the scene, but all {len(pool)} of the "
        "pool are straight above or below it: use another kind"
    )


def _across_and_above(scene: Scene, view_ids) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of cameras from the scene's focus, along the horizon [n, 3] and along `up` [n]."""
    positions = np.asarray(scene.cameras.positions, np.float64)[np.asarray(view_ids, int)]
    focus = focus_point(scene.cameras.world_from_cam, scene.centre)
    offsets, up = positions - focus, np.asarray(scene.up, np.float64)
    above = offsets @ up
    return offsets - above[:, None] * up, above
