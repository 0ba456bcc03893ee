"""One battery that every policy of the table passes, then what is special to each."""

import itertools
from functools import partial

import jax
import numpy as np
import pytest

from bavs_jax.selection import SelectionError, policies
from bavs_jax.selection.batch import acquire
from bavs_jax.selection.context import make_context
from bavs_jax.selection.directional import DirectionalInformation, Look, make_precision_fn
from bavs_jax.selection.distances import pairwise_distances
from bavs_jax.selection.gaps import ViewGaps
from bavs_jax.selection.information import Information, make_cached_curvature_fn, sparse_curvature
from bavs_jax.selection.policies import POLICIES, get_policy
from bavs_jax.selection.policies.distance import farthest_score
from bavs_jax.selection.policy import MODES
from bavs_jax.selection.targets import TargetInformation
from tests import oracles_selection as oracles

KEY = jax.random.key(0)
NUM, NUM_CANDIDATES = 24, 20  # one size throughout, so that tests share their compilations
NUM_VERTICES = 40

every_policy = pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)


def curvature_sources(view_ids, *, ties):
    """Stands in for the renders: an uncertainty that depends on the view alone."""

    def mean_uncertainty(indices, picked):
        ids = np.asarray(view_ids)[indices]
        return np.zeros(len(ids)) if ties else np.random.default_rng(7).permutation(100)[ids] / 100

    return {"mean_uncertainty_fn": mean_uncertainty}


def information_sources(view_ids, *, ties):
    """Stands in for the curvature of the renders: a sparse one that depends on the view alone."""
    prior = np.full((NUM_VERTICES, 3), 0.1, np.float32)
    return {"information": Information(prior, view_curvature_fn(view_ids, ties=ties))}


def view_curvature_fn(view_ids, *, ties):
    def one(index):
        rng = np.random.default_rng(0 if ties else int(view_ids[index]))
        return rng.exponential(size=(NUM_VERTICES, 3)) * (rng.uniform(size=(NUM_VERTICES, 1)) < 0.3)

    def dense(indices):
        return np.stack([one(index) for index in indices])

    return make_cached_curvature_fn(dense, num_vertices=NUM_VERTICES, max_bytes=2**20)


def directional_sources(view_ids, *, ties):
    """The same from places that depend on the view alone; one look has been taken."""
    curvature_fn = view_curvature_fn(view_ids, ties=ties)

    def place(index):
        rng = np.random.default_rng(0 if ties else int(view_ids[index]))
        return rng.normal(size=3).astype(np.float32) * 3.0

    def look_fn(indices):
        for index, (rows, h) in zip(indices, curvature_fn(indices)):
            yield Look(rows, h, place(index))

    vertices = np.random.default_rng(1).uniform(-1.0, 1.0, (NUM_VERTICES, 3))
    first = Look(*sparse_curvature(np.ones((NUM_VERTICES, 3))), np.float32([0.0, 0.0, 4.0]))
    precision_fn = make_precision_fn(look_fn, vertices, prior=0.1)
    return {"directional": DirectionalInformation((first,), look_fn, precision_fn)}


def target_sources(view_ids, *, ties):
    """The same of three targets, which are known from one look."""
    known = directional_sources(view_ids, ties=ties)["directional"]
    rng, vertices = (
        np.random.default_rng(2),
        np.random.default_rng(1).uniform(-1.0, 1.0, (NUM_VERTICES, 3)),
    )
    targets = [
        Look(*sparse_curvature(rng.exponential(size=(NUM_VERTICES, 3))), place)
        for place in 3.0 * rng.normal(size=(3, 3)).astype(np.float32)
    ]

    def target_fn(numbers):
        return (targets[number] for number in numbers)

    return {
        "targets": TargetInformation(
            looks=known.looks,
            look_fn=known.look_fn,
            target_fn=target_fn,
            precision_fn=make_precision_fn(target_fn, vertices, prior=0.1),
            num_values=np.array([30, 60, 90]),
            vertices=vertices,
        )
    }


