"""Free camera poses: what cameras look at, where they may stand, what is turned away and why."""

import numpy as np
import pytest

from bavs_jax.cameras import look_at, make_cameras
from bavs_jax.placement.clearance import (
    REASONS,
    fibonacci_directions,
    judge_positions,
    matter_density,
    optical_depth,
    within_bounds,
)
from bavs_jax.placement.collect import PlacementError, Proposals, check_enough, collect_poses
from bavs_jax.placement.proposals import aim, box_positions, shell_positions, turned_targets
from bavs_jax.placement.seen import count_seeing, focus_point, in_unknown_space, share_facing

UP = np.array([0.0, 0.0, 1.0])


def ball_density(points):
    """A solid ball of radius 1 in empty space."""
    return np.where(np.linalg.norm(points, axis=-1) < 1.0, 100.0, 0.0)


def ring(num=12, radius=3.0, target=(0.0, 0.0, 0.0)):
    angles = 2 * np.pi * np.arange(num) / num
    places = np.stack([np.cos(angles), np.sin(angles), 0.3 * np.cos(3 * angles)], -1) * radius
    return np.stack([look_at(p, target) for p in places])


def test_focus_is_where_the_axes_meet():
    target = [0.3, -0.2, 0.5]
    # The pull towards the fallback is 1e-6 of a camera's weight.
    np.testing.assert_allclose(focus_point(ring(target=target), [9.0, 9.0, 9.0]), target, atol=1e-4)


def test_focus_of_two_skew_axes_is_midway():
    first, second = look_at([3, 0, 0.5], [0, 0, 0.5]), look_at([0, 3, -0.5], [0, 0, -0.5])
    got = focus_point(np.stack([first, second]), [0, 0, 0])
    np.testing.assert_allclose(got, [0, 0, 0], atol=1e-5)


def test_focus_of_parallel_axes_is_on_their_line_beside_the_fallback():
    poses = np.stack([look_at([0, y, 0], [5, y, 0]) for y in (-1.0, 1.0)])
    np.testing.assert_allclose(focus_point(poses, [2.0, 7.0, 7.0]), [2.0, 0.0, 0.0], atol=1e-4)


def test_share_facing_tells_inwards_from_outwards():
    poses = ring()
    outwards = poses.copy()
    outwards[:, :, 2] *= -1
    assert share_facing(poses, [0, 0, 0]) == 1.0
    assert share_facing(outwards, [0, 0, 0]) == 0.0


def test_solid_matter_halves_light():
    np.testing.assert_allclose(np.exp(-matter_density(0.3) * 0.3), 0.5)


def test_directions_leave_no_hole():
    """Every direction has one of the 128 within 15 degrees: what `ball_offsets` relies on."""
    probes = np.random.default_rng(0).normal(size=(4000, 3))
    probes /= np.linalg.norm(probes, axis=-1, keepdims=True)
    nearest = (probes @ fibonacci_directions(128).T).max(axis=-1)
    assert np.degrees(np.arccos(nearest.min())) < 15.0


def test_a_ball_is_kept_clear_of():
    places = np.random.default_rng(1).uniform(-2, 2, (3000, 3))
    radius = np.linalg.norm(places, axis=-1)
    inside, near = judge_positions(places, ball_density, clearance=0.2, solid_density=50.0)
    np.testing.assert_array_equal(inside, radius.astype(np.float32) < 1.0)
    assert not (inside & near).any()
    assert (radius[~inside & ~near] >= 1.2).all()  # never nearer than the clearance
    assert not near[radius > 1.0 + 1.05 * 0.2 + 1e-6].any()  # and no more than 5 % beyond it
    assert near.sum() > 50 and (~inside & ~near).sum() > 500


def test_thin_fog_is_no_matter():
    places = np.zeros((1, 3))
    for density, expected in ((49.0, False), (51.0, True)):
        inside, _ = judge_positions(
            places, lambda p, d=density: np.full(len(p), d), clearance=0.1, solid_density=50.0
        )
        assert inside[0] == expected


def test_chunks_do_not_matter():
    places = np.random.default_rng(2).uniform(-2, 2, (40, 3))
    whole = judge_positions(places, ball_density, clearance=0.3, solid_density=1.0)
    parts = judge_positions(places, ball_density, clearance=0.3, solid_density=1.0, chunk=999)
    np.testing.assert_array_equal(whole, parts)


def test_optical_depth_through_the_middle_of_a_ball():
    got = optical_depth(ball_density, [[-2.0, 0, 0], [-2.0, 5, 0]], [[2.0, 0, 0], [2.0, 5, 0]])
    np.testing.assert_allclose(got, [200.0, 0.0], atol=100 * 4 / 64)  # one sample of the midpoint


def test_bounds_are_a_closed_box():
    places = np.array([[0, 0, 0], [1, 1, 1], [1.001, 0, 0], [0, -0.001, 0]])
    np.testing.assert_array_equal(
        within_bounds(places, [[0, 0, 0], [1, 1, 1]]), [True, True, False, False]
    )
    assert within_bounds(places, None).all()


