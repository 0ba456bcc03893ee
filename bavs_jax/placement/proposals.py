"""Draws free camera poses: in the shell around a capture's cameras, or in a box."""

import numpy as np

from bavs_jax.cameras import look_at
from bavs_jax.placement.collect import PlacementError

MAX_LAPS = 64  # of drawing again what left the shell


def aim(positions, targets, up) -> np.ndarray:
    """Upright poses [N, 3, 4] at `positions` [N, 3] that look at `targets` [N, 3]."""
    return np.stack([look_at(p, t, up) for p, t in zip(positions, targets)])


def turned_targets(rng: np.random.Generator, positions, targets, degrees: float) -> np.ndarray:
    """Targets [N, 3] whose directions are turned by random angles about random axes.

    The angle is `|N(0, degrees)|`, its axis uniform at right angles to the direction; distances
    stay.
    """
    offsets = np.asarray(targets, np.float64) - positions
    distances = np.linalg.norm(offsets, axis=-1, keepdims=True)
    ahead = offsets / distances
    aside = rng.normal(size=offsets.shape)
    aside -= (aside * ahead).sum(axis=-1, keepdims=True) * ahead
    aside /= np.linalg.norm(aside, axis=-1, keepdims=True)
    angle = np.radians(degrees) * rng.normal(size=(len(offsets), 1))
    return positions + distances * (np.cos(angle) * ahead + np.sin(angle) * aside)


def shell_positions(
    rng: np.random.Generator, num: int, camera_positions, *, focus, up, spread: float
) -> tuple[np.ndarray, np.ndarray]:
    """Places between existing cameras and a little beside them, around what they look at.

    Two cameras are drawn, and a place between them on the arc around the focus (direction by
    spherical, distance by linear interpolation); then it is moved by normal noise. Places whose
    distance from the focus, or height along `up`, is outside of what the cameras span are drawn
    again.

    Args:
      num: N, how many.
      camera_positions: [V, 3] scene units, V >= 2.
      focus: [3] what the cameras look at, scene units.
      up: [3] unit.
      spread: standard deviation of the noise, as a share of the median distance from the focus.

    Returns:
      positions [N, 3] float64, and the two cameras [N, 2] int that each lies between.

    Raises:
      PlacementError: after many laps, too few places lie within the shell.
    """
    cameras = np.asarray(camera_positions, np.float64)
    focus, up = np.asarray(focus, np.float64), np.asarray(up, np.float64)
    distances = np.linalg.norm(cameras - focus, axis=-1)
    heights = cameras @ up
    noise = spread * np.median(distances)
    # Cameras on a perfect sphere or plane span nothing: leave them the noise.
    slack_distance = noise if np.ptp(distances) < noise else 0.0
    slack_height = noise if np.ptp(heights) < noise else 0.0
    places, pairs = np.zeros((0, 3)), np.zeros((0, 2), int)
    for _ in range(MAX_LAPS):
        pair = rng.integers(0, len(cameras), (num, 2))
        share = rng.uniform(size=num)
        place = focus + _between(cameras[pair] - focus, share)
        place += noise * rng.normal(size=(num, 3))
        distance, height = np.linalg.norm(place - focus, axis=-1), place @ up
        keep = (np.abs(distance - _middle(distances)) <= np.ptp(distances) / 2 + slack_distance) & (
            np.abs(height - _middle(heights)) <= np.ptp(heights) / 2 + slack_height
        )
        places = np.concatenate([places, place[keep]])
        pairs = np.concatenate([pairs, pair[keep]])
        if len(places) >= num:
            return places[:num], pairs[:num]
    raise PlacementError(
        f"candidates: only {len(places)} of {num} places lie in the shell of the cameras: "
        "change the spread, or draw from a box"
    )


def box_positions(rng: np.random.Generator, num: int, bounds) -> np.ndarray:
    """Places [num, 3] uniform in a box [2, 3], in the unit of the box."""
    lower, upper = np.asarray(bounds, np.float64)
    return rng.uniform(lower, upper, (num, 3))


def _middle(values: np.ndarray) -> float:
    return (values.min() + values.max()) / 2.0


def _between(offsets: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Offsets [N, 2, 3] from a centre to one [N, 3] between them, on the arc around it."""
    lengths = np.linalg.norm(offsets, axis=-1)
    units = offsets / np.maximum(lengths, 1e-12)[..., None]
    cosine = np.clip((units[:, 0] * units[:, 1]).sum(axis=-1), -1.0, 1.0)
    angle = np.arccos(cosine)
    # Beside equal and opposite directions the sine vanishes; those take the straight line.
    sine = np.sin(angle)
    straight = sine < 1e-6
    sine = np.where(straight, 1.0, sine)
    first = np.where(straight, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    second = np.where(straight, share, np.sin(share * angle) / sine)
    direction = first[:, None] * units[:, 0] + second[:, None] * units[:, 1]
    length = (1.0 - share) * lengths[:, 0] + share * lengths[:, 1]
    return length[:, None] * direction