def gap_sources(view_ids, *, ties):
    """How near by candidates would see four pixels of three targets, one of which is empty."""

    def closeness(index):
        rng = np.random.default_rng(0 if ties else int(view_ids[index]))
        return rng.exponential(size=(3, 4)) * (rng.uniform(size=(3, 4)) < 0.7)

    rng = np.random.default_rng(3)
    return {
        "gaps": ViewGaps(
            known=np.full((3, 4), 0.1) + rng.exponential(size=(3, 4)),
            closeness=np.stack([closeness(index) for index in range(len(view_ids))]),
            pixel_weight=rng.uniform(size=(3, 4)) * np.array([[1.0], [0.0], [1.0]]),
            target_weight=np.array([1.0, 0.5, 0.3]),
        )
    }


def true_error_sources(view_ids, *, ties):
    """Stands in for photos of the candidates."""
    fn = curvature_sources(view_ids, ties=ties)["mean_uncertainty_fn"]
    return {"true_error_fn": lambda indices: fn(indices, None)}


# What a caller makes for each word in `needs`: (view_ids, *, ties) -> fields of `Context`.
SOURCES = {
    "mean_uncertainty_fn": curvature_sources,
    "information": information_sources,
    "directional": directional_sources,
    "targets": target_sources,
    "gaps": gap_sources,
    "true_error_fn": true_error_sources,
}


def pool_context(policy, *, seed=0, num_training=NUM - NUM_CANDIDATES, order=None, ties=False):
    """A pool on a sphere, its first views trained on; `order` permutes the candidates.

    With `ties` all lies on the 6 corners of an octahedron and every uncertainty is the same.
    """
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(NUM, 3))
    positions /= np.linalg.norm(positions, axis=1, keepdims=True)
    if ties:
        positions = np.concatenate([np.eye(3), -np.eye(3)])[rng.integers(0, 6, NUM)]
    view_ids, order = rng.permutation(100)[:NUM], np.arange(NUM) if order is None else order
    sources = {}
    for need in policy.needs:
        sources |= SOURCES[need](view_ids[order], ties=ties)
    return make_context(
        positions[order],
        training_positions=positions,
        is_training_view=np.arange(NUM) < num_training,
        centre=np.zeros(3),
        view_ids=view_ids[order],
        mask=(np.arange(NUM) >= num_training)[order],
        **sources,
    )


@pytest.fixture
def traces():
    """Names of the tracing events of JAX while the test runs; clear it to start anew."""
    events = []

    def listen(event, duration, **kwargs):
        del duration, kwargs
        if event.endswith("jaxpr_trace_duration"):
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield events
    jax.monitoring.unregister_event_duration_listener(listen)


# --- the battery -----------------------------------------------------------------------------


@every_policy
def test_declares_itself(policy):
    assert policy.summary.endswith(".")
    assert "\n" not in policy.summary
    assert policy.mode in MODES
    assert policy.needs <= SOURCES.keys(), "give the battery a stand-in for the new need"


@every_policy
@pytest.mark.parametrize("distance_filter", [True, False])
def test_picks_only_candidates_and_none_twice(policy, distance_filter):
    for seed, ties, k in itertools.product(range(3), [True, False], [1, 5]):
        ctx = pool_context(policy, seed=seed, ties=ties)
        selected, info = acquire(policy, KEY, ctx, k, distance_filter=distance_filter)
        assert len(set(selected.tolist())) == len(selected) == k
        assert ctx.mask[selected].all()
        assert info.survivors[selected].all()


@every_policy
def test_one_view_is_the_argmax_of_the_survivors(policy):
    for seed in range(5):
        ctx = pool_context(policy, seed=seed)
        selected, info = acquire(policy, KEY, ctx, 1)
        np.testing.assert_array_equal(np.isfinite(info.scores), info.survivors)
        assert selected.tolist() == [np.nanargmax(info.scores)]
        assert info.selected_scores[0] == np.nanmax(info.scores)


