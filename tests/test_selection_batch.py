"""The selector (Eq 15) and the driver of policies, on made-up scores."""

import itertools

import jax
import numpy as np
import pytest

from bavs_jax.selection import SelectionError
from bavs_jax.selection.batch import acquire, make_select_batch_fn, top_k
from bavs_jax.selection.context import make_context
from bavs_jax.selection.distances import Radii
from bavs_jax.selection.policies import POLICIES
from bavs_jax.selection.policy import Policy
from tests import oracles_selection as oracles

KEY = jax.random.key(0)
NUM = 20  # one size throughout, so that most tests share their compilations


def pool_context(seed, **changes):
    """A pool of NUM views on the unit sphere, 3 of them trained on, the others candidates."""
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(NUM, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    is_training = np.isin(np.arange(NUM), rng.permutation(NUM)[:3])
    options = {
        "training_positions": positions,
        "is_training_view": is_training,
        "mask": ~is_training,
        "view_ids": rng.permutation(100)[:NUM],
        "centre": np.zeros(3),
    }
    return make_context(positions, **{**options, **changes})


def policy_of(scores, **options):
    """A policy that gives fixed scores [C]."""
    options = {"update_fn": lambda ctx, index: ctx, **options}
    return Policy("fixed", "Fixed scores.", lambda key, ctx: np.asarray(scores), **options)


def random_scores(seed, *, ties):
    rng = np.random.default_rng(seed)
    return (rng.integers(0, 4, NUM) if ties else rng.normal(size=NUM)).astype(np.float32)


# --- top-k and the fused selector ------------------------------------------------------------


@pytest.mark.parametrize("ties", [True, False])
def test_top_k_against_the_slow_reference(ties):
    for seed, k in itertools.product(range(10), (1, 4)):
        ctx, scores = pool_context(seed), random_scores(seed, ties=ties)
        selected = top_k(scores, ctx.mask, ctx.view_ids, k=k)
        expected = oracles.top_k(scores, ctx.mask, ctx.view_ids, k)
        np.testing.assert_array_equal(selected, expected)


def test_top_k_takes_infinite_scores_and_signed_zeros_as_they_are():
    scores = np.array([-np.inf, 0.0, -0.0, np.inf, np.inf], np.float32)
    mask = np.array([True, True, True, True, False])
    selected = top_k(scores, mask, np.array([0, 9, 5, 3, 1]), k=4)
    # The zeros are equal, so the smaller id goes first; -inf is still a candidate.
    np.testing.assert_array_equal(selected, [3, 2, 1, 0])


@pytest.mark.parametrize("ties", [True, False])
@pytest.mark.parametrize("k", [1, 4, 17])
def test_fused_selector_against_the_slow_references(k, ties):
    select_batch_fn = make_select_batch_fn(k)
    for seed in range(15):
        ctx, scores = pool_context(seed), random_scores(seed, ties=ties)
        radii = Radii(0.7, 0.9)
        selected, survivors, info = select_batch_fn(scores, ctx, radii=radii)
        expected, shrinks, _ = oracles.max_min_filter(
            ctx.positions,
            ctx.training_positions[ctx.is_training_view],
            ctx.mask,
            k,
            view_ids=ctx.view_ids,
            radii=radii,
        )
        np.testing.assert_array_equal(survivors, expected)
        assert int(info.shrinks) == shrinks
        np.testing.assert_array_equal(selected, oracles.top_k(scores, expected, ctx.view_ids, k))


def test_fused_selector_and_driver_agree():
    for seed in range(10):
        ctx, scores = pool_context(seed), random_scores(seed, ties=False)
        fused, survivors, _ = make_select_batch_fn(4)(scores, ctx)
        driven, info = acquire(policy_of(scores, distance_filter=True), KEY, ctx, 4)
        np.testing.assert_array_equal(driven, fused)
        np.testing.assert_array_equal(info.survivors, survivors)
        np.testing.assert_array_equal(info.scores, np.where(survivors, scores, np.nan))


# --- the driver ------------------------------------------------------------------------------


def test_filter_goes_before_the_score():
    """The two best scores lie beside each other; the filter lets only one of them be scored."""
    positions = np.array([[0.0, 0, 10], [0.1, 0, 10], [10, 0, 0], [0, 10, 0]])
    asked = []

    def uncertainty(indices, picked):
        asked.extend(indices.tolist())
        return np.array([9.0, 8.0, 2.0, 1.0])[indices]

    ctx = make_context(
        positions,
        training_positions=np.array([[0.0, 0, -10]]),
        is_training_view=[True],
        centre=np.zeros(3),
        mean_uncertainty_fn=uncertainty,
    )
    together, _ = acquire(POLICIES["bavs_topk"], KEY, ctx, 2)
    np.testing.assert_array_equal(together, [0, 1])
    asked.clear()
    # Nearest-training distances are 20, 20.0002, 14.1, 14.1: candidate 1 is visited first.
    apart, info = acquire(POLICIES["bavs"], KEY, ctx, 2, radii=Radii(2.0, 2.0))
    np.testing.assert_array_equal(apart, [1, 2])
    assert asked == [1, 2, 3]
    np.testing.assert_array_equal(info.survivors, [False, True, True, True])
    np.testing.assert_array_equal(info.scores, [np.nan, 8.0, 2.0, 1.0])
    np.testing.assert_array_equal(info.selected_scores, [8.0, 2.0])
    np.testing.assert_allclose(
        info.nearest_training_distance,
        [np.hypot(20.0, 0.1), np.hypot(10.0, 10.0)],
        rtol=1e-6,  # float32
    )
    np.testing.assert_allclose(info.filter.radii, 2.0, rtol=1e-6)
    assert info.filter.num_survivors == 3


@pytest.mark.parametrize("share, fewest", [(0.17, 17), (0.5, 50), (0.02, 4)])
def test_by_default_the_filter_leaves_a_share_of_the_candidates(share, fewest):
    """Or as many as are picked: Table 4 of the paper leaves 43 of 250."""
    places = np.random.default_rng(1).normal(size=(100, 3))
    ctx = make_context(
        places / np.linalg.norm(places, axis=1, keepdims=True),
        training_positions=[[0.0, 0.0, 1.0]],
        is_training_view=[True],
        centre=np.zeros(3),
    )
    policy = policy_of(np.arange(100.0), distance_filter=True)
    _, info = acquire(policy, KEY, ctx, 4, survivor_share=share)
    assert fewest <= info.survivors.sum() <= 1.3 * fewest
    if share == 0.17:
        np.testing.assert_array_equal(acquire(policy, KEY, ctx, 4)[1].survivors, info.survivors)


def test_overlap_with_farthest_view_is_reported():
    # From 0, farthest-view goes to 16, 8, then 12 (4 away as 4 is, but of smaller id).
    ctx = make_context(
        [[x, 0.0, 0.0] for x in (4, 8, 12, 16)],
        training_positions=np.zeros((1, 3)),
        is_training_view=[True],
        centre=np.zeros(3),
        view_ids=[3, 2, 1, 0],
    )
    selected, info = acquire(policy_of([4.0, 3.0, 2.0, 1.0]), KEY, ctx, 2)
    np.testing.assert_array_equal(selected, [0, 1])
    assert info.farthest_overlap == 1  # of {4, 8} only 8 is among {16, 8}
    assert info.survivors_farthest_overlap == 4
    assert info.filter is None

    # Visited 16, 12, 8, 4: 5 apart leaves 16 and 8, all of them picks of farthest-view.
    _, info = acquire(
        policy_of([4.0, 3.0, 2.0, 1.0], distance_filter=True), KEY, ctx, 2, radii=Radii(1.0, 5.0)
    )
    np.testing.assert_array_equal(info.survivors, [False, True, False, True])
    assert (info.farthest_overlap, info.survivors_farthest_overlap) == (2, 2)


def test_greedy_scores_anew_after_each_pick():
    """Scores that an update lowers next to a pick: the second pick moves away."""
    scores = np.array([5.0, 4.0, 3.0, 2.0])

    def score(key, ctx):
        beside_pick = np.convolve(ctx.picked, [1, 0, 1], mode="same")
        return scores - 3.5 * beside_pick

    policy = Policy("apart", "Apart.", score, lambda ctx, index: ctx, mode="greedy")
    ctx = make_context(
        np.eye(4, 3),
        training_positions=np.ones((1, 3)),
        is_training_view=[True],
        centre=np.zeros(3),
    )
    selected, info = acquire(policy, KEY, ctx, 3)
    # After 0 the scores are -, 0.5, 3, 2; after 2 as well they are -, -3, -, -1.5.
    np.testing.assert_array_equal(selected, [0, 2, 3])
    np.testing.assert_array_equal(info.selected_scores, [5.0, 3.0, -1.5])
    np.testing.assert_array_equal(info.scores, scores)
    at_once, _ = acquire(policy, KEY, ctx, 3, mode="top_k")
    np.testing.assert_array_equal(at_once, [0, 1, 2])


def test_update_gets_the_marked_context_and_its_result_is_carried():
    seen = []

    def update(ctx, index):
        seen.append((index, ctx.mask[index], ctx.picked[index]))
        return ctx.replace(centre=ctx.centre + 1.0)

    def score(key, ctx):
        seen.append(float(ctx.centre[0]))
        return np.arange(NUM)

    ctx = pool_context(0)
    best, second = np.flatnonzero(ctx.mask)[::-1][:2]
    acquire(Policy("count", "Count.", score, update, mode="greedy"), KEY, ctx, 2)
    assert seen == [0.0, (best, False, True), 1.0, (second, False, True)]
    assert not ctx.picked.any()


def test_filter_and_mode_can_be_chosen_for_any_policy():
    ctx, scores = pool_context(3), random_scores(3, ties=False)
    radii, plain = Radii(0.7, 0.9), policy_of(scores)
    filtering = plain._replace(distance_filter=True)
    _, filtered = acquire(plain, KEY, ctx, 3, radii=radii, distance_filter=True)
    _, unfiltered = acquire(filtering, KEY, ctx, 3, radii=radii, distance_filter=False)
    assert 3 <= filtered.survivors.sum() < ctx.mask.sum()
    np.testing.assert_array_equal(unfiltered.survivors, ctx.mask)
    greedy, info = acquire(filtering, KEY, ctx, 3, radii=radii, mode="greedy")
    np.testing.assert_array_equal(info.survivors, filtered.survivors)
    np.testing.assert_array_equal(greedy, oracles.top_k(scores, info.survivors, ctx.view_ids, 3))


# --- errors ----------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0, NUM - 2])
def test_batch_size_out_of_range(k):
    ctx = pool_context(0)  # 17 candidates
    for choose in (
        lambda: acquire(policy_of(np.arange(NUM)), KEY, ctx, k),
        lambda: make_select_batch_fn(k)(np.arange(NUM), ctx),
    ):
        with pytest.raises(SelectionError, match=f"k: asked for {k} views, but 1 to 17"):
            choose()


def test_nan_score_of_a_candidate_is_an_error_that_names_it():
    ctx, scores = pool_context(0), random_scores(0, ties=False)
    index = np.flatnonzero(ctx.mask)[5]
    scores[index] = np.nan
    for choose in (
        lambda: acquire(policy_of(scores), KEY, ctx, 2),
        lambda: acquire(policy_of(scores), KEY, ctx, 2, mode="greedy"),
        lambda: make_select_batch_fn(2)(scores, ctx),
    ):
        with pytest.raises(SelectionError, match=rf"NaN for view ids \[{ctx.view_ids[index]}\]"):
            choose()


def test_nan_score_outside_of_the_candidates_is_no_matter():
    ctx, scores = pool_context(0), random_scores(0, ties=False)
    expected, _ = acquire(policy_of(scores), KEY, ctx, 4)
    selected, _ = acquire(policy_of(np.where(ctx.mask, scores, np.nan)), KEY, ctx, 4)
    np.testing.assert_array_equal(selected, expected)


def test_wrong_number_of_scores():
    with pytest.raises(SelectionError, match=r"scores: shape \(3,\), but it must be \(20,\)"):
        acquire(policy_of(np.zeros(3)), KEY, pool_context(0), 2)
    ctx = pool_context(0, mean_uncertainty_fn=lambda indices, picked: np.zeros((len(indices), 2)))
    with pytest.raises(SelectionError, match=r"\(17, 2\) for 17 candidates"):
        acquire(POLICIES["bavs_topk"], KEY, ctx, 2)


def test_missing_source():
    with pytest.raises(SelectionError, match="mean_uncertainty_fn: this policy needs it"):
        acquire(POLICIES["bavs"], KEY, pool_context(0), 2)


def test_greedy_without_update_and_unknown_mode():
    with pytest.raises(SelectionError, match="'random' has no update between picks"):
        acquire(POLICIES["random"], KEY, pool_context(0), 2, mode="greedy")
    with pytest.raises(SelectionError, match="mode: unknown 'best'; use one of top_k, greedy"):
        acquire(POLICIES["random"], KEY, pool_context(0), 2, mode="best")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.ones(3, bool)}, r"mask: shape \(3,\), but it must be \(20,\)"),
        ({"is_training_view": np.ones(3, bool)}, r"is_training_view: shape \(3,\)"),
        ({"centre": np.zeros(2)}, r"centre: shape \(2,\)"),
        ({"training_positions": np.full((NUM, 3), np.nan)}, "training_positions: not finite"),
        ({"view_ids": np.zeros(NUM)}, "view_ids: must be distinct"),
        ({"view_ids": np.arange(NUM) - 1}, "view_ids: must be distinct and >= 0"),
    ],
)
def test_context_is_checked(change, message):
    with pytest.raises(SelectionError, match=message):
        pool_context(0, **change)
