"""Uncertainty of single rays: closed forms, slow references, and what an empty ray is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.numerics import opacity_or_empty, safe_divide, x_log_x
from bavs_jax.rendering.compositing import rendered_variance
from bavs_jax.uncertainty.measures import (
    colour_variance,
    ensemble_uncertainty,
    missing_density,
    ray_entropy,
    variance_reduction,
)
from tests import oracles_pixel as oracles

both_ways = pytest.mark.parametrize("by_opacity", [True, False])


def weights_of(seed, *, num_rays=20, num_samples=16):
    """Weights [R, S] of rays of all opacities, some samples empty."""
    rng = np.random.default_rng(seed)
    weights = rng.exponential(size=(num_rays, num_samples)) ** 3
    weights *= rng.uniform(size=weights.shape) < 0.7
    weights[:, 0] += 1e-3
    opacity = rng.uniform(0.05, 1.0, (num_rays, 1))
    return (opacity * weights / weights.sum(-1, keepdims=True)).astype(np.float32)


# --- numerics --------------------------------------------------------------------------------


def test_x_log_x_and_its_gradient_at_zero():
    x = jnp.array([0.0, 1e-40, 1e-30, 0.5, 1.0, 2.0])
    expected = [0.0, 0.0, 1e-30 * np.log(1e-30), 0.5 * np.log(0.5), 0.0, 2.0 * np.log(2.0)]
    np.testing.assert_allclose(x_log_x(x), expected, rtol=1e-6)
    slope = jax.vmap(jax.grad(x_log_x))(x)
    expected = [0.0, 0.0, 1.0 + np.log(1e-30), 1.0 + np.log(0.5), 1.0, 1.0 + np.log(2.0)]
    np.testing.assert_allclose(slope, expected, rtol=1e-6)


def test_a_share_of_next_to_nothing_is_zero_with_a_finite_gradient():
    weights = jnp.array([[0.0, 0.0], [1e-30, 1e-30], [2e-6, 2e-6], [0.3, 0.1]])
    np.testing.assert_array_equal(opacity_or_empty(weights)[:2], 0.0)

    def first_share(w):
        return safe_divide(w[0], opacity_or_empty(w))

    np.testing.assert_allclose(jax.vmap(first_share)(weights), [0.0, 0.0, 0.5, 0.75], rtol=1e-6)
    slope = jax.vmap(jax.grad(first_share))(weights)
    # d/dw_0 of w_0 / (w_0 + w_1) is w_1 / (w_0 + w_1)^2.
    np.testing.assert_allclose(slope[:, 0], [0.0, 0.0, 0.125e6, 0.625], rtol=1e-5)


# --- ray entropy -----------------------------------------------------------------------------


def test_entropy_closed_forms():
    weights = jnp.array(
        [[1.0, 0.0, 0.0, 0.0], [0.25] * 4, [0.5, 0.0, 0.5, 0.0], [0.2, 0.0, 0.0, 0]]
    )
    expected = [0.0, np.log(4.0), np.log(2.0), 0.0]
    np.testing.assert_allclose(ray_entropy(weights), expected, atol=1e-6)  # float32
    half = 0.5 * weights[:3]
    np.testing.assert_allclose(ray_entropy(half), 0.5 * np.array(expected[:3]), atol=1e-6)
    np.testing.assert_allclose(ray_entropy(half, by_opacity=False), expected[:3], atol=1e-6)


def test_entropy_against_the_slow_reference():
    weights = weights_of(0)
    expected = np.array([oracles.entropy(w) for w in weights])
    # Float32: terms of order 1 and opacities from 0.05 up.
    np.testing.assert_allclose(ray_entropy(weights, by_opacity=False), expected, atol=1e-5)
    np.testing.assert_allclose(ray_entropy(weights), weights.sum(-1) * expected, atol=1e-6)
    assert (expected <= np.log(16.0)).all()


@both_ways
def test_entropy_of_an_empty_ray_is_zero_with_a_finite_gradient(by_opacity):
    weights = jnp.zeros((3, 8)).at[1, 2].set(0.7).at[2].set(1e-9)

    def total(w):
        return ray_entropy(w, by_opacity=by_opacity).sum()

    value = ray_entropy(weights, by_opacity=by_opacity)
    assert value[0] == value[1] == 0.0 and 0.0 <= value[2] < 1e-7
    slope = jax.grad(total)(weights)
    assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[0], 0.0)


def test_fog_fades_out_of_the_entropy():
    """As published, fog of any thinness is as uncertain as a ray can be."""
    fog = jnp.full((1, 32), 1.0 / 32) * jnp.array([[1.0], [1e-2], [1e-4]])
    np.testing.assert_allclose(ray_entropy(fog, by_opacity=False), np.log(32.0), rtol=1e-4)
    expected = np.array([1.0, 1e-2, 1e-4]) * np.log(32.0)
    np.testing.assert_allclose(ray_entropy(fog), expected, rtol=1e-4)  # float32 of a difference


# --- ensembles -------------------------------------------------------------------------------


def test_ensemble_against_the_slow_reference():
    rng = np.random.default_rng(1)
    rgb, opacity = rng.uniform(size=(5, 12, 3)), rng.uniform(size=(5, 12))
    for r in range(12):
        spread = np.mean([np.mean((c - c.mean()) ** 2) for c in rgb[:, r].T])
        missing = (1.0 - opacity[:, r].mean()) ** 2
        ours = ensemble_uncertainty(jnp.asarray(rgb[:, r]), jnp.asarray(opacity[:, r]))
        published = ensemble_uncertainty(
            jnp.asarray(rgb[:, r]), jnp.asarray(opacity[:, r]), known_background=False
        )
        np.testing.assert_allclose(published, spread + missing, rtol=1e-5)  # float32
        np.testing.assert_allclose(ours, spread + opacity[:, r].max() * missing, rtol=1e-5)


def test_colour_variance_of_two_opposite_fields():
    rgb = jnp.stack([jnp.zeros((4, 3)), jnp.ones((4, 3))])
    np.testing.assert_allclose(colour_variance(rgb), 0.25)


def test_missing_density_says_who_sees_what():
    opacity = jnp.array([[0.0, 1.0, 1.0, 1e-3], [0.0, 1.0, 0.0, 1e-3]])  # two fields, four rays
    np.testing.assert_allclose(missing_density(opacity), [0.0, 0.0, 0.25, 0.001], rtol=3e-3)
    published = missing_density(opacity, known_background=False)
    np.testing.assert_allclose(published, [1.0, 0.0, 0.25, 1.0], rtol=3e-3)


def test_an_empty_image_is_certain_in_front_of_a_known_background():
    rgb, opacity = jnp.ones((3, 64, 3)), jnp.zeros((3, 64))
    np.testing.assert_array_equal(ensemble_uncertainty(rgb, opacity), 0.0)
    np.testing.assert_array_equal(ensemble_uncertainty(rgb, opacity, known_background=False), 1.0)


# --- ActiveNeRF ------------------------------------------------------------------------------


def test_variance_reduction_against_the_slow_reference():
    weights = weights_of(2)
    beta = np.random.default_rng(3).uniform(0.01, 2.0, weights.shape).astype(np.float32)
    expected = np.array([oracles.variance_reduction(w, b) for w, b in zip(weights, beta)])
    # Float32 sums of positive terms.
    np.testing.assert_allclose(variance_reduction(weights, beta, by_opacity=False), expected, 1e-5)
    np.testing.assert_allclose(
        variance_reduction(weights, beta), weights.sum(-1) * expected, rtol=1e-5
    )
    np.testing.assert_allclose(rendered_variance(weights, beta), (weights**2 * beta).sum(-1), 1e-5)


def test_one_opaque_sample_loses_half_of_its_variance():
    """The observation is as uncertain as what it tells about: 1 / (1 / b + 1 / b) = b / 2."""
    weights = jnp.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(variance_reduction(weights, jnp.array([3.0, 0.4, 5.0])), 0.2)


def test_equal_samples_share_one_observation():
    size = 8
    weights, beta = jnp.full((size,), 1.0 / size), jnp.full((size,), 0.5)
    # U = beta / S, hence each keeps S beta / (S + 1), and S samples lose S beta / (S + 1) in all.
    np.testing.assert_allclose(variance_reduction(weights, beta), 0.5 * size / (size + 1.0), 1e-6)


def test_small_gains_are_not_lost_to_cancellation():
    """Little weight on a large beta: in float32, `100.01 - 100.005` is wrong in its third digit."""
    weights, beta = jnp.array([1e-6, 1.0]), jnp.array([100.0, 0.01])
    expected = oracles.variance_reduction([1e-6, 1.0], [100.0, 0.01])
    np.testing.assert_allclose(variance_reduction(weights, beta), expected, rtol=1e-5)
    alone = 100.0**2 * 1e-12 / (0.01 + 100.0 * 1e-12)
    gain = variance_reduction(weights, beta) - variance_reduction(weights, beta.at[0].set(1e-9))
    np.testing.assert_allclose(gain, alone, rtol=1e-2)  # itself a difference, of 5e-3


@both_ways
def test_a_ray_that_meets_nothing_gains_nothing(by_opacity):
    weights = jnp.zeros((3, 8)).at[1].set(1e-6).at[2].set(1e-20)
    beta = jnp.full((3, 8), 0.3)

    def total(w, b):
        return variance_reduction(w, b, by_opacity=by_opacity).sum()

    assert variance_reduction(weights, beta, by_opacity=by_opacity)[0] == 0.0
    for slope in jax.grad(total, argnums=(0, 1))(weights, beta):
        np.testing.assert_array_equal(slope[0], 0.0)
        assert np.isfinite(slope).all()


def test_fog_fades_out_of_the_gain():
    thin = 1e-4 * jnp.full((8,), 1.0 / 8)
    beta = jnp.full((8,), 0.5)
    published = variance_reduction(thin, beta, by_opacity=False)
    np.testing.assert_allclose(published, 0.5 * 8 / 9, rtol=1e-5)
    np.testing.assert_allclose(variance_reduction(thin, beta), 1e-4 * published, rtol=1e-5)


@pytest.mark.parametrize("measure", ["entropy", "gain"])
def test_an_empty_image_scores_zero(measure):
    """The white background must not decide: a mean over rays sees only what is there."""
    weights = jnp.zeros((100, 16)).at[:3].set(weights_of(4)[:3])
    beta = jnp.full(weights.shape, 0.2)
    value = ray_entropy(weights) if measure == "entropy" else variance_reduction(weights, beta)
    assert (value[:3] > 0.0).all()
    np.testing.assert_array_equal(value[3:], 0.0)