@every_policy
def test_same_key_same_views(policy):
    ctx = pool_context(policy)
    first, _ = acquire(policy, KEY, ctx, 5)
    again, _ = acquire(policy, KEY, ctx, 5)
    np.testing.assert_array_equal(first, again)


@every_policy
def test_other_keys_give_other_views_where_it_is_random_only(policy):
    ctx = pool_context(policy)
    batches = {tuple(acquire(policy, jax.random.key(s), ctx, 5)[0].tolist()) for s in range(6)}
    assert len(batches) == (6 if policy.stochastic else 1)


@every_policy
@pytest.mark.parametrize("ties", [True, False])
def test_order_of_candidates_does_not_matter(policy, ties):
    ctx = pool_context(policy, ties=ties)
    selected, _ = acquire(policy, KEY, ctx, 6)
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(NUM)
        permuted = pool_context(policy, ties=ties, order=order)
        reselected, _ = acquire(policy, KEY, permuted, 6)
        np.testing.assert_array_equal(permuted.view_ids[reselected], ctx.view_ids[selected])


@every_policy
@pytest.mark.parametrize("ties", [True, False])
def test_all_candidates_can_be_wanted(policy, ties):
    ctx = pool_context(policy, ties=ties)
    selected, _ = acquire(policy, KEY, ctx, NUM_CANDIDATES)
    np.testing.assert_array_equal(np.sort(selected), np.flatnonzero(ctx.mask))


@every_policy
def test_more_than_all_is_an_error(policy):
    with pytest.raises(SelectionError, match="asked for 21 views, but 1 to 20 can be picked"):
        acquire(policy, KEY, pool_context(policy), NUM_CANDIDATES + 1)


@every_policy
def test_nothing_is_traced_anew_while_views_grow(policy, traces):
    def one_round(num_training):
        # Every round has its own key and its own closures, as in the loop.
        ctx = pool_context(policy, num_training=num_training)
        acquire(policy, jax.random.key(num_training), ctx, 3)

    jax.clear_caches()
    one_round(4)
    assert traces, "the listener must see the first round"
    traces.clear()
    for num_training in (5, 9, 20):
        one_round(num_training)
    assert not traces


# --- random ----------------------------------------------------------------------------------


def test_random_is_uniform():
    policy, ctx = POLICIES["random"], pool_context(POLICIES["random"])
    num_draws = 400
    counts = np.zeros(NUM)
    for seed in range(num_draws):
        counts[acquire(policy, jax.random.key(seed), ctx, 5)[0]] += 1
    rate = 5 / NUM_CANDIDATES
    error = np.sqrt(num_draws * rate * (1 - rate))
    # 4.5 standard errors over 20 candidates: one false alarm in 7000, and the seeds are fixed.
    assert np.abs(counts[ctx.mask] - num_draws * rate).max() < 4.5 * error
    assert counts[~ctx.mask].sum() == 0


# --- farthest --------------------------------------------------------------------------------


@pytest.mark.parametrize("ties", [True, False])
def test_farthest_against_the_slow_reference(ties):
    policy = POLICIES["farthest"]
    for seed in range(10):
        ctx = pool_context(policy, seed=seed, ties=ties)
        selected, info = acquire(policy, KEY, ctx, 6)
        training = ctx.training_positions[ctx.is_training_view]
        expected = oracles.farthest_order(
            ctx.positions, training, ctx.mask, 6, view_ids=ctx.view_ids
        )
        assert selected.tolist() == expected
        assert info.farthest_overlap == 6


