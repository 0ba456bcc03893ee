"""CF-NeRF's loss against loops and integrals, at extremes, and in a fit of one pixel."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.stats import gaussian_kde

from bavs_jax.fields.flow_field import FlowOptions, base_draws, make_flow_field
from bavs_jax.fields.hash_grid import HashGridOptions
from bavs_jax.models.losses import (
    colour_likelihood_loss,
    flow_loss,
    kernel_bandwidth,
    kernel_log_density,
    mean_log_prob,
)
from tests.oracles_flows import kernel_log_density_loop


def some_draws(num_draws=8, num_rays=5, seed=0):
    rng = np.random.default_rng(seed)
    draws = rng.uniform(size=(num_draws, num_rays, 3)).astype(np.float32)
    return jnp.asarray(draws), jnp.asarray(rng.uniform(size=(num_rays, 3)), jnp.float32)


def test_kernel_density_agrees_with_a_loop():
    draws, target = some_draws()
    bandwidth = kernel_bandwidth(draws)
    got = kernel_log_density(draws, target, bandwidth)
    want = [kernel_log_density_loop(draws[:, r], target[r], bandwidth[r]) for r in range(5)]
    np.testing.assert_allclose(got, want, rtol=1e-5)  # float32


def test_kernel_density_agrees_with_scipy_for_one_free_channel():
    """Where the other channels of all draws are the truth, they factor out."""
    draws, target = some_draws()
    draws = draws.at[..., 1:].set(target[:, 1:])
    bandwidth = jnp.full((5, 3), 0.1)
    flat = 2 * np.log(1.0 / (0.1 * np.sqrt(2 * np.pi)))
    for ray in range(5):
        values = np.asarray(draws[:, ray, 0], np.float64)
        kde = gaussian_kde(values, bw_method=0.1 / values.std(ddof=1))
        want = np.log(kde(target[ray, 0])[0]) + flat
        got = kernel_log_density(draws, target, bandwidth)[ray]
        np.testing.assert_allclose(got, want, rtol=1e-5)  # float32


def test_kernel_density_integrates_to_1():
    draws, _ = some_draws(num_rays=1)
    bandwidth = kernel_bandwidth(draws)
    num, low, high = 200_000, -2.0, 3.0
    target = jax.random.uniform(jax.random.key(0), (num, 3), minval=low, maxval=high)
    wide = jnp.broadcast_to(draws, (8, num, 3))
    values = (high - low) ** 3 * np.exp(kernel_log_density(wide, target, bandwidth))
    error = values.std() / np.sqrt(num)
    assert error < 0.02
    np.testing.assert_allclose(values.mean(), 1.0, atol=4 * error)  # four standard errors


def test_bandwidth_is_silvermans_and_the_codes_is_wider():
    draws, _ = some_draws(num_draws=32)
    std = np.asarray(draws, np.float64).std(0, ddof=1)
    right = kernel_bandwidth(draws, floor=0.0)
    # Silverman in d = 3: (4 / ((d + 2) n))^(1 / (d + 4)).
    np.testing.assert_allclose(right, std * 32 / 31 * (4 / (5 * 32)) ** (1 / 7), rtol=1e-5)
    code = kernel_bandwidth(draws, exponent=-1 / 7, floor=0.0)
    np.testing.assert_allclose(code / right, (32 / 0.8) ** (2 / 7), rtol=1e-5)
    np.testing.assert_allclose(kernel_bandwidth(draws), right + 1e-5, rtol=1e-5)
    assert (jax.grad(lambda x: kernel_bandwidth(x).sum())(draws) == 0).all()
    with pytest.raises(ValueError, match="at least 2"):
        kernel_bandwidth(draws[:1])


def test_loss_weighs_rays():
    draws, target = some_draws()
    each = -kernel_log_density(draws, target, kernel_bandwidth(draws))
    weight = jnp.array([1.0, 0.0, 2.0, 0.0, 0.5])
    want = (each * weight).sum() / 3.5
    np.testing.assert_allclose(colour_likelihood_loss(draws, target, weight), want, rtol=1e-6)
    assert colour_likelihood_loss(draws, target, jnp.zeros(5)) == 0.0


def test_equal_draws_far_from_the_truth_are_pulled_to_it():
    draws, target = jnp.full((8, 2, 3), 0.9), jnp.array([[0.1] * 3, [0.9] * 3])
    loss, grad = jax.value_and_grad(colour_likelihood_loss)(draws, target, jnp.ones(2))
    assert np.isfinite(loss) and np.isfinite(grad).all()
    assert (grad[:, 0] > 0).all()  # downhill is towards the darker truth
    np.testing.assert_allclose(grad[:, 1], 0.0, atol=1e-6)
    mild = jax.grad(partial(colour_likelihood_loss, floor=0.1))(draws, target, jnp.ones(2))
    # Two rays, eight draws alike: (0.9 - 0.1) / 0.1^2 / 16.
    np.testing.assert_allclose(mild[:, 0], 0.8 / 0.01 / 16, rtol=1e-4)


def test_mean_log_prob_is_over_valid_samples_alone():
    log_prob = jnp.arange(12.0).reshape(2, 2, 3)
    mask = jnp.array([[True, False, True], [False, False, True]])
    np.testing.assert_allclose(mean_log_prob(log_prob, mask), np.mean([0, 2, 5, 6, 8, 11]))
    assert mean_log_prob(log_prob, jnp.zeros((2, 3), bool)) == 0.0
    wild = log_prob.at[:, 0, 1].set(jnp.inf)  # an empty slot
    grad = jax.grad(mean_log_prob)(wild, mask)
    np.testing.assert_allclose(grad, jnp.where(mask, 1 / 6, 0.0) * jnp.ones((2, 1, 1)))


def test_loss_is_the_sum_of_its_terms():
    draws, target = some_draws()
    log_prob = jax.random.normal(jax.random.key(0), (8, 5, 4))
    mask = jnp.ones((5, 4), bool)
    got = flow_loss(draws, target, jnp.ones(5), log_prob, mask, entropy_weight=0.3, exponent=-1 / 7)
    likelihood = colour_likelihood_loss(draws, target, jnp.ones(5), exponent=-1 / 7)
    np.testing.assert_allclose(got, likelihood + 0.3 * log_prob.mean(), rtol=1e-6)


# --- a fit -------------------------------------------------------------------------------------

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)
POINTS = jnp.array([[-0.6, -0.6, -0.6], [0.6, 0.6, 0.6]])  # seen, and never seen
DIRECTIONS = jnp.array([[0.0, 0.0, 1.0]] * 2)
NUM_DRAWS, FLOOR = 16, 0.003
FIELD = make_flow_field(
    BOX,
    HashGridOptions(num_levels=1, finest=4, width=16, direction_degree=1),
    FlowOptions(condition_features=16, num_flows=2),
)


@jax.jit
def fit(colours, entropy_weight):
    """Colours [512, 2, 3] of both points, after training on one, seen in any of `colours` [R, 3].

    The second point is never seen, but counts in the entropy.
    """
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-2, 400))
    start = FIELD.init(jax.random.key(0))
    ones = jnp.ones(len(colours)), jnp.ones(2, bool)

    def draw(params, key, num_draws):
        noise = base_draws(key, num_draws)
        _, rgb, extra = jax.vmap(partial(FIELD.apply, params, POINTS, DIRECTIONS))(noise)
        return rgb, extra["log_prob"]

    def loss(params, key):
        rgb, log_prob = draw(params, key, NUM_DRAWS)
        seen = jnp.repeat(rgb[:, :1], len(colours), axis=1)
        weights = {"entropy_weight": entropy_weight, "floor": FLOOR}
        return flow_loss(seen, colours, ones[0], log_prob, ones[1], **weights)

    def step(state, key):
        params, opt_state = state
        updates, opt_state = optimiser.update(jax.grad(loss)(params, key), opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    keys = jax.random.split(jax.random.key(1), 400)
    (params, _), _ = jax.lax.scan(step, (start, optimiser.init(start)), keys)
    return draw(params, jax.random.key(2), 512)[0]


@pytest.mark.parametrize("std", [0.05, 0.15])
def test_one_pixel_learns_the_spread_of_what_it_sees(std):
    rng = np.random.default_rng(0)
    red = np.concatenate([rng.normal(0.4, 0.3 * std, 32), rng.normal(0.4, std, 32)])
    colours = np.stack([red, red[::-1], 1.0 - red], axis=-1).astype(np.float32)
    seen = fit(colours, 0.01)[:, 0]
    np.testing.assert_allclose(seen.mean(0), colours.mean(0), atol=0.3 * std)
    # 3 in 10: the kernels stand for a part of the spread, which takes 2 in 10 off the draws', and
    # the entropy adds some to it.
    np.testing.assert_allclose(seen.std(0), colours.std(0), rtol=0.3)


def test_entropy_keeps_spread_where_nothing_is_seen():
    colours = np.full((64, 3), 0.3, np.float32)
    with_entropy, without = fit(colours, 0.01), fit(colours, 0.0)
    for drawn in (with_entropy, without):
        np.testing.assert_allclose(drawn[:, 0].mean(0), 0.3, atol=0.01)
        assert float(drawn[:, 0].std(0).max()) < 0.01
    # The base is shared: with no reward for spread it narrows everywhere once one point is known.
    assert float(without[:, 1].std(0).max()) < 0.01
    # An even colour has a spread of 0.289; two flows cannot widen the narrowed base that far.
    assert float(with_entropy[:, 1].std(0).min()) > 0.1
