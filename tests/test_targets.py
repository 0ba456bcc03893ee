"""Information about targets against its float64 oracle, in closed form and at its limits."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.selection import targets as targets_module
from bavs_jax.selection.directional import Look, add_look, make_precision_fn
from bavs_jax.selection.information import sparse_curvature
from bavs_jax.selection.targets import (
    TargetInformation,
    linear_gain,
    log_gain,
    target_variances,
)
from tests import oracles_information as oracles

NUM, NUM_TARGETS, NUM_VERTICES = 5, 3, 12
PRIOR = np.array([0.5, 1.0, 2.0], np.float32)
every_gain = pytest.mark.parametrize("gain", [linear_gain, log_gain])


def toy(seed, num_vertices=NUM_VERTICES, num=NUM, num_targets=NUM_TARGETS):
    """Vertices [G, 3], then curvatures [., G, 3] and places [., 3] of candidates and of targets."""
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-1.0, 1.0, (num_vertices, 3)).astype(np.float32)

    def views(count):
        sees = rng.uniform(size=(count, num_vertices, 1)) < 0.6
        h = (rng.exponential(size=(count, num_vertices, 3)) * sees).astype(np.float32)
        return h, 4.0 * rng.normal(size=(count, 3)).astype(np.float32)

    return vertices, views(num), views(num_targets)


def information_of(vertices, candidates, targets, *, num_looks=1, sharpness=8.0, prior=PRIOR):
    """What is known from the first candidates, as a policy is given it."""

    def looks_of(views):
        looks = [Look(*sparse_curvature(h), place) for h, place in zip(*views)]
        return looks, lambda indices: (looks[index] for index in indices)

    looks, look_fn = looks_of(candidates)
    _, target_fn = looks_of(targets)
    return TargetInformation(
        looks=tuple(looks[:num_looks]),
        look_fn=look_fn,
        target_fn=target_fn,
        precision_fn=make_precision_fn(target_fn, vertices, prior=prior, sharpness=sharpness),
        num_values=10 + 5 * np.arange(len(targets[0])),
        vertices=vertices,
        sharpness=sharpness,
    )


def pairs(views):
    return list(zip(*views))


# --- oracles and closed forms ---


@pytest.mark.parametrize("sharpness", [0.0, 1.5, 8.0])
def test_variances_and_drops_equal_the_oracle_along_a_batch(sharpness):
    for seed in range(3):
        vertices, candidates, targets = toy(seed)
        information = information_of(vertices, candidates, targets, sharpness=sharpness)
        taken = [0]
        for pick in (3, 1, 3):

            def left(picks, target, vertices=vertices, candidates=candidates):
                looks = [pairs(candidates)[c] for c in picks]
                return oracles.target_variance(PRIOR, vertices, target, looks, sharpness)

            now = np.array([left(taken, target) for target in pairs(targets)])
            later = np.array(
                [[left([*taken, c], target) for target in pairs(targets)] for c in range(NUM)]
            )
            found = target_variances(information, range(NUM))
            np.testing.assert_allclose(found.variances, now, rtol=1e-5)
            np.testing.assert_allclose(found.drops, now - later, rtol=1e-4, atol=1e-7)
            n = information.num_values
            logs = 0.5 * (n * np.log((n + now) / (n + later))).sum(-1)
            np.testing.assert_allclose(log_gain(information, range(NUM)), logs, rtol=1e-4)
            sums = (now - later).sum(-1)
            np.testing.assert_allclose(linear_gain(information, range(NUM)), sums, rtol=1e-4)
            information = add_look(information, pick)
            taken.append(pick)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 90.0, 180.0])
def test_one_vertex_and_one_direction_in_closed_form(degrees):
    """std 0.5; T / noise^2 = 2 and h / noise^2 = 3 along y alone; one value of colour."""
    angle = np.radians(degrees)
    look = np.zeros((1, 1, 3), np.float32)
    look[..., 1] = 1.0
    places = np.float32([[5.0 * np.cos(angle), 5.0 * np.sin(angle), 0.0]])
    information = information_of(
        np.zeros((1, 3), np.float32),
        (3.0 * look, places),
        (2.0 * look, np.float32([[2.0, 0.0, 0.0]])),
        num_looks=0,
        prior=1.0 / 0.5**2,
    )._replace(num_values=np.array([1]))
    k = ((1.0 + np.cos(angle)) / 2.0) ** 8
    before, after = 2.0 / 4.0, 2.0 / (4.0 + 3.0 * k)
    np.testing.assert_allclose(target_variances(information, [0]).variances, [before])
    np.testing.assert_allclose(linear_gain(information, [0]), [before - after], atol=1e-6)
    expected = 0.5 * np.log((1.0 + before) / (1.0 + after))
    np.testing.assert_allclose(log_gain(information, [0]), [expected], atol=1e-6)


def test_without_sharpness_it_is_a_optimality_weighted_by_the_targets():
    vertices, candidates, targets = toy(3)
    gains = linear_gain(information_of(vertices, candidates, targets, sharpness=0.0), range(NUM))
    h, weight = candidates[0].astype(np.float64), np.diag(targets[0].sum(0).ravel())
    before = np.diag((PRIOR + h[0]).ravel())
    for c in range(NUM):
        after = before + np.diag(h[c].ravel())
        expected = np.trace(weight @ (np.linalg.inv(before) - np.linalg.inv(after)))
        np.testing.assert_allclose(gains[c], expected, rtol=1e-4)


# --- what it asks for ---


@every_gain
def test_where_one_view_is_the_target_that_view_is_picked(gain):
    """All see the same from as near, so that only the side differs."""
    vertices, (h, places), _ = toy(4)
    h = np.repeat(h[:1], NUM, axis=0)
    places *= 50.0 / np.linalg.norm(places, axis=1, keepdims=True)
    for c in range(NUM):
        target = h[c : c + 1], places[c : c + 1]
        gains = gain(information_of(vertices, (h, places), target, num_looks=0), range(NUM))
        assert gains.argmax() == c and (np.sort(gains)[:-1] < gains[c]).all()


@every_gain
def test_a_target_that_nobody_can_see_adds_nothing(gain):
    vertices, (h, places), (curvature, stands) = toy(5)
    h[:, :4] = 0.0
    unseen = np.zeros_like(curvature[:1])
    unseen[:, :4] = 7.0
    curvature[:, :4] = 0.0
    more = np.concatenate([curvature, unseen]), np.concatenate([stands, stands[:1]])
    plain = information_of(vertices, (h, places), (curvature, stands))
    with_unseen = information_of(vertices, (h, places), more)
    np.testing.assert_array_equal(
        gain(with_unseen, range(NUM)).astype(np.float32), gain(plain, range(NUM)).astype(np.float32)
    )
    found = target_variances(with_unseen, range(NUM))
    np.testing.assert_array_equal(found.drops[:, -1], 0.0)
    assert found.variances[-1] > 0.0


@every_gain
def test_a_view_of_nothing_gains_0_and_a_repeated_one_less_each_time(gain):
    vertices, candidates, targets = toy(6)
    candidates[0][4] = 0.0
    information = information_of(vertices, candidates, targets, num_looks=0)
    gains = []
    for _ in range(4):
        now = gain(information, [2, 4])
        assert now[1] == 0.0 < now[0]
        gains.append(now[0])
        information = add_look(information, 2)
    assert (np.diff(gains) < -0.05 * np.array(gains[:-1])).all()


def test_returns_diminish_for_every_target_and_every_order_of_looks():
    """The linear gain is submodular: what a view adds only falls as others are taken."""
    for seed in range(6):
        vertices, candidates, targets = toy(seed)
        information = information_of(vertices, candidates, targets, num_looks=0)
        before = target_variances(information, range(NUM))
        for pick in np.random.default_rng(seed).permutation(NUM):
            information = add_look(information, pick)
            after = target_variances(information, range(NUM))
            assert (after.drops <= before.drops * (1.0 + 1e-5)).all()  # float32
            assert (after.variances <= before.variances).all()
            before = after


def test_returns_of_the_logarithm_may_grow():
    """What is left of a target weighs more once the rest of it is known."""
    vertices = np.float32([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    h = 1e4 * np.stack([np.eye(2)] * 3, -1).astype(np.float32)  # each sees one of the two
    places = np.float32([[9.0, 0.0, 0.0]] * 2)
    target = np.ones((1, 2, 3), np.float32) * 100.0, places[:1]
    start = information_of(vertices, (h, places), target, num_looks=0)
    assert log_gain(add_look(start, 0), [1]) > 1.5 * log_gain(start, [1])


# --- invariances ---


@every_gain
def test_turning_and_the_unit_of_length_change_nothing(gain):
    vertices, (h, places), (curvature, stands) = toy(7)
    h, curvature = h.mean(-1, keepdims=True), curvature.mean(-1, keepdims=True)
    h, curvature = np.repeat(h, 3, axis=-1), np.repeat(curvature, 3, axis=-1)  # the same by axis
    want = gain(information_of(vertices, (h, places), (curvature, stands), prior=1.0), range(NUM))
    turn, unit = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix(), 40.0

    def moved(points):
        return np.float32(unit * points @ turn.T + [3.0, -5.0, 8.0])

    got = gain(
        information_of(
            moved(vertices),
            (h / unit**2, moved(places)),
            (curvature / unit**2, moved(stands)),
            prior=1.0 / unit**2,
        ),
        range(NUM),
    )
    np.testing.assert_allclose(got, want, rtol=1e-4)  # positions in float32


@every_gain
def test_orders_of_candidates_and_targets_do_not_matter(gain):
    vertices, candidates, targets = toy(8)
    information = information_of(vertices, candidates, targets)
    order = [3, 0, 4, 2]
    np.testing.assert_array_equal(gain(information, order), gain(information, range(NUM))[order])
    turned = information._replace(
        target_fn=lambda numbers: information.target_fn([2 - n for n in numbers]),
        precision_fn=lambda looks, numbers: information.precision_fn(
            looks, [2 - n for n in numbers]
        ),
        num_values=information.num_values[::-1],
    )
    np.testing.assert_allclose(gain(turned, range(NUM)), gain(information, range(NUM)), rtol=1e-12)


@every_gain
def test_a_target_counts_by_itself_however_many_are_held_at_once(gain, monkeypatch):
    vertices, candidates, targets = toy(9, num_targets=7)
    want = gain(information_of(vertices, candidates, targets), range(NUM))
    monkeypatch.setattr(targets_module, "TARGETS_AT_ONCE", 3)
    monkeypatch.setattr(targets_module, "TARGETS_SIDE_BY_SIDE", 2)
    got = gain(information_of(vertices, candidates, targets), range(NUM))
    np.testing.assert_allclose(got, want, rtol=1e-5)  # float32 in vectors of another length


@pytest.mark.parametrize("num_vertices", [1, 12, 1500])
def test_jitted_equals_eager(num_vertices):
    def found():
        toys = toy(10, num_vertices=num_vertices, num=2, num_targets=2)
        return target_variances(information_of(*toys), range(2))

    with jax.disable_jit():
        eager = found()
    for got, want in zip(found(), eager):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-7)


def test_a_vertex_on_a_camera_has_no_direction_to_it():
    vertices, (h, places), targets = toy(11)
    places[1] = vertices[0]
    found = target_variances(information_of(vertices, (h, places), targets), range(NUM))
    assert np.isfinite(found.drops).all() and (found.drops >= 0.0).all()