def test_farthest_is_at_least_half_as_spread_as_the_best_batch():
    """Greedy farthest-view reaches 1/2 of the largest least distance of any batch."""
    policy = POLICIES["farthest"]
    for seed in range(5):
        ctx = pool_context(policy, seed=seed, num_training=12)
        training = list(ctx.training_positions[ctx.is_training_view])

        def spread(batch, ctx=ctx, training=training):
            points = [ctx.positions[i] for i in batch]
            return min(
                oracles.nearest_distance(p, training + points[:i]) for i, p in enumerate(points)
            )

        best = max(spread(b) for b in itertools.combinations(np.flatnonzero(ctx.mask), 3))
        selected, _ = acquire(policy, KEY, ctx, 3)
        assert best / 2 <= spread(selected) <= best + 1e-6  # float32 against float64


def test_farthest_takes_another_distance():
    """On the great circle height does not matter: far above a training view is still near it."""

    def great_circle(a, b, centre):
        a, b = a - centre, b - centre
        cosine = (a @ b.T) / (np.linalg.norm(a, axis=1)[:, None] * np.linalg.norm(b, axis=1))
        return np.arccos(np.clip(cosine, -1.0, 1.0))

    ctx = make_context(
        [[1.0, 0.0, 9.0], [1.0, 1.0, 0.0]],
        training_positions=[[1.0, 0.0, 1.0]],
        is_training_view=[True],
        centre=[1.0, 0.0, 0.0],
    )
    straight, _ = acquire(POLICIES["farthest"], KEY, ctx, 1)
    arc = POLICIES["farthest"]._replace(score_fn=partial(farthest_score, distance=great_circle))
    bent, _ = acquire(arc, KEY, ctx, 1)
    assert (straight.tolist(), bent.tolist()) == ([0], [1])


def test_farthest_scores_are_distances_to_what_is_chosen():
    ctx = pool_context(POLICIES["farthest"])
    selected, info = acquire(POLICIES["farthest"], KEY, ctx, 4)
    chosen = np.concatenate([ctx.training_positions[ctx.is_training_view], ctx.positions[selected]])
    for step, index in enumerate(selected):
        expected = pairwise_distances(ctx.positions[index][None], chosen[: 4 + step]).min()
        np.testing.assert_allclose(info.selected_scores[step], expected, rtol=1e-6)  # float32


# --- spread ----------------------------------------------------------------------------------


def squared_distance_left(ctx, batch) -> float:
    """Mean over all candidates of the squared distance to the nearest chosen view."""
    chosen = [*ctx.training_positions[ctx.is_training_view], *ctx.positions[list(batch)]]
    return np.mean([oracles.nearest_distance(p, chosen) ** 2 for p in ctx.positions])


def test_spread_scores_are_what_the_mean_squared_distance_falls_by():
    ctx = pool_context(POLICIES["spread"])
    selected, info = acquire(POLICIES["spread"], KEY, ctx, 4)
    left = [squared_distance_left(ctx, selected[:n]) for n in range(5)]
    np.testing.assert_allclose(info.selected_scores, -np.diff(left), rtol=1e-4)  # float32


def test_spread_comes_near_the_best_batch():
    """What has fallen is monotone and submodular: greedy reaches 1 - 1/e of the most."""
    for seed in range(3):
        ctx = pool_context(POLICIES["spread"], seed=seed, num_training=12)
        start = squared_distance_left(ctx, [])
        batches = itertools.combinations(np.flatnonzero(ctx.mask), 3)
        best = max(start - squared_distance_left(ctx, batch) for batch in batches)
        selected, _ = acquire(POLICIES["spread"], KEY, ctx, 3)
        gained = start - squared_distance_left(ctx, selected)
        assert (1.0 - 1.0 / np.e) * best <= gained <= best + 1e-6  # float32 against float64


def test_spread_without_any_view_begins_in_the_middle():
    line = np.stack([np.arange(5.0), np.zeros(5), np.zeros(5)], -1)
    ctx = make_context(
        line,
        training_positions=np.zeros((1, 3)),
        is_training_view=[False],
        centre=np.zeros(3),
    )
    selected, _ = acquire(POLICIES["spread"], KEY, ctx, 1)
    assert selected.tolist() == [2]


