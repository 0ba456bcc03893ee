"""Contraction, histograms along rays, spacing and proposals against loops and closed forms."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import DensityField
from bavs_jax.fields.contraction import contract, in_box, uncontract, unit_coordinates
from bavs_jax.fields.deformation import DeformationGrid
from bavs_jax.rendering.compositing import composite_colour, render_weights
from bavs_jax.rendering.histograms import (
    distortion_loss,
    interlevel_loss,
    overlapping_weight,
    sample_histogram,
    stratified_quantiles,
)
from bavs_jax.rendering.proposals import anneal_exponent, make_proposal_sampler
from bavs_jax.rendering.render import render_rays
from bavs_jax.rendering.samplers import dense_samples
from bavs_jax.rendering.spacing import SPACINGS, Interval, open_intervals
from bavs_jax.uncertainty.curvature import add_jac_sq_sum
from tests.oracles_curvature import colour_terms, defined_jacobian, dense_jacobian, split_jacobian
from tests.oracles_unbounded import (
    contract_loop,
    distortion_loop,
    interlevel_loop,
    inverse_cdf_loop,
)
from tests.toy_fields import rays_through, smooth_field_fn

BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], np.float32)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def points_near_and_far(num=300):
    directions = np.random.default_rng(0).normal(size=(num, 3))
    return (directions * np.geomspace(0.01, 1e4, num)[:, None]).astype(np.float32)


# --- contraction -----------------------------------------------------------------------------


def test_contraction_agrees_with_a_loop_and_stays_inside():
    points = points_near_and_far()
    got = np.asarray(contract(points))
    np.testing.assert_allclose(got, contract_loop(points), atol=1e-6)  # float32 of numbers below 2
    assert np.abs(got).max() <= 2.0
    inside = np.abs(points).max(-1) <= 1
    assert inside.any() and (got[inside] == points[inside]).all()


def test_uncontracting_undoes_contracting(x64):
    points = points_near_and_far().astype(np.float64)
    # 2 - |y| is about 1 / |x|: near |x| = 3e4 that costs the factor 3e4 of the 16 digits.
    np.testing.assert_allclose(uncontract(contract(jnp.asarray(points))), points, rtol=1e-10)


def test_contraction_is_continuous_across_the_box_and_never_stretches_by_over_4_thirds(x64):
    face = np.random.default_rng(1).uniform(-1, 1, (50, 3))
    face[np.arange(50), np.arange(50) % 3] = 1.0
    inner, outer = contract(face * (1 - 1e-9)), contract(face * (1 + 1e-9))
    np.testing.assert_allclose(inner, outer, atol=1e-8)
    jacobian = jax.vmap(jax.jacfwd(contract))(jnp.asarray(points_near_and_far(), jnp.float64))
    norm = jnp.abs(jacobian).sum(-1).max(-1)  # induced by the maximum norm
    # |2/n - 1/n^2| + (2/n - 2/n^2) = 4/n - 3/n^2 is largest at n = 3/2, where it is 4/3.
    assert 1.2 < float(norm.max()) <= 4 / 3 + 1e-12


def test_gradients_of_the_contraction_are_finite_everywhere():
    points = jnp.array([[0.0, 0, 0], [1.0, 1, 1], [-1.0, 0.5, 0], [1e12, -1e12, 3.0]])
    assert np.isfinite(jax.vmap(jax.jacrev(contract))(points)).all()


def test_unit_coordinates_put_the_box_into_the_middle_half():
    box = jnp.array([[-1.0, -2.0, 0.0], [3.0, 2.0, 8.0]])
    corners = unit_coordinates(box, box, contracted=True)
    np.testing.assert_allclose(corners, [[0.25] * 3, [0.75] * 3], atol=1e-6)
    plain = unit_coordinates(box, jnp.array([[9.0, 0.0, 4.0]]), contracted=False)
    np.testing.assert_allclose(plain, [[1.0, 0.5, 0.5]])
    far = unit_coordinates(box, jnp.array([[1e9, 0.0, 4.0]]), contracted=True)
    np.testing.assert_allclose(far, [[1.0, 0.5, 0.5]], atol=1e-6)


def test_the_box_ends_at_its_faces():
    box = jnp.array([[-1.0, -2.0, 0.0], [3.0, 2.0, 8.0]])
    middle, half = box.mean(0), 0.5 * (box[1] - box[0])
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        for share, inside in ((0.999, True), (1.001, False), (50.0, False)):
            unit = unit_coordinates(box, middle + share * axis * half, contracted=True)
            assert in_box(unit, contracted=True) == inside


# --- histograms ------------------------------------------------------------------------------


def histograms(num_rays=7, num=12, seed=0):
    rng = np.random.default_rng(seed)
    edges = np.sort(rng.uniform(size=(num_rays, num + 1)), axis=-1)
    weights = rng.exponential(size=(num_rays, num)) * (rng.uniform(size=(num_rays, num)) < 0.7)
    weights[:, 3] += 0.1
    return edges.astype(np.float32), weights.astype(np.float32)


def test_inverse_cdf_agrees_with_a_walk():
    edges, weights = histograms()
    places = np.asarray(stratified_quantiles(jax.random.key(0), 7, 20))
    got = sample_histogram(edges, weights, places)
    want = [inverse_cdf_loop(e, w, p) for e, w, p in zip(edges, weights, places)]
    np.testing.assert_allclose(got, want, atol=1e-5)  # float32 sums of twelve, over thin intervals
    assert (np.diff(got, axis=-1) >= 0).all()


def test_samples_of_a_histogram_fall_into_intervals_by_their_weight():
    edges = jnp.array([[0.0, 0.2, 0.7, 1.0]])
    weights = jnp.array([[1.0, 0.0, 3.0]])
    got = sample_histogram(edges, weights, stratified_quantiles(None, 1, 1000))
    counts = np.histogram(got[0], np.array([0.0, 0.2, 0.7, 1.0 + 1e-6]))[0]
    np.testing.assert_allclose(counts, [250, 0, 750], atol=1)


def test_places_are_even_and_jittered_as_one():
    np.testing.assert_allclose(stratified_quantiles(None, 2, 4), [[0.125, 0.375, 0.625, 0.875]] * 2)
    jittered = stratified_quantiles(jax.random.key(0), 100, 4)
    np.testing.assert_allclose(np.diff(jittered), 0.25, atol=1e-6)
    assert jittered.min() >= 0 and jittered.max() < 1 and jittered[:, 0].std() > 0.05


def test_losses_agree_with_loops():
    edges, weights = histograms(num=9)
    proposal_edges, proposal_weights = histograms(num=5, seed=1)
    got = interlevel_loss(proposal_edges, proposal_weights, edges, weights)
    rows = zip(proposal_edges, proposal_weights, edges, weights)
    want = [interlevel_loop(*row) for row in rows]
    assert max(want) > 0.01
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-6)  # float32, and 1e-7 on weights
    got = distortion_loss(edges, weights)
    want = [distortion_loop(e, w) for e, w in zip(edges, weights)]
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_a_proposal_that_bounds_the_field_costs_nothing():
    edges, weights = histograms()
    np.testing.assert_allclose(interlevel_loss(edges, weights, edges, weights), 0.0, atol=1e-10)
    whole = overlapping_weight(edges, weights, edges[:, :1], edges[:, -1:])
    np.testing.assert_allclose(whole[:, 0], weights.sum(-1), rtol=1e-6)


def test_intervals_that_only_touch_do_not_overlap():
    edges, weights = histograms()
    np.testing.assert_array_equal(
        overlapping_weight(edges, weights, edges[:, :-1], edges[:, 1:]), weights
    )


def test_distortion_of_one_interval_is_a_third_of_its_width_and_of_two_points_their_distance():
    assert distortion_loss(jnp.array([0.2, 0.8]), jnp.array([1.0])) == pytest.approx(0.2)
    edges = jnp.array([0.1, 0.1, 0.6, 0.6])
    # Two draws differ half of the time.
    got = distortion_loss(edges, jnp.array([0.5, 0.0, 0.5]))
    assert float(got) == pytest.approx(0.25)


def test_the_interlevel_loss_teaches_the_proposal_alone():
    edges, weights = histograms(num=9)
    proposal_edges, proposal_weights = histograms(num=5, seed=1)
    grads = jax.grad(
        lambda p, w: interlevel_loss(proposal_edges, p, edges, w).sum(), argnums=(0, 1)
    )(proposal_weights, weights)
    assert float(jnp.abs(grads[0]).max()) > 0 and not np.any(grads[1])


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1.0, 1e5])
def test_gradients_are_finite_at_extreme_weights(scale):
    edges, weights = histograms(num=5)

    def loss(w):
        return (interlevel_loss(edges, w, edges, w) + distortion_loss(edges, w)).sum()

    assert np.isfinite(jax.grad(loss)(scale * weights)).all()
    assert np.isfinite(
        sample_histogram(edges, scale * weights + 0.01, stratified_quantiles(None, 7, 6))
    ).all()


# --- spacing ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(SPACINGS))
def test_spacings_rise_from_near_to_far(name):
    interval = Interval(jnp.array([0.05, 0.5]), jnp.array([1000.0, 3.0]), unit=1.5, spacing=name)
    s = jnp.tile(jnp.linspace(0.0, 1.0, 33), (2, 1))
    t = np.asarray(interval.distance(s))
    assert (np.diff(t) > 0).all()
    np.testing.assert_allclose(t[:, 0], [0.05, 0.5], rtol=1e-4)
    # 1 / t at 1000 is a difference of numbers near 1 in float32.
    np.testing.assert_allclose(t[:, -1], [1000.0, 3.0], rtol=1e-3)
    warp, unwarp = SPACINGS[name]
    np.testing.assert_allclose(unwarp(warp(t[1])), t[1], rtol=1e-5)


def test_disparity_steps_are_even_in_inverse_distance():
    interval = Interval(jnp.array([0.5]), jnp.array([100.0]), spacing="disparity")
    t = interval.distance(jnp.linspace(0.0, 1.0, 9)[None])
    np.testing.assert_allclose(np.diff(1.0 / t[0]), np.full(8, (0.01 - 2.0) / 8), rtol=1e-4)


# --- proposals -------------------------------------------------------------------------------


def shell_density(radius=5.0):
    """Matter beyond a sphere around the origin: `params` scale it."""
    return DensityField(
        init=lambda key: jnp.float32(1.0),
        density=lambda params, x: params * 20.0 * (jnp.linalg.norm(x, axis=-1) > radius),
    )


def proposal_sampler(**kwargs):
    options = {"num_proposals": (32, 16), "num_samples": 12} | kwargs
    return make_proposal_sampler(
        [shell_density(), shell_density()],
        lambda rays: open_intervals(rays, near=0.05, far=100.0, unit=1.0),
        **options,
    )


def trusting(sampler, step=10_000):
    return sampler.update(jax.random.key(0), sampler.init_state(), None, jnp.int32(step))


def inside_rays(num=20):
    rays = rays_through(jax.random.key(1), num)
    return Rays(0.1 * rays.origins, rays.directions)


def test_proposals_lead_samples_to_the_surface():
    sampler, rays = proposal_sampler(), inside_rays()
    params = sampler.init(jax.random.key(0))
    assert len(params) == 2
    for key in (None, jax.random.key(3)):
        samples, aux = jax.jit(sampler.sample)(key, params, trusting(sampler), rays)
        positions = rays.origins[:, None] + samples.t_mids[..., None] * rays.directions[:, None]
        beyond = np.abs(np.linalg.norm(positions, axis=-1) - 5.0) < 0.6
        assert beyond.mean() > 0.7
        assert samples.sample_mask.all() and (samples.deltas >= 0).all() and samples.dense
        assert [w.shape for w in aux["weights"]] == [(20, 32), (20, 16)]
        assert (np.diff(aux["edges"][-1]) >= 0).all()


def test_proposals_are_not_trusted_at_first():
    assert anneal_exponent(0.0) == 0.0 and anneal_exponent(3.0) == 1.0
    sampler, rays = proposal_sampler(), inside_rays()
    params = sampler.init(jax.random.key(0))
    _, aux = jax.jit(sampler.sample)(None, params, sampler.init_state(), rays)
    np.testing.assert_allclose(np.diff(aux["edges"][-1]), 1 / 12, atol=1e-5)


def test_samples_carry_no_gradient_and_the_loss_teaches_proposals():
    sampler, rays = proposal_sampler(), inside_rays()
    params, state = sampler.init(jax.random.key(0)), trusting(sampler)

    def of_samples(params):
        samples, _ = sampler.sample(None, params, state, rays)
        return samples.t_mids.sum() + samples.deltas.sum()

    def of_loss(params):
        samples, aux = sampler.sample(None, params, state, rays)
        weights = jax.nn.softmax(-samples.t_mids)  # all on the first samples, against proposals
        return sampler.loss(aux, samples, weights, None)

    assert all(g == 0.0 for g in jax.tree.leaves(jax.jit(jax.grad(of_samples))(params)))
    grads = jax.tree.leaves(jax.jit(jax.grad(of_loss))([0.01 * p for p in params]))
    assert all(np.isfinite(g) and g != 0.0 for g in grads)


def test_a_missing_proposal_is_an_error():
    with pytest.raises(ValueError, match="num_proposals: 3 for 2"):
        proposal_sampler(num_proposals=(8, 8, 8))


# --- rendering and curvature without a box ---------------------------------------------------


def far_samples(rays, num=24):
    interval = open_intervals(rays, near=0.05, far=200.0, unit=1.0)
    t_edges = interval.distance(jnp.tile(jnp.linspace(0.0, 1.0, num + 1), (len(rays.origins), 1)))
    mids = 0.5 * (t_edges[:, 1:] + t_edges[:, :-1])
    return dense_samples(mids, jnp.diff(t_edges), interval.is_empty)


def test_last_sample_stands_for_what_lies_behind():
    weights = render_weights(jnp.array([[0.5, 1.0, 0.0]]), jnp.array([[1.0, 1.0, 1.0]]))
    rgb = jnp.array([[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]])
    colour = composite_colour(weights, rgb, None)
    opacity = float(weights.sum())
    np.testing.assert_allclose(colour[0, 2], 1.0 - opacity, rtol=1e-6)
    np.testing.assert_allclose(colour.sum(), 1.0, rtol=1e-6)


@pytest.mark.parametrize("capacity", [24, 50, 10_000])
def test_dense_samples_render_alike_in_any_number_of_groups(capacity):
    rays = inside_rays(7)
    samples = far_samples(rays)
    kwargs = {"background": None, "channels": {}}

    @partial(jax.jit, static_argnames=("capacity", "exact"))
    def render(samples, *, capacity, exact):
        return render_rays(rays, samples, smooth_field_fn, capacity=capacity, exact=exact, **kwargs)

    whole = render(samples, capacity=1, exact=False)
    parts = render(samples, capacity=capacity, exact=True)
    old = render(samples.replace(dense=False), capacity=64, exact=True)
    for other in (parts, old):
        np.testing.assert_allclose(whole.rgb, other.rgb, atol=1e-6)
        np.testing.assert_allclose(whole.depth, other.depth, rtol=1e-5)
    assert whole.ray_mask.all()


@pytest.mark.parametrize("jacobian_fn", [defined_jacobian, split_jacobian])
def test_curvature_in_contracted_space_is_the_diagonal_of_the_dense_product(x64, jacobian_fn):
    grid = DeformationGrid(jnp.asarray(BOX, jnp.float64), 2, contracted=True)
    rays = inside_rays(5)
    samples = far_samples(rays, 16)
    dense = jax.jit(lambda: dense_jacobian(smooth_field_fn, grid, rays, samples, None))()
    want = jnp.square(dense.reshape(-1, grid.num_vertices * 3)).sum(0).reshape(-1, 3)
    zero = jnp.zeros((grid.num_vertices, 3))
    got = jax.jit(
        lambda: add_jac_sq_sum(
            zero,
            colour_terms(jacobian_fn, smooth_field_fn, rays, samples, background=None),
            grid,
        )
    )()
    np.testing.assert_allclose(got, want, atol=1e-12 * float(want.max()))
    # Vertices on the outer faces stand for what is far away, and are seen.
    outer = np.zeros((5, 5, 5), bool)
    outer[[0, -1]] = True
    assert float(got[outer.reshape(-1)].max()) > 0
