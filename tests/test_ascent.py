"""Chosen poses that are moved to where an acquisition is larger."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import look_at, make_cameras
from bavs_jax.placement.ascent import ascend, moved, policy_scores
from bavs_jax.selection.context import make_context
from bavs_jax.selection.policies import POLICIES
from tests.test_selection_policies import KEY

UP = np.array([0.0, 0.0, 1.0])
LENGTH, ANGLE = 0.4, np.radians(15.0)


def poses_around(num=3):
    angles = 2.0 * np.arange(num)
    places = np.stack([3 * np.cos(angles), 3 * np.sin(angles), 1.0 + 0.1 * angles], -1)
    return np.stack([look_at(place, np.zeros(3)) for place in places])


def allow_all(trials):
    return np.ones(len(trials), bool)


def bowl(goals, ahead):
    """Largest at places `goals` [k, 3] where the gaze is `ahead` [k, 3]."""

    def score_fn(number, chosen, trials):
        apart = np.linalg.norm(trials[:, :, 3] - goals[number], axis=-1)
        cosine = -trials[:, :, 2] @ ahead[number]
        return 1.0 - apart**2 - (1.0 - cosine)

    return score_fn


def run(poses, score_fn, allowed_fn=allow_all, up=UP, steps=25, length=LENGTH):
    return ascend(poses, score_fn, allowed_fn, up=up, length=length, angle=ANGLE, steps=steps)


def test_a_pose_beside_itself_is_itself_and_moves_go_where_they_say():
    pose = poses_around()[1]
    (same,) = moved(pose, np.zeros((1, 5)), up=UP, length=LENGTH, angle=ANGLE)
    np.testing.assert_allclose(same, pose, atol=1e-12)
    moves = np.eye(5)
    got = moved(pose, moves, up=UP, length=LENGTH, angle=ANGLE)
    for axis in range(3):
        np.testing.assert_allclose(got[axis, :, 3] - pose[:, 3], LENGTH * pose[:, axis], atol=1e-12)
        np.testing.assert_allclose(got[axis, :, 2], pose[:, 2], atol=1e-12)
    for turned in got[3:]:
        np.testing.assert_allclose(turned[:, 3], pose[:, 3])
        np.testing.assert_allclose(turned[:, 2] @ pose[:, 2], np.cos(ANGLE), atol=1e-12)
        assert abs(turned[:, 0] @ UP) < 1e-12  # upright
    assert got[3, 2, 2] < pose[2, 2]  # the first one looks up: less of its back is above
    assert -got[4, :, 2] @ pose[:, 0] > 0  # the other to the right


def test_each_pose_ends_where_its_own_score_is_largest():
    poses = poses_around()
    goals = poses[:, :, 3] + np.array([0.1, -0.15, 0.05])
    ahead = np.stack([-look_at(p[:, 3], [0.3, 0.2, 0.1])[:, 2] for p in poses])
    found = run(poses, bowl(goals, ahead), steps=40)
    np.testing.assert_allclose(found.poses[:, :, 3], goals, atol=0.03)
    assert (np.degrees(np.arccos((-found.poses[:, :, 2] * ahead).sum(-1))) < 3.0).all()
    assert (found.after > found.before).all() and (found.after > 0.995).all()


def test_no_pose_goes_farther_than_it_may_or_where_none_may_stand():
    poses = poses_around()
    far = poses[:, :, 3] * 3.0
    asked = []

    def allowed_fn(trials):
        return trials[:, 0, 3] < poses[0, 0, 3] + 0.1  # a wall

    def score_fn(number, chosen, trials):
        asked.append(trials)
        return bowl(far, -poses[:, :, 2])(number, chosen, trials)

    found = run(poses, score_fn, allowed_fn)
    assert all(allowed_fn(trials).all() for trials in asked)
    assert (found.after >= found.before).all()
    along = np.einsum("kij,ki->kj", poses[:, :, :3], found.poses[:, :, 3] - poses[:, :, 3])
    assert (np.abs(along) <= LENGTH * (1 + 1e-9)).all()
    assert found.poses[0, 0, 3] < poses[0, 0, 3] + 0.1
    assert found.after[1] > found.before[1] + 0.1  # behind no wall


def test_where_nothing_is_better_nothing_moves():
    poses = poses_around()
    for score_fn in (
        lambda number, chosen, trials: np.full(len(trials), 2.0),
        bowl(poses[:, :, 3], -poses[:, :, 2]),
    ):
        found = run(poses, score_fn, steps=5)
        np.testing.assert_allclose(found.poses, poses)
        np.testing.assert_array_equal(found.after, found.before)
    found = run(poses, bowl(0 * poses[:, :, 3], -poses[:, :, 2]), lambda t: np.zeros(len(t), bool))
    np.testing.assert_array_equal(found.poses, poses)


def test_the_ascent_turns_and_grows_with_the_world():
    turn = Rotation.from_euler("xyz", [20, -40, 110], degrees=True).as_matrix()
    poses, goals = poses_around(), 0.9 * poses_around()[:, :, 3]
    ahead = -poses[:, :, 2]
    here = run(poses, bowl(goals, ahead), steps=6)

    def away(pose):
        """The same place and gaze in a world turned and three times as large."""
        return np.concatenate([turn @ pose[..., :3], 3.0 * turn @ pose[..., 3:]], axis=-1)

    def score_fn(number, chosen, trials):
        back = np.concatenate([turn.T @ trials[..., :3], turn.T @ trials[..., 3:] / 3.0], -1)
        return bowl(goals, ahead)(number, chosen, back)

    there = run(away(poses), score_fn, up=turn @ UP, steps=6, length=3 * LENGTH)
    np.testing.assert_allclose(there.poses, away(here.poses), atol=1e-6)


@pytest.mark.parametrize("name", ["farthest", "spread"])
def test_the_score_of_a_free_pose_is_the_policy_s_own(name):
    """In place of a pick, with the others picked: as if it were one more candidate."""
    rng = np.random.default_rng(0)
    poses = np.stack([look_at(p, np.zeros(3)) for p in rng.normal([0, 0, 4], 1.0, (9, 3))])
    cameras = make_cameras(poses, np.tile([9.0, 9, 4, 4], (9, 1)), np.tile([8, 8], (9, 1)))
    training = rng.normal(size=(2, 3))
    about = {"training_positions": training, "is_training_view": [True, False]}
    about |= {"centre": np.zeros(3)}

    def context_fn(every, mask):
        return make_context(every.positions, mask=mask, places=cameras.positions, **about)

    trials = np.stack([look_at(p, np.zeros(3)) for p in rng.normal([0, 0, 4], 1.0, (4, 3))])
    chosen = poses[[2, 5, 7]]
    got = policy_scores(POLICIES[name], KEY, cameras, context_fn)(1, chosen, trials)
    known = np.concatenate([training[:1], chosen[[0, 2], :, 3]])

    def nearest(points):
        return np.linalg.norm(points[:, None] - known, axis=-1).min(axis=1)

    if name == "farthest":
        want = nearest(trials[:, :, 3])
    else:
        places, before = poses[:, :, 3], nearest(poses[:, :, 3]) ** 2
        apart = np.linalg.norm(places[:, None] - trials[:, :, 3], axis=-1) ** 2
        want = np.maximum(before[:, None] - apart, 0.0).mean(axis=0)
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)
