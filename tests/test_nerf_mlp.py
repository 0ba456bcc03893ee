"""The paper's network, its encodings over cones, and coarse-to-fine sampling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Field
from bavs_jax.fields.nerf_mlp import NerfMlpOptions, make_mlp_density, make_nerf_mlp_field
from bavs_jax.fields.positional import (
    cone_variance,
    frustum_variance,
    integrated_encoding,
    positional_encoding,
)
from bavs_jax.rendering.coarse_to_fine import make_coarse_to_fine_sampler
from bavs_jax.rendering.samplers import dense_samples
from bavs_jax.rendering.spacing import box_intervals
from tests.oracles_unbounded import frustum_draws
from tests.toy_fields import rays_through

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)


def test_encoding_is_the_formula():
    x = np.array([[0.3, -0.7, 0.1]])
    got = np.asarray(positional_encoding(jnp.asarray(x), 3))
    phases = np.concatenate([2.0**k * np.pi * x[0] for k in range(3)])
    want = np.concatenate([np.sin(phases), np.cos(phases)])
    np.testing.assert_allclose(got[0], want, atol=1e-6)


def test_integrated_encoding_is_the_mean_over_draws():
    mean = np.array([0.2, -0.5, 0.9])
    variance = np.array([1e-3, 1e-2, 0.1])
    num = 40_000
    draws = mean + np.sqrt(variance) * np.random.default_rng(0).normal(size=(num, 3))
    got = integrated_encoding(jnp.asarray(mean), jnp.asarray(variance), 5)
    encoded = np.asarray(positional_encoding(jnp.asarray(draws), 5))
    # Four standard errors; entries have at most a variance of 1.
    np.testing.assert_allclose(got, encoded.mean(0), atol=4 / np.sqrt(num))
    assert float(jnp.abs(got).max()) > 0.5


def test_integrated_encoding_of_a_point_is_the_plain_one_and_of_a_wide_cone_is_0():
    x = jax.random.uniform(jax.random.key(0), (5, 3))
    zero = integrated_encoding(x, jnp.zeros((5, 3)), 6)
    np.testing.assert_allclose(zero, positional_encoding(x, 6), atol=1e-6)
    np.testing.assert_allclose(integrated_encoding(x, jnp.full((5, 3), 1e6), 6), 0.0, atol=1e-9)
    grads = jax.grad(lambda v: integrated_encoding(x, v, 16).sum())(jnp.full((5, 3), 1e12))
    assert np.isfinite(grads).all()


@pytest.mark.parametrize("t_start, t_end", [(2.0, 2.5), (0.0, 1.0), (0.5, 6.0)])
def test_frustum_variance_is_that_of_draws(t_start, t_end):
    num = 200_000
    draws = frustum_draws(np.random.default_rng(0), t_start, t_end, 0.1, num)
    along, across = frustum_variance(
        jnp.float32(0.5 * (t_start + t_end)), jnp.float32(t_end - t_start), 0.1
    )
    # A variance of bounded draws is known to about 1.5 / sqrt(num); five of these.
    np.testing.assert_allclose(along, draws[:, 2].var(), rtol=5 * 1.5 / np.sqrt(num))
    np.testing.assert_allclose(across, draws[:, 0].var(), rtol=5 * 1.5 / np.sqrt(num))


def test_cone_variance_along_an_axis():
    rays = Rays(jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, 1.0]]))
    samples = dense_samples(jnp.full((1, 1), 2.0), jnp.full((1, 1), 0.5), jnp.zeros(1, bool))
    along, across = frustum_variance(jnp.float32(2.0), jnp.float32(0.5), 0.01)
    got = cone_variance(rays, samples, 0.01)
    np.testing.assert_allclose(got[0, 0], [across, across, along], rtol=1e-5)


@pytest.mark.parametrize("contracted, pixel_radius", [(False, None), (True, None), (False, 0.01)])
def test_network_gives_colours_and_densities(contracted, pixel_radius):
    options = NerfMlpOptions(depth=6, width=16)
    field = make_nerf_mlp_field(BOX, options, contracted=contracted, pixel_radius=pixel_radius)
    params = field.init(jax.random.key(0))
    rays = rays_through(jax.random.key(1), 4)
    samples = dense_samples(jnp.full((4, 2), 2.0), jnp.full((4, 2), 0.5), jnp.zeros(4, bool))
    inputs = {k: x.reshape(8, -1) for k, x in field.inputs(rays, samples).items()}
    assert set(inputs) == (set() if pixel_radius is None else {"variance"})
    x = jax.random.uniform(jax.random.key(2), (8, 3), minval=-2, maxval=2)
    d = jnp.repeat(rays.directions, 2, axis=0)
    density, rgb = field.apply(params, x, d, **inputs)
    assert density.shape == (8,) and rgb.shape == (8, 3)
    assert (density > 0).all() and (rgb >= 0).all() and (rgb <= 1).all()
    np.testing.assert_allclose(density, field.density(params, x, **inputs), rtol=1e-6)
    grads = jax.grad(lambda p: sum(y.sum() for y in field.apply(p, 1e6 * x, d, **inputs)))(params)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(grads))


def test_network_has_the_papers_shape():
    params = jax.eval_shape(make_nerf_mlp_field(BOX).init, jax.random.key(0))
    widths = [params["trunk"][f"Dense_{i}"]["kernel"].shape for i in range(8)]
    assert widths == [(60, 256), *[(256, 256)] * 4, (316, 256), *[(256, 256)] * 2]
    assert params["colour_hidden"]["kernel"].shape == (256 + 24, 128)


def test_cones_in_contracted_space_are_refused():
    with pytest.raises(ValueError, match="pixel_radius"):
        make_mlp_density(BOX, contracted=True, pixel_radius=0.01)


def ball_field():
    """A ball of radius 1/2 whose density and colour are scaled by the parameters."""

    def apply(params, x, d):
        inside = jnp.linalg.norm(x, axis=-1) < 0.5
        return params * 30.0 * inside, jnp.full((len(x), 3), 0.25)

    return Field(
        init=lambda key: jnp.float32(1.0), apply=apply, density=lambda p, x: apply(p, x, x)[0]
    )


def test_fine_samples_gather_where_the_coarse_field_found_matter():
    sampler = make_coarse_to_fine_sampler(
        ball_field(),
        lambda rays: box_intervals(rays, BOX, near=0.0, far=10.0),
        background=jnp.ones(3),
        num_coarse=16,
        num_fine=32,
    )
    params = sampler.init(jax.random.key(0))
    rays = Rays(jnp.array([[-3.0, 0.1, 0.0], [0.0, 5.0, 0.0]]), jnp.array([[1.0, 0, 0]] * 2))
    for key in (None, jax.random.key(1)):
        samples, aux = jax.jit(sampler.sample)(key, params, {}, rays)
        t = np.asarray(samples.t_mids[0])
        assert (np.diff(t) >= 0).all() and len(t) == sampler.num_slots == 48
        np.testing.assert_allclose(samples.deltas.sum(-1), [2.0, 0.0], atol=1e-5)
        assert not samples.sample_mask[1].any()  # misses the box
        # The ball's front lies at t = 2.51; light is gone within a fifth of a unit behind it.
        assert ((t > 2.3) & (t < 2.9)).sum() >= 30
        np.testing.assert_allclose(aux["rgb"][0], 0.25, atol=0.02)
        np.testing.assert_allclose(aux["rgb"][1], 1.0)
    grad = jax.grad(
        lambda p: sampler.loss(
            sampler.sample(None, p, {}, rays)[1], None, None, lambda rgb: jnp.square(rgb).sum()
        )
    )(0.01 * params)
    assert np.isfinite(grad) and grad < 0  # more matter, less of the white background
