"""Flows against autodiff and bisection; the field of flows as a distribution and as a field."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.fields.flow_field import (
    FlowOptions,
    base_draws,
    make_flow_field,
    make_flow_mlp_field,
    positive_density,
    unit_colour,
)
from bavs_jax.fields.flows import apply_flows, flow_from_raw, num_flow_parameters
from bavs_jax.fields.hash_grid import HashGridOptions
from bavs_jax.fields.nerf_mlp import NerfMlpOptions
from tests.oracles_flows import invert_flows

BOX = np.array([[-1.0, -2.0, -1.0], [1.0, 2.0, 3.0]], np.float32)
NUM_FLOWS = 4

# Compiled once for all tests of one shape.
stack = jax.jit(apply_flows)
jacobian_of = jax.jit(jax.jacfwd(lambda flows, z: apply_flows(flows, z)[0], argnums=1))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def flows_of(seed, dim, *, scale=1.0, amplitude=2.0):
    """A stack of flows for one point, from random outputs of a network."""
    raw = np.random.default_rng(seed).normal(size=NUM_FLOWS * num_flow_parameters(dim))
    return flow_from_raw(
        jnp.asarray(scale * raw), dim=dim, num_flows=NUM_FLOWS, amplitude=amplitude
    )


# Two flows, so that both orders of the coordinates occur; each one more takes a second to compile.
SMALL = FlowOptions(condition_features=8, num_flows=2)


def small_field(*, contracted=False, **options):
    grid = HashGridOptions(num_levels=1, finest=32, log2_table_size=10, width=16)
    flow = dataclasses.replace(SMALL, **options)
    return make_flow_field(BOX, grid, flow, contracted=contracted)


def some_points(num):
    positions = jax.random.uniform(jax.random.key(1), (num, 3), minval=-1, maxval=1)
    directions = jax.random.normal(jax.random.key(2), (num, 3))
    return positions, directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)


# --- flows -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_log_determinant_is_that_of_the_jacobian(x64, dim):
    for seed in range(5):
        flows = flows_of(seed, dim)
        z = jnp.asarray(np.random.default_rng(100 + seed).normal(size=dim))
        jacobian = jacobian_of(flows, z)
        sign, want = np.linalg.slogdet(jacobian)
        assert sign == 1
        # float64; the determinant is a product of at most 12 slopes, none below 0.002.
        np.testing.assert_allclose(stack(flows, z)[1], want, rtol=1e-9, atol=1e-12)
        if dim > 1:
            assert np.abs(jacobian - np.diag(np.diag(jacobian))).max() > 1e-2  # coordinates mix


@pytest.mark.parametrize("dim", [1, 3])
def test_flows_are_the_identity_where_the_network_says_0(dim):
    raw = jnp.zeros((5, 2 * num_flow_parameters(dim)))
    z = jax.random.normal(jax.random.key(0), (dim, 5))

    @jax.jit
    def pull(raw):
        """Image, log-determinant, and the gradient of each one's sum."""
        out, back = jax.vjp(
            lambda raw: apply_flows(flow_from_raw(raw, dim=dim, num_flows=2), z), raw
        )
        ones, zeros = (jax.tree.map(lambda x, c=c: jnp.full_like(x, c), out) for c in (1.0, 0.0))
        return out, back((ones[0], zeros[1]))[0], back((zeros[0], ones[1]))[0]

    (image, log_det), *grads = pull(raw)
    np.testing.assert_array_equal(image, z)
    np.testing.assert_array_equal(log_det, 0.0)
    # Both shifts and slopes must have a gradient there, else no field could be learnt.
    assert all((jnp.abs(grad).max(-1) > 0.1).all() for grad in grads)


