"""The raw Jacobian sum against dense references, and its weightings against closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.fields.deformation import (
    DeformationGrid,
    displace,
    interpolate,
    surrounding_vertices,
    trilinear,
    vertex_number,
)
from bavs_jax.rendering.compositing import composite, render_weights
from bavs_jax.rendering.occupancy import init_occupancy
from bavs_jax.rendering.sampling import make_march_options, march
from bavs_jax.uncertainty.curvature import add_jac_sq_sum, vertex_squares, weight_jacobian
from tests.oracles_curvature import (
    colour_terms,
    defined_jacobian,
    dense_jacobian,
    split_jacobian,
    trilinear_loop,
)
from tests.toy_fields import rays_through, smooth_field_fn

BOX = np.array([[-1.0, -1.2, -0.8], [1.0, 1.1, 0.9]])
BACKGROUND = np.array([1.0, 0.9, 0.8])


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def setting(num_rays=6, log2_cells=2, num_steps=24, num_slots=16):
    """Some rays with their samples and a small grid; made inside of the test's precision."""
    grid = DeformationGrid(jnp.asarray(BOX), log2_cells)
    rays = rays_through(jax.random.key(0), num_rays)
    options = make_march_options(BOX, near=0.0, far=10.0, num_steps=num_steps, num_slots=num_slots)
    occupancy = init_occupancy(BOX, resolution=4)
    occupancy = occupancy.replace(box=jnp.asarray(BOX))
    return grid, rays, jax.jit(march)(rays, occupancy, options)


@partial(jax.jit, static_argnames=("weighting", "jacobian_fn"))
def raw_sum(grid, rays, samples, jacobian_fn=split_jacobian, **kwargs):
    zero = jnp.zeros((grid.num_vertices, 3))
    terms = colour_terms(jacobian_fn, smooth_field_fn, rays, samples, background=BACKGROUND)
    return add_jac_sq_sum(zero, terms, grid, **kwargs)


@pytest.mark.parametrize("log2_cells", [1, 2, 3])
def test_trilinear_agrees_with_a_loop(x64, log2_cells):
    grid = DeformationGrid(jnp.asarray(BOX), log2_cells)
    inside = jax.random.uniform(jax.random.key(1), (20, 3), minval=-1.4, maxval=1.4)
    points = np.concatenate([inside, BOX, [[0.0, 0.0, 0.0]]])  # outside, faces and inner vertices
    rows, b = trilinear(grid, jnp.asarray(points))
    for point, point_rows, point_b in zip(points, rows, b):
        want = {
            int(vertex_number(grid, np.array(vertex))): weight
            for vertex, weight in trilinear_loop(BOX, grid.cells, point).items()
        }
        got = dict(zip(point_rows.tolist(), point_b.tolist()))
        assert got.keys() == want.keys()
        for row in want:
            np.testing.assert_allclose(got[row], want[row], atol=1e-12)


def test_displacement_is_linear_inside_and_exact_on_vertices(x64):
    grid = DeformationGrid(jnp.asarray(BOX), 2)
    axes = [np.linspace(BOX[0, d], BOX[1, d], grid.cells + 1) for d in range(3)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    linear = np.array([[0.3, -1.0, 0.5], [0.2, 0.1, 0.7], [-0.4, 0.6, 0.2]])
    theta = jnp.asarray(vertices @ linear + 0.25)
    points = jax.random.uniform(jax.random.key(2), (30, 3), minval=-0.7, maxval=0.7)
    # Trilinear interpolation reproduces affine functions; only rounding is left.
    np.testing.assert_allclose(displace(grid, theta, points), points @ linear + 0.25, atol=1e-12)
    np.testing.assert_allclose(displace(grid, theta, jnp.asarray(vertices)), theta, atol=1e-12)


def test_interpolation_equals_the_sum_over_weights(x64):
    grid = DeformationGrid(jnp.asarray(BOX), 2)
    values = jax.random.normal(jax.random.key(4), (grid.num_vertices,))
    points = jax.random.uniform(jax.random.key(5), (50, 3), minval=-1.3, maxval=1.3)
    rows, b = trilinear(grid, points)
    for power in (1, 2):
        want = (b**power * values[rows]).sum(-1)
        np.testing.assert_allclose(interpolate(grid, values, points, power=power), want, atol=1e-12)


def test_upper_faces_have_vertices_of_their_own():
    grid = DeformationGrid(jnp.asarray(BOX, jnp.float32), 3)
    corner = surrounding_vertices(grid, jnp.asarray(BOX[1:], jnp.float32))
    assert int(corner.max()) == 8
    assert int(vertex_number(grid, corner).max()) == grid.num_vertices - 1 == 9**3 - 1


def test_split_jacobian_equals_the_definition(x64):
    _, rays, samples = setting()
    plain = defined_jacobian(smooth_field_fn, rays, samples, background=BACKGROUND)
    split = split_jacobian(smooth_field_fn, rays, samples, background=BACKGROUND)
    assert float(jnp.abs(plain[0]).max()) > 0.01
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), split, plain)


@pytest.mark.parametrize("jacobian_fn", [defined_jacobian, split_jacobian])
def test_jacobian_agrees_with_central_differences(x64, jacobian_fn):
    _, rays, samples = setting(num_rays=2)
    jacobian, _ = jacobian_fn(smooth_field_fn, rays, samples, background=BACKGROUND)
    step = 1e-5
    for sample, axis in ((0, 0), (3, 1), (7, 2)):
        colours = []
        for sign in (1.0, -1.0):
            offset = jnp.zeros((*samples.t_mids.shape, 3)).at[:, sample, axis].set(sign * step)
            positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
            density, rgb = smooth_field_fn(
                positions + offset, jnp.broadcast_to(rays.directions[:, None], positions.shape)
            )
            colours.append(composite(render_weights(density, samples.deltas), rgb, BACKGROUND))
        # A central difference has an error of order step^2 times third derivatives of about 10.
        want = (colours[0] - colours[1]) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, sample, axis], want, atol=1e-8)


