"""Gaps of target pixels: loops in float64, closed forms, and where a field says surfaces are."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import look_at, make_cameras, take
from bavs_jax.candidates import Candidates
from bavs_jax.selection.gaps import ViewGaps, add_view, gap_gains, log_errors
from bavs_jax.selection.policies import POLICIES
from bavs_jax.target_inputs import MOST_PIXELS, view_gaps
from bavs_jax.uncertainty.gaps import (
    BLUR,
    LEAST,
    UNSEEN,
    TargetPixels,
    closeness_of_views,
    squared_gap,
    target_shares,
)
from bavs_jax.uncertainty.model import Acquired
from experiments.build import Problem
from tests.test_surface_coverage import random_world, slow_transmittance
from tests.toy_rounds import silent
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

KEY = jax.random.key(0)


def random_pixels(seed, num_targets=3, num_pixels=20):
    rng = np.random.default_rng(seed)
    return TargetPixels(
        points=rng.uniform(-1.0, 1.0, (num_targets, num_pixels, 3)).astype(np.float32),
        cameras=3.0 * rng.normal(size=(num_targets, 3)).astype(np.float32),
        focal=rng.uniform(10.0, 40.0, num_targets).astype(np.float32),
        weight=rng.uniform(size=(num_targets, num_pixels)).astype(np.float32),
    )


def slow_angle(point, a, b):
    a, b = (np.asarray(x, np.float64) - np.asarray(point, np.float64) for x in (a, b))
    return np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)


def test_closeness_equals_loops_over_views_targets_and_pixels():
    pixels, (_, _, lookers) = random_pixels(0), random_world(1, 1)
    found = np.asarray(closeness_of_views(pixels, lookers))
    assert found.shape == (5, 3, 20), "views, targets, pixels; also those that do not count"
    expected = np.zeros(found.shape)
    for view, target, pixel in np.ndindex(found.shape):
        point = pixels.points[target, pixel]
        place, wanted = np.asarray(lookers.cameras.positions[view]), pixels.cameras[target]
        widths = [np.linalg.norm(point - x, axis=-1) for x in (place, wanted)]
        coarser = widths[0] / lookers.cameras.intrinsics[view, 0] * pixels.focal[target] / widths[1]
        blur = BLUR * np.log2(max(coarser, 1.0))
        gap = slow_angle(point, place, wanted) ** 2 + LEAST**2 + blur**2
        expected[view, target, pixel] = slow_transmittance(lookers, view, point) / gap
    assert 0.1 < (expected > 0.0).mean() < 0.95, "some must be in the images, and some not"
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("num_pixels", [1, 7, 200])
def test_jitted_equals_eager(num_pixels):
    pixels, (_, _, lookers) = random_pixels(2, num_pixels=num_pixels), random_world(3, 1)
    with jax.disable_jit():
        eager = closeness_of_views(pixels, lookers), target_shares(pixels)
    jitted = closeness_of_views(pixels, lookers), target_shares(pixels)
    for a, b in zip(jitted, eager):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_gaps_at_known_angles_and_widths():
    at_origin = np.zeros((1, 1, 3)), np.array([[0.0, 0.0, 2.0]]), np.array([10.0]), np.ones((1, 1))
    for angle in (0.0, 1e-4, 0.5, np.pi / 2, np.pi):
        place = 2.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        for away, focal, octaves in ((1.0, 10.0, 0), (4.0, 10.0, 2), (4.0, 40.0, 0), (1.0, 5.0, 1)):
            pixels = TargetPixels(*at_origin)
            found = squared_gap(pixels, (away * place).astype(np.float32), focal)
            expected = angle**2 + LEAST**2 + (BLUR * octaves) ** 2
            np.testing.assert_allclose(found, [[expected]], rtol=1e-5)
            alike = squared_gap(pixels, (away * place).astype(np.float32))
            np.testing.assert_allclose(alike, [[angle**2 + LEAST**2]], rtol=1e-5)
    assert pytest.approx(1.0 / np.pi**2) == UNSEEN


def test_gaps_know_neither_the_scale_nor_the_axes():
    pixels, place = random_pixels(4), np.array([1.0, 2.0, -3.0])
    turn = Rotation.random(random_state=0).as_matrix()
    moved = pixels._replace(
        points=(7.0 * pixels.points @ turn.T + 1.0).astype(np.float32),
        cameras=(7.0 * pixels.cameras @ turn.T + 1.0).astype(np.float32),
    )
    for a, b in (
        (squared_gap(pixels, place, 20.0), squared_gap(moved, 7.0 * turn @ place + 1.0, 20.0)),
        (target_shares(pixels), target_shares(moved)),
    ):
        np.testing.assert_allclose(a, b, rtol=2e-4)


def test_targets_of_one_side_share_the_weight_of_one():
    """Three targets in one place and one across: the three together count as much as the one."""
    points, near = np.zeros((4, 5, 3)), [0.0, 0.0, 2.0]
    # From another distance along the same line, too.
    cameras = np.array([near, near, [0.0, 0.0, 9.0], [0.0, 0.0, -2.0]])
    pixels = TargetPixels(points, cameras, np.full(4, 20.0), np.ones((4, 5)))
    found = np.asarray(target_shares(pixels))
    across = LEAST**2 / (np.pi**2 + LEAST**2)
    np.testing.assert_allclose(found[:3], 1.0 / (3.0 + across), rtol=1e-5)
    np.testing.assert_allclose(found[3], 1.0 / (1.0 + 3.0 * across), rtol=1e-5)


def test_a_target_of_nothing_has_no_share():
    pixels = random_pixels(5)
    weight = np.array(pixels.weight)
    weight[1] = 0.0
    found = np.asarray(target_shares(pixels._replace(weight=weight)))
    assert found[1] == 0.0 and (found[[0, 2]] > 0.0).all() and np.isfinite(found).all()


def random_gaps(seed, num=6, num_targets=3, num_pixels=8):
    rng = np.random.default_rng(seed)
    shape = (num_targets, num_pixels)
    return ViewGaps(
        known=0.1 + rng.exponential(size=shape),
        closeness=rng.exponential(size=(num, *shape)) * (rng.uniform(size=(num, *shape)) < 0.5),
        pixel_weight=rng.uniform(size=shape),
        target_weight=rng.uniform(size=num_targets),
    )


def slow_worth(known, gaps):
    total = 0.0
    for t, target_weight in enumerate(gaps.target_weight):
        errors = [w / k for w, k in zip(gaps.pixel_weight[t], known[t])]
        total -= target_weight * np.log(sum(errors) / sum(gaps.pixel_weight[t]))
    return total / sum(gaps.target_weight)


def test_gains_equal_loops_and_add_up_along_a_batch():
    gaps = random_gaps(0)
    start, known = slow_worth(gaps.known, gaps), np.array(gaps.known)
    for index in (4, 0, 4):
        expected = [slow_worth(known + c, gaps) - slow_worth(known, gaps) for c in gaps.closeness]
        found = gap_gains(gaps, np.arange(6))
        np.testing.assert_allclose(found, expected, rtol=1e-5)
        gaps, known = add_view(gaps, index), known + gaps.closeness[index]
        start += expected[index]
    assert start == pytest.approx(slow_worth(known, gaps))


def test_a_second_look_from_the_same_place_is_worth_less():
    for seed in range(5):
        gaps = random_gaps(seed)
        first, second = gap_gains(gaps, [2]), gap_gains(add_view(gaps, 2), [2])
        assert 0.0 < second < first


def test_who_sees_nothing_gains_nothing_and_nothing_hangs_on_empty_targets():
    gaps = random_gaps(1)
    closeness, weight = np.array(gaps.closeness), np.array(gaps.pixel_weight)
    closeness[3] = 0.0
    weight[1] = 0.0
    empty = gaps._replace(closeness=closeness, pixel_weight=weight)
    found = gap_gains(empty, np.arange(6))
    assert (
        found[3] == 0.0 and np.isfinite(found).all() and log_errors(empty.known, weight)[1] == 0.0
    )
    others = np.array(closeness)
    others[:, 1] = 1e6
    np.testing.assert_array_equal(gap_gains(empty._replace(closeness=others), np.arange(6)), found)
    nobody = empty._replace(target_weight=np.zeros(3))
    np.testing.assert_array_equal(gap_gains(nobody, np.arange(6)), np.zeros(6))
    assert gap_gains(gaps, []).shape == (0,)


# --- from a field ----------------------------------------------------------------------------


def ball_images(rays):
    """Depth and opacity of an opaque ball of radius 1 at the origin, on the host."""
    along = -(rays.origins * rays.directions).sum(-1)
    closest = np.linalg.norm(rays.origins + along[:, None] * rays.directions, axis=-1)
    hit = closest < 1.0
    depth = np.where(hit, along - np.sqrt(np.maximum(1.0 - closest**2, 0.0)), 0.0)
    return {"depth": depth.astype(np.float32), "opacity": hit.astype(np.float32)}


def cameras_at(places, size=32):
    return make_cameras(
        np.stack([look_at(p, [0.0, 0.0, 0.0]) for p in places]),
        np.tile([size * 1.2, size * 1.2, size / 2, size / 2], (len(places), 1)),
        np.tile([size, size], (len(places), 1)),
    )


def ball_gaps(training, candidates, targets, *, image_scale=1.0):
    table = dataclasses.make_dataclass("Table", ["cameras"])(cameras_at(training))
    acquired = Acquired(None, table, np.ones(len(training), bool), num_rays=1)
    return view_gaps(
        lambda rays: ball_images(jax.tree.map(np.asarray, rays)),
        acquired,
        cameras_at(candidates),
        cameras_at(targets),
        image_scale=image_scale,
        chunk=512,
    )


def test_a_ball_is_known_from_where_it_was_looked_at():
    """One view in front; candidates there, beside the ball and behind it; targets of two sides."""
    front, side, back = [3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-3.0, 0.0, 0.0]
    gaps = ball_gaps([front], [front, side, back], [front, back], image_scale=0.5)
    shown = np.asarray(gaps.pixel_weight) > 0.0
    assert 0.2 < shown.mean() < 0.9
    # The target in front has been seen from its very place; of the one behind the ball hides all.
    np.testing.assert_allclose(gaps.known[0][shown[0]], UNSEEN + LEAST**-2, rtol=1e-4)
    np.testing.assert_allclose(gaps.known[1][shown[1]], UNSEEN, rtol=1e-4)
    np.testing.assert_allclose(np.asarray(gaps.closeness)[0, 1], 0.0)  # the ball hides its back
    gains = gap_gains(gaps, [0, 1, 2])
    assert gains[2] > 2.0 > gains.max(initial=0.0, where=[True, True, False]) > 0.0
    assert gap_gains(add_view(gaps, 2), [2])[0] == pytest.approx(np.log(2.0) / 2.0, rel=0.01)


def test_large_targets_are_reduced_further_and_are_as_sharp_as_before():
    place = [3.0, 0.0, 0.0]
    gaps = ball_gaps([place], [[0.0, 3.0, 0.0]], [place])
    assert 0.8 * MOST_PIXELS <= gaps.pixel_weight.size <= 1.2 * MOST_PIXELS
    shown = np.asarray(gaps.pixel_weight) > 0.0
    np.testing.assert_allclose(gaps.known[shown].max(), UNSEEN + LEAST**-2, rtol=1e-4)


@pytest.mark.parametrize("name", ["target_gaps", "bavs_gaps"])
def test_a_problem_fills_the_gaps_of_all_its_pool(name):
    problem = Problem(toy_config(), toy_scene(), track=silent)
    is_training = np.isin(np.arange(problem.scene.num_views), [1, 4, 7])
    pool = np.asarray(problem.scene.pool)
    cameras = take(problem.table.cameras, pool)
    train = problem.trainer.init(KEY)
    acquired = Acquired(train, problem.table, is_training, num_rays=100, candidates=cameras)
    candidates = Candidates(cameras, pool.astype(np.int32), ~is_training[pool])
    gaps = problem.inputs(POLICIES[name], KEY, acquired, candidates).fields["gaps"]
    assert len(gaps.closeness) == len(gaps.target_weight) == len(pool)
    assert (np.asarray(gaps.known) >= UNSEEN).all() and np.isfinite(gaps.closeness).all()


def test_views_of_different_sizes_are_refused_with_a_reason():
    small = cameras_at([[0.0, 3.0, 0.0]], size=16)
    mixed = jax.tree.map(lambda a, b: np.concatenate([a, b]), cameras_at([[3.0, 0, 0]]), small)
    table = dataclasses.make_dataclass("Table", ["cameras"])(small)
    acquired = Acquired(None, table, np.ones(1, bool), num_rays=1)
    with pytest.raises(ValueError, match="views of different sizes"):
        view_gaps(ball_images, acquired, mixed, small, image_scale=1.0, chunk=64)


def test_gaps_of_few_rays_are_not_lost():
    """A candidate that sees one pixel of one target still gains."""
    gaps = random_gaps(7)
    closeness = np.zeros_like(gaps.closeness)
    closeness[5, 2, 3] = 1.0
    found = gap_gains(gaps._replace(closeness=closeness), np.arange(6))
    assert found[5] > 0.0 and (found[:5] == 0.0).all()
