"""The Laplace posterior and the uncertainty channel in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.fields.deformation import DeformationGrid, displace, vertices_in_box
from bavs_jax.uncertainty.channel import (
    finish_uncertainty,
    make_uncertainty_channel,
    uncertainty_at,
    vertex_variance,
)
from bavs_jax.uncertainty.posterior import (
    default_prior_weight,
    laplace_variance,
    posterior_precision,
)

GRID = DeformationGrid(jnp.array([[-1.0, -1, -1], [1.0, 1, 1]]), 2)
POINTS = jax.random.uniform(jax.random.key(0), (20, 3), minval=-0.95, maxval=0.95)


def test_unseen_vertex_keeps_the_prior_variance():
    precision = posterior_precision(jnp.zeros((4, 3)), num_rays=10, prior_weight=0.25)
    np.testing.assert_allclose(laplace_variance(precision), 1.0 / (2 * 0.25))
    np.testing.assert_allclose(default_prior_weight(8), 1e-4 / 256**3)


def test_precision_is_the_hessian_of_the_regularised_loss():
    """For a colour linear in theta, loss = mean_r |g theta - y|^2 + lambda |theta|^2 exactly."""
    g = jax.random.normal(jax.random.key(1), (7, 3, 5))  # rays, channels, offsets
    y = jax.random.normal(jax.random.key(2), (7, 3))

    def loss(theta):
        residual = jnp.einsum("rcp,p->rc", g, theta) - y
        return jnp.square(residual).sum(-1).mean() + 0.3 * jnp.square(theta).sum()

    want = jnp.diag(jax.hessian(loss)(jnp.zeros(5)))
    got = posterior_precision(jnp.square(g).sum((0, 1)), num_rays=7, prior_weight=0.3)
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_more_rays_never_widen_the_posterior():
    before = jax.random.uniform(jax.random.key(3), (9, 3))
    after = before + jax.random.uniform(jax.random.key(4), (9, 3))
    kwargs = {"num_rays": 100, "prior_weight": 1e-3}
    wide = laplace_variance(posterior_precision(before, **kwargs))
    narrow = laplace_variance(posterior_precision(after, **kwargs))
    assert (narrow <= wide).all() and (narrow < wide).any()


def test_posterior_variant_is_the_spread_of_drawn_offsets():
    """sigma^2 is the summed variance of D_theta(x) over draws of theta from the posterior."""
    jac = jax.random.exponential(jax.random.key(5), (GRID.num_vertices, 3))
    kwargs = {"num_rays": 2, "prior_weight": 0.1}
    variance = laplace_variance(posterior_precision(jac, **kwargs))
    draws = 4000
    theta = jax.random.normal(jax.random.key(6), (draws, *jac.shape)) * jnp.sqrt(variance)
    offsets = jax.vmap(lambda t: displace(GRID, t, POINTS[:5]))(theta)
    want = offsets.var(0).sum(-1)
    summed = vertex_variance(jac, **kwargs, weighting="gauss_newton", variant="posterior")
    got = jnp.square(uncertainty_at(GRID, summed, POINTS[:5], variant="posterior"))
    # The relative standard error of a variance is sqrt(2 / draws) = 2.2 %; four of them.
    np.testing.assert_allclose(got, want, rtol=0.09)


def test_bayesrays_variant_interpolates_a_constant_exactly():
    variance = jnp.full(GRID.num_vertices, 4.0)
    got = uncertainty_at(GRID, variance, POINTS, variant="bayesrays")
    np.testing.assert_allclose(got, 2.0, rtol=1e-5)
    jac = jnp.full((GRID.num_vertices, 3), 2.0)
    vertex = vertex_variance(
        jac, num_rays=3, prior_weight=0.5, weighting="gauss_newton", variant="bayesrays"
    )
    np.testing.assert_allclose(vertex, 1.0 / (6.0 / 3 + 0.5), rtol=1e-6)


def test_posterior_variant_is_smallest_in_the_middle_of_a_cell():
    """Equal vertices: sum_k b_k^2 is 1 on a vertex and 1/8 in the middle of a cell."""
    variance = jnp.ones(GRID.num_vertices)
    points = jnp.array([[0.0, 0.0, 0.0], [0.25, 0.25, 0.25]])
    got = uncertainty_at(GRID, variance, points, variant="posterior")
    np.testing.assert_allclose(got, [1.0, np.sqrt(1 / 8)], rtol=1e-6)


@pytest.mark.parametrize("scale", ["log", "sigma"])
def test_empty_ray_has_no_uncertainty(scale):
    channel = make_uncertainty_channel(
        GRID, jnp.ones(GRID.num_vertices), variant="posterior", scale=scale
    )
    assert finish_uncertainty(jnp.float32(channel.floor), scale=scale) == 0.0


def test_log_scale_is_clipped_to_the_unit_interval():
    rendered = jnp.array([-9.0, -3.0, 1.5, 6.0, 99.0])
    np.testing.assert_allclose(
        finish_uncertainty(rendered, scale="log"), [0.0, 0.0, 0.5, 1.0, 1.0], rtol=1e-6
    )


@pytest.mark.parametrize("scale", ["log", "sigma"])
def test_what_lies_outside_of_the_box_counts_like_nothing(scale):
    grid = DeformationGrid(jnp.array([[-1.0] * 3, [1.0] * 3]), 2, contracted=True)
    variance = jnp.full(grid.num_vertices, 4.0)
    points = jnp.array([[0.9, 0.0, -0.9], [1.1, 0.0, 0.0], [0.0, 50.0, 0.0]])

    def values(extent):
        options = {"variant": "posterior", "scale": scale, "extent": extent}
        channel = make_uncertainty_channel(grid, variance, **options)
        return np.asarray(channel.value_fn(points, points)), channel.floor

    everywhere, floor = values("space")
    confined, _ = values("box")
    assert (everywhere > floor).all()
    np.testing.assert_array_equal(confined, [everywhere[0], floor, floor])


def test_the_vertices_in_the_box_are_the_middle_half():
    box = jnp.array([[-1.0] * 3, [1.0] * 3])
    inside = vertices_in_box(DeformationGrid(box, 2, contracted=True)).reshape(5, 5, 5)
    expected = np.zeros((5, 5, 5), bool)
    expected[1:4, 1:4, 1:4] = True
    np.testing.assert_array_equal(inside, expected)
    assert vertices_in_box(DeformationGrid(box, 2)).all()


def test_unknown_variant_and_scale_are_errors():
    with pytest.raises(ValueError, match="use one of posterior, bayesrays"):
        vertex_variance(
            jnp.ones((8, 3)), num_rays=1, prior_weight=1.0, weighting="gauss_newton", variant="x"
        )
    with pytest.raises(ValueError, match="use one of log, sigma"):
        make_uncertainty_channel(GRID, jnp.ones(8), variant="posterior", scale="x")