@pytest.mark.parametrize("dim", [1, 3])
@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_inverse_by_bisection_comes_back(x64, dim, scale):
    for seed in range(3):
        flows = flows_of(seed, dim, scale=scale)
        z = 2.0 * np.random.default_rng(200 + seed).normal(size=dim)
        image, log_det = stack(flows, jnp.asarray(z))
        # Rounding grows by the inverse's slope: 1 / 0.002^4 per coordinate at the worst, and the
        # steepest of these stacks, at a scale of 5, is near to it.
        atol = 1e-9 if scale == 1.0 else 1e-4
        np.testing.assert_allclose(invert_flows(*flows, image), z, atol=atol)
        assert np.isfinite(log_det)


@pytest.mark.parametrize("amplitude", [1.0, 2.0])
@pytest.mark.parametrize("extreme", [1.0, 100.0, 1e4])
def test_one_dimension_increases_and_moves_by_a_bounded_amount(x64, amplitude, extreme):
    z = jnp.linspace(-20.0, 20.0, 4001)
    for seed in range(5):
        flows = flows_of(seed, 1, scale=extreme, amplitude=amplitude)
        image = stack(jax.tree.map(lambda x: x[..., None], flows), z[None])[0][0]
        assert (jnp.diff(image) > 0).all()
        assert float(jnp.abs(image - z).max()) <= NUM_FLOWS * amplitude


@pytest.mark.parametrize("dim", [1, 3])
def test_flows_at_extremes_are_finite_with_their_gradients(dim):
    num = NUM_FLOWS * num_flow_parameters(dim)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(20, num))
    raw = jnp.asarray(1e4 * signs, jnp.float32)

    def total(raw, z):
        moved, log_det = apply_flows(flow_from_raw(raw, dim=dim, num_flows=NUM_FLOWS), z)
        return moved.sum() + log_det.sum()

    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    for z in (0.0, 1e-6, 1.0, 1e4):
        value, grads = both(raw, jnp.full((dim, 20), z))
        assert np.isfinite(value) and all(np.isfinite(grad).all() for grad in grads)


def test_flows_of_many_points_are_those_of_each():
    raw = jax.random.normal(jax.random.key(0), (6, NUM_FLOWS * num_flow_parameters(3)))
    z = jax.random.normal(jax.random.key(1), (3, 6))

    def one(raw, z):
        return apply_flows(flow_from_raw(raw, dim=3, num_flows=NUM_FLOWS), z)

    together = jax.jit(one)(raw, z)
    alone = jax.vmap(one, in_axes=(0, 1), out_axes=(1, 0))(raw, z)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), together, alone)


# --- the field as a distribution ---------------------------------------------------------------


def test_log_prob_is_the_change_of_variables_from_noise_to_density_and_colour(x64):
    field, params = made("hash_grid")
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), params)
    positions, directions = some_points(4)
    noise = base_draws(jax.random.key(4), 1)[0]

    def point(noise):
        density, rgb, _ = field.apply(params, positions, directions, noise)
        return jnp.concatenate([density[:, None], rgb], axis=-1)  # [4 points, 4]

    _, want = np.linalg.slogdet(jax.jit(jax.jacfwd(point))(noise))
    normal = -0.5 * (np.square(noise).sum() + 4 * np.log(2 * np.pi))
    got = jax.jit(field.apply)(params, positions, directions, noise)[2]["log_prob"]
    # float64, but the box and the unit coordinates that the field is read at are float32.
    np.testing.assert_allclose(got, normal - want, rtol=1e-6)
    assert np.ptp(got) > 0.1


def test_density_of_the_density_integrates_to_1(x64):
    flows = jax.tree.map(lambda x: x[..., None], flows_of(2, 1))
    z = jnp.linspace(-9.0, 9.0, 20_001)
    raw, log_det = stack(flows, z[None])
    density, log_slope = positive_density(raw[0], 50.0)
    log_prob = -0.5 * (jnp.square(z) + jnp.log(2 * jnp.pi)) - log_det - log_slope
    # The trapezoid rule at 20,000 points; the tails beyond 9 hold 1e-19.
    np.testing.assert_allclose(np.trapezoid(jnp.exp(log_prob), density), 1.0, rtol=1e-5)
    assert float(jnp.abs(log_det).max()) > 0.5


