"""The deformation field `D_theta`: offsets on the vertices of a grid, trilinear in between.

The grid is addressed in coordinates normalised to the scene box, or in contracted coordinates for
unbounded scenes; its offsets are added to positions in world space. `theta = 0` is the mode of the
posterior.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bavs_jax.fields.contraction import in_box, scene_positions, unit_coordinates

# The eight corners of a cell, [8, 3], z fastest.
CORNERS = np.indices((2, 2, 2), np.int32).reshape(3, 8).T


class DeformationGrid(struct.PyTreeNode):
    """`(2^L + 1)^3` vertices over the scene box, or over contracted space around it."""

    box: jax.Array  # [2, 3] scene units
    log2_cells: int = struct.field(pytree_node=False)  # L
    contracted: bool = struct.field(pytree_node=False, default=False)  # see `contraction.py`

    @property
    def cells(self) -> int:
        """Cells per side, `2^L`."""
        return 2**self.log2_cells

    @property
    def num_vertices(self) -> int:
        """G, `(2^L + 1)^3`: one more vertex than cells per side, so upper faces do not wrap."""
        return (self.cells + 1) ** 3


def grid_coordinates(grid: DeformationGrid, positions: jax.Array) -> jax.Array:
    """Positions [..., 3] in scene units, as cells `[0, 2^L]` (see `unit_coordinates`)."""
    return unit_coordinates(grid.box, positions, contracted=grid.contracted) * grid.cells


def unit_vertices(grid: DeformationGrid) -> np.ndarray:
    """Vertices in the unit cube [G, 3], in the order of `vertex_number`."""
    side = np.arange(grid.cells + 1) / grid.cells
    return np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)


def vertex_positions(grid: DeformationGrid) -> jax.Array:
    """Where the vertices are, [G, 3] scene units (see `scene_positions`)."""
    unit = jnp.asarray(unit_vertices(grid), jnp.float32)
    return scene_positions(grid.box, unit, contracted=grid.contracted)


def cell_sides(grid: DeformationGrid) -> np.ndarray:
    """Sides of a cell in the middle of the grid, [3] scene units: of all cells in the scene box."""
    unit = np.full((2, 3), 0.5, np.float32)
    unit[1] += 1.0 / grid.cells
    lower, upper = np.asarray(scene_positions(grid.box, unit, contracted=grid.contracted))
    return np.asarray(upper - lower, np.float64)


def offset_unit(box) -> jax.Array:
    """The length that the prior and the log scale measure offsets in, [] scene units.

    A third of the mean side of the scene box [2, 3], so that nothing depends on where a scene
    lies, or on how large it is. In the boxes of the Blender scenes and of most captures, which are
    3 units wide, it is the scene unit itself.
    """
    return (box[1] - box[0]).sum() / 9.0


def vertices_in_box(grid: DeformationGrid) -> jax.Array:
    """Which vertices lie in the scene box, [G] bool: all of them where space is not contracted."""
    return in_box(jnp.asarray(unit_vertices(grid)), contracted=grid.contracted)


def vertex_number(grid: DeformationGrid, vertex: jax.Array) -> jax.Array:
    """Row of integer vertices [..., 3] in arrays over the grid, z fastest."""
    side = grid.cells + 1
    return (vertex[..., 0] * side + vertex[..., 1]) * side + vertex[..., 2]


def surrounding_vertices(grid: DeformationGrid, positions: jax.Array) -> jax.Array:
    """The eight vertices of the cell around each position, integer coordinates [..., 8, 3]."""
    base = jnp.floor(grid_coordinates(grid, positions)).astype(jnp.int32)
    return jnp.minimum(base, grid.cells - 1)[..., None, :] + CORNERS


def trilinear_weights(grid: DeformationGrid, positions: jax.Array, vertices: jax.Array):
    """Weight of any vertices at any positions: `b = prod_d max(0, 1 - |u_d - v_d|)`.

    Args:
      positions: [..., 3] scene units.
      vertices: [..., 3] integer coordinates, broadcast against `positions`.

    Returns:
      [...] in [0, 1]; 0 for vertices that are not corners of the position's cell.
    """
    distance = jnp.abs(grid_coordinates(grid, positions) - vertices)
    hats = jnp.maximum(0.0, 1.0 - distance)
    # Not `prod(-1)`: a reduction over three, which XLA for CPUs does one by one.
    return hats[..., 0] * hats[..., 1] * hats[..., 2]


def corner_weights(grid: DeformationGrid, cells: jax.Array, positions: jax.Array) -> jax.Array:
    """Weight of the eight corners of each of some cells at each of some positions.

    As `trilinear_weights`, whose hat functions of one axis are shared here by four corners.

    Args:
      cells: [I, 3] integer coordinates of each cell's lowest corner.
      positions: [J, 3] scene units.

    Returns:
      [I, 8, J] in [0, 1]; 0 for corners that are not of the position's own cell.
    """
    u = grid_coordinates(grid, positions)

    def hats(axis):
        ends = cells[:, axis], cells[:, axis] + 1
        return [jnp.maximum(0.0, 1.0 - jnp.abs(u[:, axis] - end[:, None])) for end in ends]

    return jnp.stack([x * y * z for x in hats(0) for y in hats(1) for z in hats(2)], axis=1)


def trilinear(grid: DeformationGrid, positions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rows [..., 8] of the vertices around each position and their weights `b` [..., 8]."""
    vertices = surrounding_vertices(grid, positions)
    return vertex_number(grid, vertices), trilinear_weights(grid, positions[..., None, :], vertices)


def interpolate(grid: DeformationGrid, values: jax.Array, positions: jax.Array, *, power: int = 1):
    """`sum_k b_k^power values_k` over the eight vertices around each position, [...].

    One corner after another, which a CPU does several times faster than one [..., 8] gather.

    Args:
      values: [G] one number per vertex.
      positions: [..., 3] scene units.
      power: of the trilinear weights.
    """
    scaled = grid_coordinates(grid, positions)
    base = jnp.minimum(jnp.floor(scaled), grid.cells - 1)
    frac = scaled - base
    base = base.astype(jnp.int32)
    total: jax.Array | float = 0.0
    for corner in CORNERS:
        b = jnp.where(corner, frac, 1.0 - frac)
        b = b[..., 0] * b[..., 1] * b[..., 2]
        row = vertex_number(grid, base + corner)
        total += b**power * values.at[row].get(mode="promise_in_bounds")
    return total


def displace(grid: DeformationGrid, offsets: jax.Array, positions: jax.Array) -> jax.Array:
    """The offset at each position, `D_theta(x) = sum_k b_k theta_k`, [..., 3] scene units.

    Args:
      offsets: theta [G, 3], scene units.
      positions: [..., 3].
    """
    rows, b = trilinear(grid, positions)
    return (b[..., None] * offsets[rows]).sum(-2)