def test_shell_stays_between_the_cameras():
    cameras = ring()[:, :, 3] * np.linspace(0.8, 1.2, 12)[:, None]
    places, pairs = shell_positions(
        np.random.default_rng(0), 500, cameras, focus=np.zeros(3), up=UP, spread=0.1
    )
    assert places.shape == (500, 3) and pairs.shape == (500, 2)
    distances = np.linalg.norm(cameras, axis=-1)
    got = np.linalg.norm(places, axis=-1)
    assert got.min() >= distances.min() and got.max() <= distances.max()
    assert places[:, 2].min() >= cameras[:, 2].min()
    assert places[:, 2].max() <= cameras[:, 2].max()
    # Between cameras, not on top of them: most are well away from every one.
    apart = np.linalg.norm(places[:, None] - cameras, axis=-1).min(axis=-1)
    assert np.median(apart) > 0.2


def test_shell_of_two_cameras_without_noise_is_their_arc():
    cameras = np.array([[2.0, 0, 0], [0, 2.0, 0]])
    places, _ = shell_positions(
        np.random.default_rng(0), 50, cameras, focus=np.zeros(3), up=UP, spread=1e-9
    )
    np.testing.assert_allclose(np.linalg.norm(places, axis=-1), 2.0, atol=1e-6)
    assert (places[:, :2] > -1e-6).all()


def test_turned_targets_keep_distance_and_have_the_wanted_angle():
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(4000, 3))
    targets = positions + np.array([0.0, 3.0, 0.0])
    turned = turned_targets(rng, positions, targets, 5.0)
    offsets = turned - positions
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 3.0)
    angle = np.degrees(np.arccos(np.clip(offsets[:, 1] / 3.0, -1, 1)))
    # Mean square of N(0, 5): 25, with a standard error of 25 sqrt(2 / 4000); 4 of them.
    np.testing.assert_allclose(np.mean(angle**2), 25.0, atol=4 * 25 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(turned_targets(rng, positions, targets, 0.0), targets, atol=1e-12)


def draw_from_box(num=200):
    def draw(lap):
        places = box_positions(np.random.default_rng(lap), num, [[-2, -2, -2], [2, 2, 2]])
        return aim(places, np.broadcast_to([0.0, 0.0, 5.0], places.shape), UP)

    return draw


def judge_ball(poses, bounds=((-1.8, -1.8, -1.8), (1.8, 1.8, 1.8))):
    places = poses[:, :, 3]
    inside, near = judge_positions(places, ball_density, clearance=0.2, solid_density=1.0)
    unseen = in_unknown_space(places, one_camera(), ball_density, reach=1.0)
    return np.select([~within_bounds(places, bounds), inside, near, unseen], [0, 1, 2, 3], -1)


def one_camera():
    """At (3, 0, 0), with all of the ball in its image."""
    return make_cameras(look_at([3.0, 0.0, 0.0], [0.0, 0.0, 0.0])[None], [[9, 9, 8, 8]], [[16, 16]])


def test_unknown_space_is_what_no_camera_sees_or_stands_near():
    behind_the_ball, before_it, behind_the_camera = [-1.5, 0, 0], [1.5, 0, 0], [3.5, 0, 0]
    places = np.array([behind_the_ball, before_it, behind_the_camera], float)
    got = in_unknown_space(places, one_camera(), ball_density, reach=1.0)
    np.testing.assert_array_equal(got, [True, False, False])
    closer = in_unknown_space(places, one_camera(), ball_density, reach=0.1)
    np.testing.assert_array_equal(closer, [True, False, True])
    assert [count_seeing(one_camera(), place, ball_density) for place in places] == [0, 1, 0]


def test_collected_poses_are_allowed_and_every_rejection_is_counted():
    got = collect_poses(draw_from_box(), judge_ball, 300)
    assert len(got.poses) == 300
    assert got.num_drawn == 300 + sum(got.dropped.values())
    assert all(got.dropped[reason] > 0 for reason in REASONS)
    places = got.poses[:, :, 3]
    assert (np.linalg.norm(places, axis=-1) >= 1.2).all() and (np.abs(places) <= 1.8).all()
    for reason, num in got.dropped.items():
        assert f"{num} {reason}" in got.in_words()


def test_too_few_poses_name_the_main_reason_and_its_fix():
    fixes = {reason: f"fix {reason}" for reason in REASONS} | {"": "list more"}
    got = collect_poses(draw_from_box(50), lambda poses: np.full(len(poses), 1), 10, max_laps=3)
    assert got.num_drawn == 150 and len(got.poses) == 0
    with pytest.raises(PlacementError, match="150 inside matter: fix inside matter"):
        check_enough(got, 2, fixes=fixes)
    few = Proposals(np.zeros((1, 3, 4)), 1, dict.fromkeys(REASONS, 0))
    with pytest.raises(PlacementError, match="list more"):
        check_enough(few, 2, fixes=fixes)
    check_enough(few, 1, fixes=fixes)
