"""Information gains, their memory, the policies on them and the bound, against dense float64."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.selection import SelectionError
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.information import (
    MIN_ROWS,
    Information,
    add_curvature,
    batch_upper_bound,
    candidate_gains,
    log_det_gain,
    make_cached_curvature_fn,
    sparse_curvature,
    trace_ratio_gain,
)
from bavs_jax.selection.policies import POLICIES
from tests import oracles_information as oracles
from tests.traces import count_traces

KEY = jax.random.key(0)
NUM, NUM_VERTICES = 9, 12
informative = pytest.mark.parametrize("name", ["d_optimal", "fisher_ratio"])
GAINS = {"d_optimal": log_det_gain, "fisher_ratio": trace_ratio_gain}
ORACLES = {
    "d_optimal": lambda precision, h: oracles.log_det_of_set(precision, [h], [0]),
    "fisher_ratio": oracles.trace_ratio,
}


def toy(seed, *, overlap=0.5):
    """Precision [12, 3] and curvatures [9, 12, 3] of views that see some vertices each."""
    rng = np.random.default_rng(seed)
    precision = rng.uniform(0.05, 2.0, (NUM_VERTICES, 3)).astype(np.float32)
    sees = rng.uniform(size=(NUM, NUM_VERTICES, 1)) < overlap
    curvatures = rng.exponential(size=(NUM, NUM_VERTICES, 3)) * sees
    return precision, curvatures.astype(np.float32)


def information_of(precision, curvatures):
    fn = make_cached_curvature_fn(
        lambda indices: curvatures[indices], num_vertices=len(precision), max_bytes=2**20
    )
    return Information(jnp.asarray(precision), fn)


def context(information, *, num=NUM, mask=None):
    positions = np.random.default_rng(0).normal(size=(num, 3))
    return make_context(
        positions,
        training_positions=10.0 + positions,
        is_training_view=np.ones(num, bool),
        centre=np.zeros(3),
        mask=mask,
        information=information,
    )


# --- sparse curvature and its memory ---------------------------------------------------------


def test_sparse_curvature_is_the_dense_one():
    for seed, num_seen in itertools.product(range(2), [0, 1, MIN_ROWS, MIN_ROWS + 1, 3000]):
        rng = np.random.default_rng(seed)
        dense = np.zeros((5000, 3), np.float32)
        seen = rng.permutation(5000)[:num_seen]
        # One axis with curvature is enough to keep a vertex.
        dense[seen, rng.integers(0, 3, num_seen)] = rng.uniform(0.1, 1.0, num_seen)
        rows, h = sparse_curvature(dense)
        size = {0: 1024, 1: 1024, 1024: 1024, 1025: 2048, 3000: 4096}[num_seen]
        assert (rows.shape, h.shape, rows.dtype) == ((size,), (size, 3), np.int32)
        again = np.zeros_like(dense)
        np.add.at(again, rows, h)
        np.testing.assert_array_equal(again, dense)
        assert not h[num_seen:].any() and not rows[num_seen:].any()


def test_rounding_below_zero_is_clipped_and_nan_is_kept():
    dense = np.zeros((10, 3), np.float32)
    dense[3], dense[4, 1], dense[7, 2] = [1.0, -1e-9, 0.0], -1e-9, np.nan
    rows, h = sparse_curvature(dense)
    assert rows[:2].tolist() == [3, 7]
    np.testing.assert_array_equal(h[:2], [[1.0, 0.0, 0.0], [0.0, 0.0, np.nan]])


def test_memory_is_bounded_and_what_does_not_fit_is_computed_anew():
    calls = []

    def dense(indices):
        calls.append(indices.tolist())
        return np.ones((len(indices), NUM_VERTICES, 3)) * indices[:, None, None]

    one = MIN_ROWS * 16  # bytes of a padded candidate: four numbers of 4 bytes a row
    fn = make_cached_curvature_fn(
        dense, num_vertices=NUM_VERTICES, max_bytes=4 * one + one // 2, group_size=2
    )
    wanted = [7, 1, 5, 2, 3, 9, 4]
    for _ in range(2):
        assert [h.max() for _, h in fn(wanted)] == wanted
    assert [h.max() for _, h in fn([3, 1])] == [3, 1]
    assert calls == [[7, 1], [5, 2], [3, 9], [4], [3, 9], [4], [3]]


def test_curvature_is_made_only_as_far_as_it_is_asked_for():
    calls = []

    def dense(indices):
        calls.append(indices.tolist())
        return np.ones((len(indices), NUM_VERTICES, 3))

    fn = make_cached_curvature_fn(dense, num_vertices=NUM_VERTICES, max_bytes=0, group_size=3)
    next(fn([4, 6, 8, 1, 3]))
    assert calls == [[4, 6, 8]]


def test_a_wrong_shape_is_an_error():
    fn = make_cached_curvature_fn(
        lambda i: np.zeros(12), num_vertices=12, max_bytes=0, group_size=2
    )
    message = r"shape \(12,\) for candidates \[4, 2\]; return \(2, 12, 3\)"
    with pytest.raises(SelectionError, match=message):
        list(fn([4, 2]))


# --- gains -----------------------------------------------------------------------------------


def test_gains_against_dense_matrices():
    for seed in range(5):
        precision, curvatures = toy(seed)
        information = information_of(precision, curvatures)
        log_det = candidate_gains(information, range(NUM), gain=log_det_gain)
        ratio = candidate_gains(information, range(NUM), gain=trace_ratio_gain)
        # Float32 sums of 36 positive terms.
        np.testing.assert_allclose(
            log_det, [oracles.log_det_of_set(precision, curvatures, [c]) for c in range(NUM)], 2e-6
        )
        np.testing.assert_allclose(
            ratio, [oracles.trace_ratio(precision, curvatures[c]) for c in range(NUM)], 2e-6
        )
        assert (log_det <= ratio).all()  # log(1 + x) <= x


def test_gains_of_little_and_much_curvature():
    precision = jnp.full((1, 3), 1e-9)  # a weak prior: h / H spans many powers of ten
    for ratio in (1e-9, 1e-3, 1.0, 1e6, 1e12):
        h = ratio * precision
        np.testing.assert_allclose(log_det_gain(h, precision), 3.0 * np.log1p(ratio), 1e-5)
        np.testing.assert_allclose(trace_ratio_gain(h, precision), 3.0 * ratio, 1e-5)


@informative
def test_a_view_that_meets_nothing_gains_nothing(name):
    precision, curvatures = toy(0)
    curvatures[4] = 0.0
    information = information_of(precision, curvatures)
    assert candidate_gains(information, [4], gain=GAINS[name]) == 0.0
    np.testing.assert_array_equal(add_curvature(information, 4).precision, precision)


def test_padding_adds_nothing_to_the_first_vertex():
    precision, curvatures = toy(1)
    curvatures[:, 0] = 1.0
    information = information_of(precision, curvatures)
    after = add_curvature(information, 2).precision
    np.testing.assert_allclose(after, precision + curvatures[2], rtol=1e-6)  # float32
    assert information.precision is not after


def test_log_det_is_monotone_and_submodular():
    for seed in range(3):
        precision, curvatures = toy(seed)
        rng = np.random.default_rng(seed)
        for _ in range(10):
            order = rng.permutation(NUM)
            few, more, index = order[:2], order[:5], order[8]
            small = large = information_of(precision, curvatures)
            for c in few:
                small = add_curvature(small, c)
            for c in more:
                large = add_curvature(large, c)
            gain_small = candidate_gains(small, [index], gain=log_det_gain)[0]
            gain_large = candidate_gains(large, [index], gain=log_det_gain)[0]
            assert 0.0 <= gain_large <= gain_small + 1e-6  # float32
            joined = oracles.log_det_of_set(precision, curvatures, [*more, index])
            without = oracles.log_det_of_set(precision, curvatures, more)
            np.testing.assert_allclose(gain_large, joined - without, rtol=1e-5, atol=1e-6)


def test_compiled_once_for_each_padded_size():
    rng = np.random.default_rng(0)
    sees = rng.uniform(size=(6, 4000)) < np.array([0.01, 0.02, 0.05, 0.5, 0.6, 0.7])[:, None]
    h = np.where(sees[..., None], rng.exponential(size=(6, 4000, 3)), 0.0)
    information = information_of(np.ones((4000, 3), np.float32), h)
    jax.clear_caches()
    with count_traces() as traces:
        for index in range(6):
            candidate_gains(information, range(6), gain=log_det_gain)
            information = add_curvature(information, index)
    # 1024 rows for three of them, and 2048 or 4096 for the others.
    assert traces.count("_gain_at") == traces.count("_add_at") == 3


# --- policies --------------------------------------------------------------------------------


@informative
def test_greedy_against_the_slow_reference(name):
    for seed in range(5):
        precision, curvatures = toy(seed)
        ctx = context(information_of(precision, curvatures))
        selected, info = acquire(POLICIES[name], KEY, ctx, 5)
        expected = oracles.greedy_order(precision, curvatures, 5, ORACLES[name])
        assert selected.tolist() == expected
        state = np.array(precision, np.float64)
        for index, score in zip(selected, info.selected_scores):
            np.testing.assert_allclose(score, ORACLES[name](state, curvatures[index]), 1e-5)
            state += curvatures[index]


@informative
def test_top_k_takes_the_largest_at_once(name):
    precision, curvatures = toy(3)
    ctx = context(information_of(precision, curvatures))
    selected, _ = acquire(POLICIES[name], KEY, ctx, 4, mode="top_k")
    gains = [ORACLES[name](precision, h) for h in curvatures]
    assert selected.tolist() == np.argsort(-np.array(gains))[:4].tolist()


@informative
@pytest.mark.parametrize("mode", ["top_k", "greedy"])
@pytest.mark.parametrize("distance_filter", [True, False])
def test_only_what_may_be_picked_is_differentiated(name, mode, distance_filter):
    precision, curvatures = toy(4)
    asked = set()

    def curvature_fn(indices):
        for index in indices:
            asked.add(int(index))
            yield sparse_curvature(curvatures[index])

    mask = np.arange(NUM) != 5
    ctx = context(Information(precision, curvature_fn), mask=mask)
    selected, info = acquire(
        POLICIES[name], KEY, ctx, 3, mode=mode, distance_filter=distance_filter
    )
    assert asked == set(np.flatnonzero(info.survivors).tolist())
    assert len(set(selected.tolist())) == 3 and set(selected.tolist()) <= asked - {5}


@informative
def test_greedy_avoids_a_view_that_repeats_a_pick(name):
    precision = np.full((NUM_VERTICES, 3), 0.1, np.float32)
    curvatures = np.zeros((3, NUM_VERTICES, 3), np.float32)
    curvatures[0, :6], curvatures[1, :6], curvatures[2, 6:8] = 2.0, 1.9, 1.0
    ctx = context(information_of(precision, curvatures), num=3)
    greedy, _ = acquire(POLICIES[name], KEY, ctx, 2)
    at_once, _ = acquire(POLICIES[name], KEY, ctx, 2, mode="top_k")
    assert (greedy.tolist(), at_once.tolist()) == ([0, 2], [0, 1])


@informative
def test_a_choice_leaves_its_context_as_it_was(name):
    precision, curvatures = toy(5)
    ctx = context(information_of(precision, curvatures))
    first, _ = acquire(POLICIES[name], KEY, ctx, 4)
    np.testing.assert_array_equal(ctx.information.precision, precision)
    np.testing.assert_array_equal(acquire(POLICIES[name], KEY, ctx, 4)[0], first)


@informative
def test_without_information_it_says_what_is_missing(name):
    with pytest.raises(SelectionError, match="information: this policy needs it"):
        acquire(POLICIES[name], KEY, context(None), 2)


@informative
def test_nan_in_the_curvature_is_found(name):
    precision, curvatures = toy(6)
    curvatures[2, 3, 1] = np.nan
    with pytest.raises(SelectionError, match=r"NaN for view ids \[2\]"):
        acquire(POLICIES[name], KEY, context(information_of(precision, curvatures)), 2)


# --- the bound -------------------------------------------------------------------------------


@pytest.mark.parametrize("overlap", [0.2, 0.5, 1.0])
def test_greedy_is_near_the_best_batch_and_the_bound_above_it(overlap):
    for seed, k in itertools.product(range(4), [1, 2, 4]):
        precision, curvatures = toy(seed, overlap=overlap)
        information = information_of(precision, curvatures)
        selected, _ = acquire(POLICIES["d_optimal"], KEY, context(information), k)
        best, _ = oracles.best_set(precision, curvatures, k)
        result = batch_upper_bound(information, selected, range(NUM))
        np.testing.assert_allclose(
            result.gain, oracles.log_det_of_set(precision, curvatures, selected), 1e-5
        )
        # Float32 gains: 1e-5 of slack.
        assert (1.0 - 1.0 / np.e) * best <= result.gain <= best * (1.0 + 1e-5)
        assert best * (1.0 - 1e-5) <= result.bound
        assert result.gain >= (1.0 - (1.0 - 1.0 / k) ** k) * result.bound * (1.0 - 1e-5)
        assert result.ratio == result.gain / result.bound <= 1.0


def test_the_bound_holds_for_any_batch_too():
    for seed in range(4):
        precision, curvatures = toy(seed)
        information = information_of(precision, curvatures)
        batch = np.random.default_rng(seed).permutation(NUM)[:3]
        best, _ = oracles.best_set(precision, curvatures, 3)
        assert batch_upper_bound(information, batch, range(NUM)).bound >= best * (1.0 - 1e-5)


def test_the_bound_is_tight_where_views_do_not_overlap():
    curvatures = np.zeros((NUM, NUM_VERTICES, 3), np.float32)
    curvatures[np.arange(NUM), np.arange(NUM)] = np.arange(1, NUM + 1)[:, None]
    information = information_of(np.ones((NUM_VERTICES, 3), np.float32), curvatures)
    selected, _ = acquire(POLICIES["d_optimal"], KEY, context(information), 3)
    result = batch_upper_bound(information, selected, range(NUM))
    np.testing.assert_allclose(result, [3.0 * np.log(10 * 9 * 8)] * 2 + [1.0], 1e-6)


def test_the_bound_of_all_candidates_and_of_empty_ones():
    precision, curvatures = toy(7)
    information = information_of(precision, curvatures)
    assert batch_upper_bound(information, np.arange(NUM), range(NUM)).ratio == 1.0
    nothing = information_of(precision, np.zeros_like(curvatures))
    assert batch_upper_bound(nothing, [0, 1], range(NUM)) == (0.0, 0.0, 1.0)


def test_a_pick_from_elsewhere_is_an_error():
    information = information_of(*toy(8))
    with pytest.raises(SelectionError, match=r"selected: \[7\] are not in candidates"):
        batch_upper_bound(information, [1, 7], range(5))