def test_density_of_the_colour_integrates_to_1_over_the_cube(x64):
    flows = flows_of(1, 3, scale=0.5, amplitude=1.0)
    num = 2000
    colours = np.random.default_rng(0).uniform(size=(num, 3))
    start = np.stack([invert_flows(*flows, np.log(c) - np.log1p(-c)) for c in colours], axis=1)
    raw, log_det = stack(jax.tree.map(lambda x: x[..., None], flows), jnp.asarray(start))
    rgb, log_slope = unit_colour(raw)
    np.testing.assert_allclose(rgb.T, colours, atol=1e-9)
    base = -0.5 * (np.square(start) + np.log(2 * np.pi)).sum(0)
    density = np.exp(base - log_det - log_slope.sum(0))
    # Four standard errors of the mean over even draws; without the flows' determinant it is off.
    error = density.std() / np.sqrt(num)
    assert error < 0.07
    np.testing.assert_allclose(density.mean(), 1.0, atol=4 * error)
    without = np.exp(base - log_slope.sum(0)).mean()
    assert abs(without - 1.0) > 8 * error


def test_activations_are_safe_at_extremes():
    raw = jnp.array([-1e4, -50.0, 0.0, 50.0, 1e4])
    for fn in (partial(positive_density, scale=10.0), unit_colour):
        value, log_slope = fn(raw)
        assert np.isfinite(value).all() and np.isfinite(log_slope).all()
        slope = jax.vmap(jax.grad(lambda x, fn=fn: fn(x)[0]))(raw)
        # A sigmoid at 50 rounds to 1, and its slope of 2e-22 to 0.
        np.testing.assert_allclose(slope, jnp.exp(log_slope), rtol=1e-4, atol=1e-20)
        grads = jax.vmap(jax.grad(lambda x, fn=fn: fn(x)[1]))(raw)
        assert np.isfinite(grads).all() and float(jnp.abs(grads).max()) <= 1.0


