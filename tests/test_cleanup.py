"""Clean-up by uncertainty: what goes and what stays, the measures, the choice of a threshold."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Rays
from bavs_jax.fields.base import Field
from bavs_jax.fields.deformation import DeformationGrid, offset_unit
from bavs_jax.metrics.covered import PixelSums, Sweep, is_empty, pixel_sums, sweep_of
from bavs_jax.uncertainty.channel import vertex_variance
from bavs_jax.uncertainty.cleanup import (
    choose_threshold,
    even_thresholds,
    make_cleaned_render_fn,
    make_point_uncertainty_fn,
    threshold_sigma,
)
from bavs_jax.uncertainty.curvature import add_jac_sq_sum
from tests.toy_fields import NOTHING_LEARNT, even_sampler, ray_model
from tests.traces import count_traces

BOX = jnp.array([[-1.0] * 3, [1.0] * 3])
GRID = DeformationGrid(BOX, 4)
BACKGROUND = np.ones(3, np.float32)
FLOATER, RADIUS = np.array([-0.5, 0.0, 0.0]), 0.15
WALL_FRONT, WALL_BACK = 0.3, 0.6


def matter(positions):
    """A wall across the x axis with a floater in front of it, 1 / scene unit."""
    x = positions[..., 0]
    wall = (x > WALL_FRONT) & (x < WALL_BACK)
    floater = jnp.linalg.norm(positions - FLOATER, axis=-1) < RADIUS
    return jnp.where(wall | floater, 60.0, 0.0)


def texture(positions):
    """Colour that varies along every axis alike, so that a shift in any direction is seen."""
    return 0.5 + 0.4 * positions


FIELD = Field(
    init=lambda key: {},
    apply=lambda params, x, d: (matter(x), texture(x)),
    density=lambda params, x: matter(x),
)


SAMPLER = even_sampler(near=1.5, far=4.5, num=60)
MODEL = ray_model(FIELD, SAMPLER, BACKGROUND, capacity=100_000)


def cleaned(field: Field, uncertainty_fn, threshold) -> Field:
    """The definition of what is cleaned: `sigma(x) [u(x) <= threshold]`, all else as it was."""

    def kept(positions, density):
        return jnp.where(uncertainty_fn(positions) > threshold, 0.0, density)

    def apply(params, positions, directions, **inputs):
        density, *rest = field.apply(params, positions, directions, **inputs)
        return kept(positions, density), *rest

    def density(params, positions, **inputs):
        return kept(positions, field.density(params, positions, **inputs))

    return field._replace(apply=apply, density=density)


def rays_between(starts, ends) -> Rays:
    directions = ends - starts
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Rays(jnp.asarray(starts, jnp.float32), jnp.asarray(directions, jnp.float32))


def rays_to_wall(num=3000, seed=0):
    """Rays onto the whole front of the wall, none of which meets the floater."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([np.full((num, 1), -2.2), rng.uniform(-1.5, 1.5, (num, 2))], -1)
    ends = np.concatenate([np.full((num, 1), WALL_FRONT), rng.uniform(-1, 1, (num, 2))], -1)
    rays = rays_between(starts, ends)
    along = np.sum((FLOATER - starts) * rays.directions, -1, keepdims=True)
    gap = np.linalg.norm(starts + along * rays.directions - FLOATER, axis=-1)
    return jax.tree.map(lambda x: x[gap > RADIUS + 0.02], rays)


