"""Which cells of the scene box hold matter: a decaying maximum of sampled densities."""

import jax
import jax.numpy as jnp
from flax import struct

from bavs_jax.arrays import DensityFn

WARMUP_UPDATES = 2


class Occupancy(struct.PyTreeNode):
    """A cubic grid over the scene box; rays only spend samples in occupied cells."""

    density: jax.Array  # [G^3] float32, decaying maximum of sampled density, 1 / scene unit
    occupied: jax.Array  # [G^3] bool
    box: jax.Array  # [2, 3] scene units
    num_updates: jax.Array  # [] int32

    @property
    def resolution(self) -> int:
        return round(self.occupied.shape[0] ** (1 / 3))


def init_occupancy(box, *, resolution: int) -> Occupancy:
    """All cells occupied: nothing is known yet, so nothing is skipped."""
    cells = resolution**3
    return Occupancy(
        density=jnp.zeros(cells),
        occupied=jnp.ones(cells, bool),
        box=jnp.asarray(box, jnp.float32),
        num_updates=jnp.int32(0),
    )


def cell_index(occupancy: Occupancy, positions: jax.Array) -> jax.Array:
    """Flat cell number of points [..., 3]; points outside of the box get the nearest cell."""
    res = occupancy.resolution
    lower, upper = occupancy.box
    cell = (positions - lower) * (res / (upper - lower))
    x, y, z = (jnp.clip(cell[..., d].astype(jnp.int32), 0, res - 1) for d in range(3))
    return (x * res + y) * res + z


def cell_centres(occupancy: Occupancy, index: jax.Array) -> jax.Array:
    """Middle of cells [K] as points [K, 3], scene units."""
    res = occupancy.resolution
    cell = jnp.stack([index // (res * res), (index // res) % res, index % res], axis=-1)
    lower, upper = occupancy.box
    return lower + (cell + 0.5) * ((upper - lower) / res)


def update_occupancy(
    key: jax.Array,
    occupancy: Occupancy,
    density_fn: DensityFn,
    *,
    num_samples: int,
    step_size: float,
    decay: float = 0.6,
    threshold: float = 0.01,
) -> Occupancy:
    """Looks at some random cells once more and marks what is opaque enough to matter.

    A sampled cell becomes `density <- max(decay * density, density_fn(x))` at a random point x in
    it. A cell is occupied where `density * step_size` (about its opacity) exceeds
    `min(threshold, mean)`; the mean keeps a young, thin field from vanishing.

    Args:
      num_samples: cells looked at, drawn without regard to what they held.
      step_size: sample spacing along rays, scene units.
      decay: how fast a maximum is forgotten, in (0, 1).
      threshold: opacity of one step below which a cell is skipped.
    """
    cell_key, point_key = jax.random.split(key)
    cells = occupancy.density.shape[0]
    index = jax.random.randint(cell_key, (num_samples,), 0, cells)
    side = (occupancy.box[1] - occupancy.box[0]) / occupancy.resolution
    jitter = jax.random.uniform(point_key, (num_samples, 3), minval=-0.5, maxval=0.5)
    sampled = density_fn(cell_centres(occupancy, index) + jitter * side)
    # A cell drawn twice takes the larger of its samples: decay once, then scatter-max.
    seen = jnp.zeros(cells, bool).at[index].set(True)
    density = jnp.where(seen, decay * occupancy.density, occupancy.density)
    density = density.at[index].max(sampled)
    opacity = density * step_size
    limit = jnp.minimum(threshold, opacity.mean())
    # The first looks at a fresh field say nothing: keep all cells until it has been trained.
    occupied = (opacity > limit) | (occupancy.num_updates < WARMUP_UPDATES)
    return occupancy.replace(
        density=density, occupied=occupied, num_updates=occupancy.num_updates + 1
    )
