"""Encodings of positions and directions that let a small network fit fine detail."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from bavs_jax.numerics import materialize

# The hash primes of Mueller et al. 2022 (Eq 4); the first factor is 1 for cache coherence.
_PRIME_Y = np.uint32(2654435761)
_PRIME_Z = np.uint32(805459861)


def level_resolutions(num_levels: int, coarsest: int, finest: int) -> tuple[int, ...]:
    """Cells per side of each level, growing geometrically from `coarsest` to `finest`."""
    if num_levels == 1:
        return (finest,)
    growth = (finest / coarsest) ** (1.0 / (num_levels - 1))
    return tuple(round(coarsest * growth**level) for level in range(num_levels))


def _corner_rows(base, *, resolution: int, table_size: int) -> list[jax.Array]:
    """Rows [K] uint32 of each of eight corners, z fastest: numbered where that fits, else hashed.

    Args:
      base: [3, K] lowest corner of each cell, whole numbers.
      resolution: cells per side.
      table_size: rows of the table.
    """
    x, y, z = base.astype(jnp.uint32)
    corners = [(dx, dy, dz) for dx in (0, 1) for dy in (0, 1) for dz in (0, 1)]
    side = resolution + 1
    if side**3 <= table_size:
        row = (x * side + y) * side + z
        return [row + np.uint32((dx * side + dy) * side + dz) for dx, dy, dz in corners]
    xs, ys, zs = (x, x + 1), (y * _PRIME_Y, (y + 1) * _PRIME_Y), (z * _PRIME_Z, (z + 1) * _PRIME_Z)
    return [(xs[dx] ^ ys[dy] ^ zs[dz]) & np.uint32(table_size - 1) for dx, dy, dz in corners]


@jax.custom_vjp
def _read_rows(table: jax.Array, rows: list[jax.Array]) -> list[jax.Array]:
    """`table[row]` for each list of rows; rows are in range, which spares the bounds check.

    One gather per corner is several times faster than one [K, 8] gather. The gradient adds all
    corners into one table, where the derivative of separate gathers would fill a table for each
    and sum them: three times as slow in all.
    """
    return [table.at[row].get(mode="promise_in_bounds") for row in rows]


def _read_rows_fwd(table, rows):
    return _read_rows(table, rows), (rows, jnp.zeros_like(table))


def _read_rows_bwd(residual, cotangents):
    rows, total = residual
    for row, cotangent in zip(rows, cotangents):
        total = total.at[row].add(cotangent, mode="promise_in_bounds")
    return total, None


_read_rows.defvjp(_read_rows_fwd, _read_rows_bwd)


def interpolate_level(table: jax.Array, unit_positions: jax.Array, resolution: int) -> jax.Array:
    """Trilinear interpolation of one level: `sum_k b_k table[row(vertex_k)]`.

    Args:
      table: [T, F] features; T is `(resolution + 1)^3` (dense) or a power of two (hashed).
      unit_positions: [K, 3] in [0, 1].
      resolution: cells per side.

    Returns:
      [K, F] features. Differentiable forwards and in reverse with respect to positions, in reverse
      alone with respect to the table.
    """
    scaled = unit_positions.T * resolution
    # The last cell owns its upper face, so that 1.0 does not read a vertex outside of the grid.
    base = jnp.clip(jnp.floor(scaled), 0, resolution - 1)
    frac = scaled - base
    rows = _corner_rows(base, resolution=resolution, table_size=table.shape[0])
    values = _read_rows(table, rows)
    fx, fy, fz = frac[..., None]
    # Seven linear interpolations rather than eight weights: fewer products, also in reverse.
    edges = [_lerp(values[k], values[k + 4], fx) for k in range(4)]
    faces = [_lerp(edges[k], edges[k + 2], fy) for k in range(2)]
    return _lerp(faces[0], faces[1], fz)


def _lerp(a, b, t):
    return a + t * (b - a)


class HashEncoding(nn.Module):
    """Multi-resolution hash grid (Mueller et al. 2022): features of all levels side by side.

    Attributes:
      resolutions: cells per side of each level.
      features: features per vertex.
      log2_table_size: largest table of a level; coarser levels are stored densely.
    """

    resolutions: tuple[int, ...]
    features: int = 2
    log2_table_size: int = 16

    @nn.compact
    def __call__(self, unit_positions: jax.Array) -> jax.Array:
        levels = []
        unit_positions = materialize(unit_positions)
        for level, resolution in enumerate(self.resolutions):
            rows = min((resolution + 1) ** 3, 2**self.log2_table_size)
            table = self.param(
                f"level_{level}",
                lambda key, shape: jax.random.uniform(key, shape, minval=-1e-4, maxval=1e-4),
                (rows, self.features),
            )
            levels.append(interpolate_level(table, unit_positions, resolution))
        return jnp.concatenate(levels, axis=-1)


def spherical_harmonics(directions: jax.Array, degree: int) -> jax.Array:
    """Real spherical harmonics of unit directions up to `degree` - 1, [K, degree^2].

    Raises:
      ValueError: if `degree` is not 1, 2, 3 or 4.
    """
    if degree not in (1, 2, 3, 4):
        raise ValueError(f"spherical_harmonics: degree must be 1, 2, 3 or 4, got {degree}")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    basis = [jnp.full_like(x, 0.28209479177387814)]
    if degree > 1:
        c = 0.4886025119029199
        basis += [-c * y, c * z, -c * x]
    if degree > 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3.0 * z * z - 1.0),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if degree > 3:
        basis += [
            -0.5900435899266435 * y * (3.0 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5.0 * z * z - 1.0),
            0.3731763325901154 * z * (5.0 * z * z - 3.0),
            -0.4570457994644658 * x * (5.0 * z * z - 1.0),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3.0 * y * y),
        ]
    return jnp.stack(basis, axis=-1)
