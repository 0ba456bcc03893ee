"""Whether a camera could stand somewhere: outside of matter, clear of it, within bounds."""

import math

import numpy as np

from bavs_jax.arrays import DensityFn

NUM_DIRECTIONS = 128
SHELLS = (0.25, 0.5, 0.75, 1.05)  # of the clearance
REASONS = ("out of bounds", "inside matter", "too near to matter", "in unseen space")


def matter_density(half_length: float) -> float:
    """The density, 1 / scene unit, at which light is halved over `half_length` scene units.

    What is at least as dense counts as solid: `exp(-density half_length) = 1 / 2`.
    """
    return math.log(2.0) / half_length


def fibonacci_directions(num: int) -> np.ndarray:
    """Unit vectors [num, 3] spread evenly over the sphere, on a Fibonacci spiral."""
    z = 1.0 - (2.0 * np.arange(num) + 1.0) / num
    azimuth = np.pi * (3.0 - math.sqrt(5.0)) * np.arange(num)
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)


def ball_offsets() -> np.ndarray:
    """Where a ball of radius 1 is looked at, [K, 3], the centre first.

    The outermost shell lies 5 % beyond the radius, so that the points between two directions,
    which are at most some 15 degrees away from one, still reach matter at the radius itself.
    """
    directions = fibonacci_directions(NUM_DIRECTIONS)
    return np.concatenate([np.zeros((1, 3)), *(radius * directions for radius in SHELLS)])


def judge_positions(
    positions, density_fn: DensityFn, *, clearance: float, solid_density: float, chunk: int = 65536
) -> tuple[np.ndarray, np.ndarray]:
    """Which places lie inside of matter, and which others have matter within the clearance.

    Args:
      positions: [N, 3] scene units.
      clearance: radius that must be free, scene units.
      solid_density: density from which on there is matter, 1 / scene unit; see `matter_density`.
      chunk: points of one call of `density_fn`, the last ones filled up.

    Returns:
      is_inside [N] bool, is_near [N] bool; never both.

    Numerics: the ball is sampled; matter thinner than a quarter of the clearance can slip between
    two shells, though not through the outermost one.
    """
    positions = np.asarray(positions, np.float32)
    offsets = np.float32(clearance) * ball_offsets().astype(np.float32)
    points = (positions[:, None] + offsets).reshape(-1, 3)
    density = np.zeros(len(points), np.float32)
    for start in range(0, len(points), chunk):
        piece = points[start : start + chunk]
        filled = np.pad(piece, ((0, chunk - len(piece)), (0, 0)), mode="edge")
        density[start : start + chunk] = np.asarray(density_fn(filled))[: len(piece)]
    solid = density.reshape(len(positions), -1) >= solid_density
    is_inside = solid[:, 0]
    return is_inside, solid.any(axis=-1) & ~is_inside


def within_bounds(positions, bounds) -> np.ndarray:
    """Which places [N, 3] lie in a box [2, 3]; all of them where `bounds` is None."""
    if bounds is None:
        return np.ones(len(positions), bool)
    lower, upper = np.asarray(bounds, np.float64)
    positions = np.asarray(positions, np.float64)
    return ((positions >= lower) & (positions <= upper)).all(axis=-1)


def optical_depth(density_fn: DensityFn, starts, ends, *, num_samples: int = 64) -> np.ndarray:
    """Light lost between pairs of points, `integral density dt`, by the midpoint rule, [N] nats.

    Args:
      starts, ends: [N, 3] scene units.
      num_samples: of each way.
    """
    starts, ends = np.asarray(starts, np.float32), np.asarray(ends, np.float32)
    share = (np.arange(num_samples, dtype=np.float32) + 0.5) / num_samples
    points = starts[:, None] + share[:, None] * (ends - starts)[:, None]
    density = np.asarray(density_fn(points.reshape(-1, 3))).reshape(len(starts), num_samples)
    return density.mean(axis=-1) * np.linalg.norm(ends - starts, axis=-1)