def test_fresh_field_is_thin_and_has_the_spread_of_its_base():
    field = small_field(density_scale=10.0)
    params = jax.jit(field.init)(jax.random.key(0))
    apply = jax.jit(partial(field.apply, params, *some_points(10)))
    # The table starts at 1e-4, so the density's flows are the identity; softplus(0.5 - 4).
    noise = jnp.array([0.5, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(apply(noise)[0], 10.0 * np.log1p(np.exp(-3.5)), rtol=1e-2)
    low, high = (apply(jnp.full(4, x))[1] for x in (-1.0, 1.0))
    # sigmoid(+-1) is 0.27 and 0.73; the direction already steers the colour's flows a little.
    assert ((high - low) > 0.1).all() and abs(float((high - low).mean()) - 0.46) < 0.2


# --- the field as a field ----------------------------------------------------------------------


@cache
def made(kind):
    """A field and parameters off their start, where all flows are near the identity."""
    if kind == "mlp":
        field = make_flow_mlp_field(BOX, NerfMlpOptions(depth=6, width=16), SMALL)
    else:
        field = small_field(contracted=kind == "contracted")
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    rng = np.random.default_rng(3)
    return field, jax.tree.map(
        lambda x: np.asarray(0.3 * rng.normal(size=x.shape), np.float32), shapes
    )


@pytest.mark.parametrize("kind", ["hash_grid", "contracted", "mlp"])
def test_field_gives_densities_and_colours_of_each_draw(kind):
    field, params = made(kind)
    positions, directions = some_points(20)
    noise = base_draws(jax.random.key(4), 6, with_mean=True)
    apply = partial(field.apply, params, 3.0 * positions, directions)
    density, rgb, extra = jax.jit(jax.vmap(apply))(noise)
    assert density.shape == extra["log_prob"].shape == (6, 20) and rgb.shape == (6, 20, 3)
    assert (density > 0).all() and (rgb >= 0).all() and (rgb <= 1).all()
    assert np.isfinite(extra["log_prob"]).all()
    assert (density.std(0) > 0).all() and (rgb.std(0) > 0).all()
    # The last draw is the base's mean, at which samplers read the density.
    at_mean = jax.jit(field.density)(params, 3.0 * positions)
    np.testing.assert_allclose(density[-1], at_mean, rtol=1e-5)
    tables = [] if kind == "mlp" else params["trunk"]["encoding"].values()
    penalty = sum(np.square(table).mean() for table in tables)
    np.testing.assert_allclose(field.penalty(params), penalty, rtol=1e-5)


def test_density_does_not_depend_on_direction_nor_on_the_colours_noise():
    field, params = made("hash_grid")
    positions, directions = some_points(5)
    noise = base_draws(jax.random.key(4), 1)[0]
    apply = jax.jit(partial(field.apply, params, positions))
    density, rgb, _ = apply(directions, noise)
    turned = apply(-directions, noise)
    redrawn = apply(directions, noise.at[1:].add(1.0))
    for other in (turned, redrawn):
        np.testing.assert_array_equal(other[0], density)
        assert float(jnp.abs(other[1] - rgb).max()) > 1e-3


def test_field_has_finite_gradients_at_extremes():
    field, params = made("hash_grid")
    positions = jnp.concatenate([jnp.asarray(BOX), jnp.array([[1e6, -1e6, 0.0]])])
    directions = jnp.tile(jnp.array([[0.0, 1.0, 0.0]]), (3, 1))

    @jax.jit
    def grads(params, noise):
        def total(params):
            density, rgb, extra = field.apply(params, positions, directions, noise)
            return density.sum() + rgb.sum() + extra["log_prob"].sum()

        return jax.grad(total)(params)

    for scale in (1.0, 1e4):
        wild = dict(params)
        for name in ("density_flows", "colour_flows"):
            last = jax.tree.map(lambda x, scale=scale: scale * x, params[name]["Dense_1"])
            wild[name] = {**params[name], "Dense_1": last}
        for noise in (jnp.zeros(4), jnp.full(4, -8.0)):
            assert all(np.isfinite(x).all() for x in jax.tree.leaves(grads(wild, noise)))


def network_size(jaxpr) -> int:
    """Numbers that all matrix products and table reads of a program give."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("dot_general", "gather"):
            total += sum(variable.aval.size for variable in equation.outvars)
        inner = [x for x in jax.tree.leaves(equation.params) if hasattr(x, "jaxpr")]
        total += sum(network_size(x.jaxpr) for x in inner)
    return total


@pytest.mark.parametrize("kind", ["hash_grid", "mlp"])
def test_draws_share_one_reading_of_the_network(kind):
    field, params = made(kind)
    positions, directions = some_points(50)

    def size(num_draws):
        many = jax.vmap(lambda noise: field.apply(params, positions, directions, noise))
        return network_size(jax.make_jaxpr(many)(jnp.zeros((num_draws, 4))).jaxpr)

    assert size(8) == size(1) > 50 * 16


def test_base_draws_end_on_the_mean_when_asked():
    draws = base_draws(jax.random.key(0), 5)
    ended = base_draws(jax.random.key(0), 5, with_mean=True)
    np.testing.assert_array_equal(ended[:-1], draws[:-1])
    np.testing.assert_array_equal(ended[-1], 0.0)
    assert draws.shape == (5, 4) and (draws != 0).all()


def test_paper_sized_network():
    flow = FlowOptions(condition_features=64)
    field = make_flow_mlp_field(BOX, NerfMlpOptions(width=512), flow)
    shapes = jax.eval_shape(field.init, jax.random.key(0))
    widths = [shapes["trunk"][f"Dense_{i}"]["kernel"].shape for i in range(8)]
    assert widths == [(60, 512), *[(512, 512)] * 4, (572, 512), *[(512, 512)] * 2]
    flows = {name: shapes[name]["Dense_1"]["kernel"].shape for name in shapes if "flows" in name}
    assert flows == {"density_flows": (64, 4 * 3), "colour_flows": (64, 4 * 15)}