@pytest.mark.parametrize(
    "name, first, second",
    [
        ("bavs_spread", "spread", "directional"),
        ("farthest_informative", "farthest", "directional"),
        ("target_spread", "spread", "target_information_log"),
        ("bavs_gaps", "target_gaps", "directional"),
    ],
)
def test_products_of_two_scores(name, first, second):
    ctx = pool_context(POLICIES[name])
    parts = [POLICIES[part].score_fn(KEY, ctx) for part in (first, second)]
    expected = np.asarray(parts[0], np.float64) * parts[1]
    _, info = acquire(POLICIES[name], KEY, ctx, 1)
    np.testing.assert_allclose(info.scores[ctx.mask], expected[ctx.mask], rtol=1e-5)


# --- bavs ------------------------------------------------------------------------------------


def test_bavs_differs_from_bavs_topk_by_the_filter_alone():
    for seed in range(5):
        ctx = pool_context(POLICIES["bavs"], seed=seed)
        with_filter, info = acquire(POLICIES["bavs"], KEY, ctx, 4)
        top_of_survivors, _ = acquire(
            POLICIES["bavs_topk"], KEY, ctx.replace(mask=info.survivors), 4
        )
        np.testing.assert_array_equal(with_filter, top_of_survivors)
        same, _ = acquire(POLICIES["bavs"], KEY, ctx, 4, distance_filter=False)
        np.testing.assert_array_equal(same, acquire(POLICIES["bavs_topk"], KEY, ctx, 4)[0])
        assert 4 <= info.survivors.sum() < NUM_CANDIDATES


# --- the table -------------------------------------------------------------------------------


def test_the_table_knows_the_policies():
    assert {"random", "farthest", "bavs_topk", "bavs"} <= POLICIES.keys()
    assert get_policy("bavs") is POLICIES["bavs"]


def test_unknown_policy_names_the_nearest_and_all():
    with pytest.raises(
        SelectionError, match="unknown name 'farthst'; did you mean 'farthest'"
    ) as e:
        get_policy("farthst")
    assert all(name in str(e.value) for name in POLICIES)
    with pytest.raises(SelectionError, match="unknown name 'zzz'; known: "):
        get_policy("zzz")


def test_a_new_file_registers_itself(tmp_path, monkeypatch):
    (tmp_path / "first_id.py").write_text(
        "from bavs_jax.selection.policy import Policy\n"
        "POLICIES = (Policy('first_id', 'Smallest id.', lambda key, ctx: -ctx.view_ids),)\n"
    )
    monkeypatch.setattr(policies, "__path__", [*policies.__path__, str(tmp_path)])
    table = policies.collect_policies()
    assert table.keys() == POLICIES.keys() | {"first_id"}
    ctx = pool_context(table["first_id"])
    selected, _ = acquire(table["first_id"], KEY, ctx, 3)
    np.testing.assert_array_equal(ctx.view_ids[selected], np.sort(ctx.view_ids[ctx.mask])[:3])


@pytest.mark.parametrize(
    "text, message",
    [
        ("", r"must hold POLICIES = \(Policy\(name=..., ...\),\)"),
        ("POLICIES = ()\n", "must hold POLICIES"),
        ("POLICIES = ('bavs',)\n", "must hold POLICIES"),
        ("from bavs_jax.selection.policies.distance import POLICIES\n", "'farthest' is taken"),
    ],
)
def test_a_file_without_policies_of_its_own_is_an_error(tmp_path, monkeypatch, text, message):
    name = f"wrong_{len(text)}"  # imported modules are remembered by name
    (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr(policies, "__path__", [*policies.__path__, str(tmp_path)])
    with pytest.raises(SelectionError, match=rf"policies/{name}.py: .*{message}"):
        policies.collect_policies()
