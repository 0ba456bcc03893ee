"""Encodings and the hash-grid field against loops, closed forms and extremes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.fields.encodings import interpolate_level, level_resolutions, spherical_harmonics
from bavs_jax.fields.hash_grid import HashGridOptions, make_hash_grid_field
from bavs_jax.numerics import density_from_raw, safe_divide, safe_reciprocal
from tests.oracles_rendering import interpolate_level_loop

BOX = np.array([[-1.0, -2.0, -1.0], [1.0, 2.0, 3.0]], np.float32)


def test_levels_grow_from_coarsest_to_finest():
    levels = level_resolutions(8, 16, 128)
    assert levels[0] == 16 and levels[-1] == 128
    np.testing.assert_allclose(np.diff(np.log(levels)), np.log(8) / 7, atol=0.03)  # rounding


@pytest.mark.parametrize("rows", [6**3, 64])
def test_dense_and_hashed_levels_agree_with_a_loop(rows):
    table = jax.random.normal(jax.random.key(0), (rows, 2))
    points = np.concatenate(
        [jax.random.uniform(jax.random.key(1), (20, 3)), np.eye(3), [[1, 1, 1]]]
    )
    got = interpolate_level(table, jnp.asarray(points), 5)
    want = [interpolate_level_loop(table, p, 5) for p in points]
    np.testing.assert_allclose(got, want, atol=1e-5)  # float32


@pytest.mark.parametrize("rows", [6**3, 64])
def test_the_gradient_of_a_level_adds_up_all_that_was_read_of_a_row(rows):
    table = jax.random.normal(jax.random.key(0), (rows, 2))
    points = jax.random.uniform(jax.random.key(1), (400, 3))
    cotangent = jax.random.normal(jax.random.key(2), (400, 2))
    level, pullback = jax.vjp(lambda table: interpolate_level(table, points, 5), table)
    (grad,) = pullback(cotangent)
    # The level is linear in its table; float32 sums of some 2000 products.
    np.testing.assert_allclose((grad * table).sum(), (level * cotangent).sum(), rtol=1e-4)
    other = jax.random.normal(jax.random.key(3), (rows, 2))
    expected = (interpolate_level(other, points, 5) * cotangent).sum()
    np.testing.assert_allclose((grad * other).sum(), expected, rtol=1e-4)


def test_the_last_cell_owns_its_upper_face():
    table = jax.random.normal(jax.random.key(0), (6**3, 2))

    def slope(x):
        return jax.jacobian(lambda x: interpolate_level(table, x[None], 5)[0])(x)

    # A level is linear along each axis of a cell, so nothing changes up to its face.
    for axis in np.eye(3):
        face = np.array([0.3, 0.5, 0.7]) * (1 - axis) + axis
        inside = slope(jnp.asarray(face - 0.1 * axis)) @ axis
        np.testing.assert_allclose(slope(jnp.asarray(face)) @ axis, inside, rtol=1e-4)


def test_hashed_level_is_continuous_across_cells_and_in_range():
    table = jax.random.normal(jax.random.key(0), (256, 2))  # far fewer rows than vertices
    x = jnp.linspace(0.1, 0.9, 4001)
    line = jnp.stack([x, jnp.full_like(x, 0.37), 1.0 - x], axis=-1)
    values = interpolate_level(table, line, 40)
    assert np.isfinite(values).all()
    # Two axes move by 0.008 cells a step, and a table entry is below 4: no jump can exceed this.
    assert float(jnp.abs(jnp.diff(values, axis=0)).max()) < 2 * 0.008 * 8.0


def test_spherical_harmonics_are_orthonormal():
    num = 200_000
    directions = jax.random.normal(jax.random.key(0), (num, 3))
    directions /= jnp.linalg.norm(directions, axis=-1, keepdims=True)
    basis = spherical_harmonics(directions, 4)
    gram = 4.0 * np.pi * (basis.T @ basis) / num
    # Monte-Carlo: entries have a standard error below 4 pi max|y|^2 / sqrt(num) = 0.03; most less.
    np.testing.assert_allclose(gram, np.eye(16), atol=0.05)
    for degree in (1, 2, 3):
        np.testing.assert_array_equal(
            spherical_harmonics(directions[:5], degree), basis[:5, : degree**2]
        )
    with pytest.raises(ValueError, match="degree must be"):
        spherical_harmonics(directions, 5)


def test_field_gives_colours_densities_and_agrees_with_its_density():
    field = make_hash_grid_field(BOX, HashGridOptions(num_levels=3, finest=32, log2_table_size=10))
    params = field.init(jax.random.key(0))
    x = jax.random.uniform(jax.random.key(1), (50, 3), minval=-3, maxval=4)
    d = jnp.tile(jnp.array([[0.0, 0.0, 1.0]]), (50, 1))
    density, rgb = field.apply(params, x, d)
    assert density.shape == (50,) and rgb.shape == (50, 3)
    assert (density >= 0).all() and (rgb >= 0).all() and (rgb <= 1).all()
    np.testing.assert_allclose(density, field.density(params, x), rtol=1e-6)


def test_density_does_not_depend_on_direction_but_colour_does():
    field = make_hash_grid_field(BOX, HashGridOptions(num_levels=2, finest=32, log2_table_size=10))
    params = field.init(jax.random.key(0))
    x = jnp.zeros((1, 3))
    one = field.apply(params, x, jnp.array([[0.0, 0.0, 1.0]]))
    other = field.apply(params, x, jnp.array([[1.0, 0.0, 0.0]]))
    assert one[0] == other[0]
    assert float(jnp.abs(one[1] - other[1]).max()) > 1e-4


def test_gradients_are_finite_far_outside_and_at_corners():
    field = make_hash_grid_field(BOX, HashGridOptions(num_levels=2, finest=32, log2_table_size=10))
    params = field.init(jax.random.key(0))
    x = jnp.concatenate([jnp.asarray(BOX), jnp.array([[1e6, -1e6, 0.0]])])
    d = jnp.tile(jnp.array([[0.0, 1.0, 0.0]]), (3, 1))

    def total(params, x):
        density, rgb = field.apply(params, x, d)
        return density.sum() + rgb.sum()

    grads = jax.grad(total, argnums=(0, 1))(params, x)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


def test_density_activation_is_clipped_and_can_come_down():
    raw = jnp.array([-80.0, 0.0, 12.0, 1e4])
    value, grad = density_from_raw(raw), jax.vmap(jax.grad(density_from_raw))(raw)
    np.testing.assert_allclose(value, np.exp([-80.0, 0.0, 12.0, 12.0]), rtol=1e-5)
    np.testing.assert_allclose(grad, value)


def test_safe_division_and_reciprocal():
    assert safe_divide(jnp.float32(3.0), jnp.float32(0.0)) == 0.0
    assert jax.grad(safe_divide, argnums=1)(3.0, 0.0) == 0.0
    np.testing.assert_allclose(safe_reciprocal(jnp.array([0.0, -0.0, 2.0])), [1e12, -1e12, 0.5])