def rays_to_floater(num=40, seed=1):
    """Rays that meet the floater first and the wall behind it."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([np.full((num, 1), -2.2), rng.uniform(-0.3, 0.3, (num, 2))], -1)
    return rays_between(starts, FLOATER + rng.uniform(-0.05, 0.05, (num, 3)))


@pytest.fixture(scope="module")
def variance():
    """What the training rays leave unknown, [G]."""
    rays = rays_to_wall()

    @jax.jit
    def raw_sum(rays):
        terms = MODEL.ray_terms(NOTHING_LEARNT, rays, most_points=MODEL.most_points)
        return add_jac_sq_sum(jnp.zeros((GRID.num_vertices, 3)), terms, GRID)

    return vertex_variance(
        raw_sum(rays),
        num_rays=len(rays.origins),
        prior_weight=1e-6,
        weighting="gauss_newton",
        variant="posterior",
    )


@pytest.fixture(scope="module")
def cleaned_fn():
    return make_cleaned_render_fn(MODEL, GRID, variant="posterior")


@pytest.fixture(scope="module")
def render(cleaned_fn, variance):
    return lambda thresholds, rays: jax.tree.map(
        np.asarray, cleaned_fn(NOTHING_LEARNT, variance, jnp.asarray(thresholds), rays)
    )


@pytest.fixture(scope="module")
def chosen(render, variance):
    """The sweep of the training rays and the threshold that the rule takes."""
    thresholds = even_thresholds(variance, 20, offset_unit(BOX))
    rays = rays_to_wall()
    images = render(thresholds, rays)
    truth = images["rgb"][:, -1]
    sweep = sweep_of(thresholds, [pixel_sums(images, truth, background=BACKGROUND)])
    return sweep, choose_threshold(sweep, rule="keep")


def test_floater_that_no_ray_saw_goes_and_wall_that_all_saw_stays(render, chosen):
    sweep, row = chosen
    assert row < len(sweep.thresholds) - 1, "the rule found something to remove"
    thresholds = sweep.thresholds[[row, -1]]
    images = render(thresholds, rays_to_floater())
    depth_of_floater, depth_of_wall = FLOATER[0] + 2.2, WALL_FRONT + 2.2
    # Within the radius of the ball and a step of 0.05; rays run at up to 15 degrees.
    np.testing.assert_allclose(images["depth"][:, 1], depth_of_floater, atol=RADIUS + 0.05)
    np.testing.assert_allclose(images["opacity"][:, 1], 1.0, atol=1e-3)
    still = images["opacity"][:, 0] > 0.5
    np.testing.assert_allclose(images["depth"][still, 0], depth_of_wall, atol=0.2)
    # The rule may take 1 % of the wall; behind the floater fewer rays have looked than elsewhere.
    assert still.mean() > 0.9
    wall = render(thresholds, rays_to_wall(seed=5))["opacity"]
    assert wall[:, 0].mean() > 0.97 * wall[:, 1].mean()


def test_training_views_keep_what_the_rule_promises(chosen):
    sweep, row = chosen
    assert sweep.content_kept[row] >= 0.99 and sweep.content_kept[row - 1] < 0.99
    # What was hidden behind a removed sample shows up, so opacity is lost more slowly (float32).
    assert sweep.opacity_kept[row] >= sweep.content_kept[row] - 1e-6
    assert sweep.psnr[row] > 30.0  # against the untouched render


def test_less_is_kept_the_lower_the_threshold(render, chosen):
    sweep, _ = chosen
    for name in ("content_kept", "opacity_kept", "share_covered"):
        # Opacities are sums of float32 weights: monotone but for their last digits.
        assert (np.diff(getattr(sweep, name)) >= -1e-6).all(), name
    assert sweep.share_covered[0] < 0.95 and sweep.share_covered[-1] == 1.0
    for rays in (rays_to_floater(), rays_to_wall(seed=3)):
        opacity = render(sweep.thresholds, rays)["opacity"]
        assert (np.diff(opacity, axis=1) >= -1e-6).all()


def test_an_infinite_threshold_changes_no_bit(render, variance):
    rays = rays_to_floater()

    @jax.jit
    def plain(rays):
        return MODEL.render(NOTHING_LEARNT, rays)

    @jax.jit
    def wrapped(rays, threshold):
        return cleaned_model(variance, threshold).render(NOTHING_LEARNT, rays)

    want, swept = plain(rays), render([0.4, np.inf], rays)
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(swept[name][:, 1], getattr(want, name))
        np.testing.assert_array_equal(getattr(wrapped(rays, jnp.inf), name), getattr(want, name))
    np.testing.assert_array_equal(swept["content"][:, 1], want.opacity)


def make_uncertainty_fn(variance):
    return make_point_uncertainty_fn(GRID, variance, variant="posterior")


def cleaned_model(variance, threshold):
    field = cleaned(FIELD, make_uncertainty_fn(variance), threshold)
    return dataclasses.replace(MODEL, field=field)


def test_all_thresholds_at_once_are_the_cleaned_field_rendered_for_each(render, variance, chosen):
    """The definition, `cleaned` through the renderer, against the shared evaluation."""
    sweep, row = chosen
    rays = rays_to_floater(8)

    @jax.jit
    def wrapped(threshold):
        return cleaned_model(variance, threshold).render(NOTHING_LEARNT, rays)

    thresholds = [*sweep.thresholds[[2, row]], np.inf]
    images = render(thresholds, rays)
    for i, threshold in enumerate(thresholds):
        want = wrapped(threshold)
        for name in ("rgb", "depth", "opacity"):
            np.testing.assert_allclose(images[name][:, i], getattr(want, name), atol=1e-6)


def test_cleaned_density_is_zero_above_the_threshold_alone(variance):
    points = jax.random.uniform(jax.random.key(2), (200, 3), minval=-1.0, maxval=1.0)
    uncertainty = make_uncertainty_fn(variance)(points)
    threshold = float(jnp.median(uncertainty))
    field = cleaned(FIELD, make_uncertainty_fn(variance), threshold)
    want = np.where(uncertainty > threshold, 0.0, matter(points))
    np.testing.assert_array_equal(field.density({}, points), want)
    np.testing.assert_array_equal(field.apply({}, points, points)[0], want)


def test_a_sweep_compiles_once(cleaned_fn, render, variance):
    rays = jax.tree.map(lambda x: x[:-1], rays_to_floater())  # as many as nothing else has
    with count_traces() as first_traces:
        render([0.1, 0.2, np.inf], rays)
    assert "render" in first_traces
    with count_traces() as traces:
        for low in (0.3, 0.5, 0.7):
            render([low, low + 0.1, np.inf], rays)
        jax.block_until_ready(cleaned_fn(NOTHING_LEARNT, 2.0 * variance, jnp.arange(3.0), rays))
    assert "render" not in traces


def test_thresholds_span_the_vertices_and_mean_a_length():
    thresholds = even_thresholds(100.0 * jnp.array([1e-4, 1.0, 1e8]), 5, 10.0)
    # log10 sigma in tens of units is -2, 0 and 4: 1/9, 3/9 and 7/9 on [0, 1].
    np.testing.assert_allclose(thresholds[:-1], np.linspace(1 / 9, 7 / 9, 5), rtol=1e-6)
    assert np.isposinf(thresholds[-1])
    np.testing.assert_allclose(threshold_sigma([1 / 9, 3 / 9], 10.0), [0.1, 10.0])


# --- the measures ---


def test_measures_of_four_pixels_by_hand():
    """One pixel each: right, wrong on matter, a floater over nothing, and an empty one."""
    truth = np.array([[0.0] * 3, [0.2] * 3, [1.0] * 3, [1.0] * 3])
    rgb = np.zeros((4, 2, 3))
    rgb[0], rgb[1], rgb[2, 1], rgb[3] = 0.0, 0.4, 0.6, 1.0
    rgb[2, 0] = 1.0  # the threshold takes the floater away
    opacity = np.array([[1.0, 1.0], [0.4, 0.9], [0.1, 0.8], [0.0, 0.0]])
    images = {"rgb": rgb, "opacity": opacity, "content": 0.5 * opacity}
    sums = pixel_sums(images, truth, background=[1.0, 1.0, 1.0])
    assert isinstance(sums, PixelSums)
    sweep = sweep_of([0.5, np.inf], [sums, sums])  # twice the same view changes nothing
    np.testing.assert_allclose(sweep.share_covered, [1 / 2, 1.0])
    np.testing.assert_allclose(sweep.share_floating, [0.0, 1 / 2])
    np.testing.assert_allclose(sweep.opacity_kept, [1.5 / 2.7, 1.0])
    np.testing.assert_allclose(sweep.content_kept, [1.5 / 2.7, 1.0])
    square = np.array([[0.0, 0.0], [0.04, 0.04], [0.0, 0.16], [0.0, 0.0]])
    # All these colours are whole numbers of 1/255, up to float32.
    np.testing.assert_allclose(sweep.psnr, -10 * np.log10(square.mean(0)), rtol=1e-5)
    covered = np.array([0.0, 0.2]) / np.array([1, 3])
    assert np.isposinf(sweep.psnr_covered[0])
    np.testing.assert_allclose(sweep.psnr_covered[1], -10 * np.log10(covered[1]), rtol=1e-5)
    assert np.isposinf(sweep.psnr_covered_before[0])  # only the right pixel is still covered
    np.testing.assert_allclose(sweep.psnr_covered_before[1], sweep.psnr_covered[1])


def test_without_a_known_background_every_pixel_counts_as_full():
    truth = np.ones((3, 3))
    assert is_empty(truth, [1.0, 1.0, 0.996]).all() and not is_empty(truth, None).any()
    assert not is_empty(truth, [1.0, 1.0, 0.98]).any()
    images = {"rgb": np.ones((3, 2, 3)), "opacity": np.ones((3, 2)), "content": np.ones((3, 2))}
    sweep = sweep_of([0.1, np.inf], [pixel_sums(images, truth, background=None)])
    assert np.isnan(sweep.share_floating).all() and (sweep.share_covered == 1.0).all()


def test_sweeps_that_cannot_be_used_are_errors():
    with pytest.raises(ValueError, match="there are none"):
        sweep_of([0.1, np.inf], [])
    one = PixelSums(*(np.ones(2) for _ in PixelSums._fields))
    for thresholds in ([0.1, 0.5], [np.inf, 0.1]):
        with pytest.raises(ValueError, match="ascend and end in inf"):
            sweep_of(thresholds, [one])


# --- the choice ---


def sweep_with(content_kept, psnr=None) -> Sweep:
    finite = np.linspace(0.1, 0.9, len(content_kept) - 1)
    blank = np.ones(len(content_kept))
    psnr = blank if psnr is None else np.asarray(psnr)
    kept = np.asarray(content_kept)
    return Sweep(np.append(finite, np.inf), kept, blank, psnr, *[blank] * 4)


def test_quality_takes_the_lowest_threshold_from_which_on_training_views_lose_little():
    sweep = sweep_with([0.0] * 6, psnr=[30.0, 29.95, 29.5, 29.95, 30.1, 30.0])
    assert choose_threshold(sweep) == 3  # a row below is good again, but by luck
    assert choose_threshold(sweep, max_loss=1.0) == 0
    assert choose_threshold(sweep, max_loss=0.0) == 4
    assert choose_threshold(sweep_with([0.0] * 4, psnr=[np.nan] * 4)) == 3  # nothing was measured


def test_keep_takes_the_lowest_threshold_that_keeps_the_share():
    choose = partial(choose_threshold, rule="keep")
    sweep = sweep_with([0.0, 0.5, 0.985, 0.992, 1.0, 1.0])
    assert choose(sweep) == 3
    assert choose(sweep, keep=0.98) == 2
    assert choose(sweep, keep=1.0) == 4
    assert choose(sweep_with([0.0, 0.2, 0.3, 1.0])) == 3  # nothing may go


def test_knee_is_where_the_curve_bends():
    kept = [0.0, 0.45, 0.9, 0.92, 0.94, 0.96, 1.0]
    assert choose_threshold(sweep_with(kept), rule="knee") == 2


def test_rules_that_cannot_be_used_are_errors():
    sweep = sweep_with([0.0, 1.0, 1.0])
    with pytest.raises(ValueError, match="use one of quality, keep, knee"):
        choose_threshold(sweep, rule="elbow")
    with pytest.raises(ValueError, match="0 dB or more"):
        choose_threshold(sweep, max_loss=-0.1)
    with pytest.raises(ValueError, match="above 0 and up to 1"):
        choose_threshold(sweep, keep=0.0)
    with pytest.raises(ValueError, match="3 or more"):
        choose_threshold(sweep, rule="knee")