@pytest.mark.parametrize("jacobian_fn", [defined_jacobian, split_jacobian])
@pytest.mark.parametrize("log2_cells", [1, 2, 3])
def test_raw_sum_is_the_diagonal_of_the_dense_product(x64, log2_cells, jacobian_fn):
    grid, rays, samples = setting(log2_cells=log2_cells)
    dense = dense_jacobian(smooth_field_fn, grid, rays, samples, BACKGROUND)
    matrix = dense.reshape(-1, grid.num_vertices * 3)
    want = jnp.diag(matrix.T @ matrix).reshape(-1, 3)
    got = raw_sum(grid, rays, samples, jacobian_fn=jacobian_fn)
    assert float(want.max()) > 1e-3
    np.testing.assert_allclose(got, want, atol=1e-10)


def test_weightings_agree_with_the_dense_jacobian(x64):
    grid, rays, samples = setting()
    dense = dense_jacobian(smooth_field_fn, grid, rays, samples, BACKGROUND)
    target = jax.random.uniform(jax.random.key(3), (len(rays.origins), 3))
    _, rgb = defined_jacobian(smooth_field_fn, rays, samples, background=BACKGROUND)
    residual = rgb - target
    eps = jnp.square(residual).sum(-1)
    want_residual_weighted = jnp.einsum("r,rcvd->vd", eps, dense**2)
    want_empirical = jnp.square(jnp.einsum("rc,rcvd->rvd", residual, dense)).sum(0)
    got_residual_weighted = raw_sum(
        grid, rays, samples, target=target, weighting="residual_weighted"
    )
    got_empirical = raw_sum(grid, rays, samples, target=target, weighting="empirical_fisher")
    np.testing.assert_allclose(got_residual_weighted, want_residual_weighted, atol=1e-10)
    np.testing.assert_allclose(got_empirical, want_empirical, atol=1e-10)


def test_squaring_before_summing_gives_another_answer(x64):
    grid, rays, samples = setting()
    jacobian, _ = defined_jacobian(smooth_field_fn, rays, samples, background=BACKGROUND)
    positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
    rows, b = trilinear(grid, positions)
    each = jnp.square(b[:, None, :, :, None] * jacobian[:, :, :, None, :]).sum(1)
    wrong = jnp.zeros((grid.num_vertices, 3)).at[rows.reshape(-1)].add(each.reshape(-1, 3))
    right = raw_sum(grid, rays, samples)
    assert float(jnp.abs(wrong - right).max()) > 0.1 * float(right.max())


def test_one_ray_one_sample_by_hand(x64):
    """A lone sample at a cell's centre: every corner has weight 1/8, so g^2 is (a / 8)^2."""
    grid = DeformationGrid(jnp.array([[0.0, 0, 0], [2.0, 2, 2]]), 1)
    jacobian = jnp.array([[[1.0, 2.0, 3.0]], [[0.0, -1.0, 0.5]]])  # [C = 2, S = 1, 3]
    rows, added = vertex_squares(grid, jnp.array([[0.5, 0.5, 0.5]]), jacobian)
    assert len(set(rows.reshape(-1).tolist())) == 8
    want = np.square(np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]]) / 8).sum(0)
    np.testing.assert_allclose(added[0], np.tile(want, (8, 1)), atol=1e-15)


def test_the_empirical_fisher_tends_to_gauss_newton_and_residual_weighted_to_three_times_it(x64):
    """For e ~ N(0, I/2): E[e e^T] = I/2 and E|e|^2 = 3/2; factors 2, 4 and 4 make 1, 3 and 1."""
    jacobian = jax.random.normal(jax.random.key(5), (1, 3, 1, 3))
    gauss_newton = 2.0 * jnp.square(jacobian).sum()
    draws = 20_000
    residual = jax.random.normal(jax.random.key(6), (draws, 3)) * np.sqrt(0.5)
    repeated = jnp.repeat(jacobian, draws, axis=0)
    for weighting, factor in (("empirical_fisher", 1.0), ("residual_weighted", 3.0)):
        squares = 4.0 * jnp.square(weight_jacobian(repeated, residual, weighting)).sum((1, 2, 3))
        standard_error = squares.std() / np.sqrt(draws)
        # Four standard errors: a false alarm once in 16,000 seeds, and the seed is fixed.
        np.testing.assert_allclose(squares.mean(), factor * gauss_newton, atol=4 * standard_error)


def test_ray_order_and_padding_do_not_matter(x64):
    grid, rays, samples = setting()
    flip = jax.tree.map(lambda x: x[::-1], (rays, samples))
    np.testing.assert_allclose(raw_sum(grid, *flip), raw_sum(grid, rays, samples), atol=1e-13)
    half = jnp.arange(6) < 3
    first = jax.tree.map(lambda x: x[:3], (rays, samples))
    np.testing.assert_allclose(
        raw_sum(grid, rays, samples, ray_weight=half.astype(float)),
        raw_sum(grid, *first),
        atol=1e-13,
    )


def test_unknown_weighting_and_missing_residual_are_errors():
    with pytest.raises(ValueError, match="use one of gauss_newton"):
        weight_jacobian(jnp.ones((1, 3, 1, 3)), None, "eq12")
    with pytest.raises(ValueError, match="needs the colour residual"):
        weight_jacobian(jnp.ones((1, 3, 1, 3)), None, "residual_weighted")
