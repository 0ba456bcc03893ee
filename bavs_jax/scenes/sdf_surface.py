"""Points spread evenly over the surface of a signed distance field."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

# A distance [...] of points [..., 3] to a surface, or a bound on it: 1-Lipschitz, negative inside.
SignedDistance = Callable[[jax.Array], jax.Array]


def value_and_gradient(
    signed_distance: SignedDistance, points: jax.Array, *, step: float
) -> tuple[jax.Array, jax.Array]:
    """A distance [K] at points [K, 3], and its gradient [K, 3] from the corners of a tetrahedron.

    `grad f = sum_k c_k f(p + step c_k) / (4 step)` with `c_k` in {-1, 1}^3. Reverse mode through
    many nested minima and maxima takes XLA minutes to compile; this compiles the distance once.
    """
    corners = jnp.array([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]], points.dtype)
    offsets = jnp.concatenate([jnp.zeros((1, 3), points.dtype), step * corners])
    values = jax.lax.map(lambda offset: signed_distance(points + offset), offsets)
    return values[0], (values[1:, :, None] * corners[:, None]).sum(0) / (4.0 * step)


def project_to_surface(
    signed_distance: SignedDistance, points: jax.Array, *, step: float, num_steps: int = 4
) -> tuple[jax.Array, jax.Array]:
    """Newton steps along the gradient, `p <- p - f grad f / |grad f|^2`.

    Args:
      points: [K, 3] near to the surface.
      step: of the differences that give the gradient; well below the size of what is there.
      num_steps: how many.

    Returns:
      points [K, 3], and how far each was from the surface at first, to first order,
      `|f| / |grad f|` [K]: an estimate that holds for a bound on the distance too.

    Numerics: 1e-12 is added to the squared gradient; it is 0 only where several parts are equally
    far, and such points do not arrive.
    """

    def newton(_, carry):
        points, first = carry
        value, slope = value_and_gradient(signed_distance, points, step=step)
        slope2 = jnp.square(slope).sum(-1) + 1e-12
        moved = points - (value / slope2)[:, None] * slope
        away = jnp.abs(value) / jnp.sqrt(slope2)
        return moved, jnp.where(jnp.isnan(first), away, first)

    unknown = jnp.full(points.shape[:1], jnp.nan, points.dtype)
    return jax.lax.fori_loop(0, num_steps, newton, (points, unknown))


def cells_near_surface(
    signed_distance: SignedDistance, box, *, band: float, cells: int
) -> np.ndarray:
    """Lower corners [M, 3] of those of `cells^3` equal cells that may hold points within `band`.

    A distance changes by no more than the way: no cell that holds one is left out.
    """
    lower, upper = np.asarray(box, np.float64)
    size = (upper - lower) / cells
    index = np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = lower + index * size
    centres = jnp.asarray(corners + 0.5 * size, jnp.float32)
    value = np.asarray(jax.jit(signed_distance)(centres))
    return corners[np.abs(value) <= band + 0.5 * np.linalg.norm(size)]


def sample_surface(
    key: jax.Array,
    signed_distance: SignedDistance,
    box,
    num: int,
    *,
    band: float,
    tolerance: float,
    cells: int = 64,
    chunk: int = 1 << 15,
) -> np.ndarray:
    """Points [N, 3] uniform over the area of a surface within a box.

    Points that are uniform in a thin shell around the surface are moved onto it: where the shell is
    equally thick, as many arrive on any two pieces of equal area. At edges and where the surface
    is curved with a radius near to `band` the density is off by a share of about `band / radius`.

    Args:
      box: [2, 3] that holds the surface.
      num: N, how many points.
      band: half thickness of the shell, unit of the box.
      tolerance: largest distance to the surface of what is returned.
      cells: per side of a grid; those far from the surface are not drawn from.
      chunk: points of one draw.

    Raises:
      ValueError: the box holds no surface, or the Newton steps do not arrive at it.
    """
    corners = cells_near_surface(signed_distance, box, band=band, cells=cells)
    size = (np.asarray(box[1], np.float64) - np.asarray(box[0], np.float64)) / cells
    if len(corners) == 0:
        raise ValueError("signed_distance: has no surface in the box: give a box that holds it")

    @jax.jit
    def draw(key, corners):
        which, where = jax.random.split(key)
        cell = corners[jax.random.randint(which, (chunk,), 0, len(corners))]
        points = cell + jax.random.uniform(where, (chunk, 3)) * size
        return points, signed_distance(points)

    @jax.jit
    def settle(points):
        moved, first = project_to_surface(signed_distance, points, step=0.1 * band)
        return moved, (first < band) & (jnp.abs(signed_distance(moved)) <= tolerance)

    cell_corners = jnp.asarray(corners, jnp.float32)
    # A shell is at least a thousandth of the cells around it, unless nothing arrives.
    most, count = 10 + 1000 * num // chunk, 0
    found: list[np.ndarray] = [np.zeros((0, 3), np.float32)]
    for number in range(most):
        drawn = draw(jax.random.fold_in(key, number), cell_corners)
        points, value = (np.asarray(x) for x in drawn)
        # A gradient of at most 1 makes |f| a lower bound of the first-order distance.
        near = points[np.abs(value) < band]
        # How many are near differs from draw to draw; padded to a power of two, few compile.
        padding = (1 << max(len(near) - 1, 0).bit_length()) - len(near)
        moved, is_there = settle(np.concatenate([near, np.zeros((padding, 3), np.float32)]))
        found.append(np.asarray(moved)[: len(near)][np.asarray(is_there)[: len(near)]])
        count += len(found[-1])
        if count >= num:
            return np.concatenate(found)[:num]
    raise ValueError(
        f"signed_distance: {count} of {num} points arrived within {tolerance} of its surface: "
        "give a larger tolerance"
    )
