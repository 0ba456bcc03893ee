"""What is left to gain, on an additive curvature whose scores are known."""

import numpy as np

from bavs_jax.selection.worth import worth_along


class Toy:
    """C candidates that each see some of G vertices: score = mean standard deviation they see."""

    def __init__(self, num=30, num_vertices=40, seed=0):
        rng = np.random.default_rng(seed)
        self.seen = rng.uniform(size=(num, num_vertices)) < 0.2
        self.seen[:, 0] = True
        self.start = rng.uniform(0.1, 2.0, num_vertices)
        self.num_scored = 0

    def score(self, precision, indices):
        self.num_scored += len(indices)
        sigma = 1.0 / np.sqrt(precision)
        return np.array([sigma[self.seen[i]].mean() for i in indices])

    def add(self, precision, index):
        return precision + 1.5 * self.seen[index]

    def scores(self):
        return self.score(self.start, np.arange(len(self.seen)))


def plain_worth(toy, picks):
    """The same by scoring everything again after every pick."""
    state, left = toy.start, np.ones(len(toy.seen), bool)
    picked, best = [], [toy.scores().max()]
    for pick in picks:
        picked.append(toy.score(state, [pick])[0])
        state, left[pick] = toy.add(state, pick), False
        best.append(toy.score(state, np.flatnonzero(left)).max() if left.any() else np.nan)
    return np.array(picked), np.array(best)


def test_equals_scoring_everything_again_with_fewer_scores():
    for seed in range(5):
        toy = Toy(seed=seed)
        scores = toy.scores()
        picks = np.argsort(-scores)[:8]
        expected = plain_worth(toy, picks)
        toy.num_scored = 0
        got = worth_along(toy.start, picks, scores, add_fn=toy.add, score_fn=toy.score)
        np.testing.assert_allclose(got.picked, expected[0])
        np.testing.assert_allclose(got.best_left, expected[1])
        assert toy.num_scored < 8 * len(toy.seen) / 2


def test_never_above_the_first_and_never_rising():
    toy = Toy(seed=7)
    scores = toy.scores()
    picks = np.argsort(-scores)[:12]
    got = worth_along(toy.start, picks, scores, add_fn=toy.add, score_fn=toy.score)
    assert (np.diff(got.best_left) <= 1e-12).all()
    assert (got.best_left <= got.picked[0] + 1e-12).all()
    assert got.best_left[-1] < got.picked[0]


def test_candidates_that_are_not_allowed_or_used_up_do_not_count():
    toy = Toy(num=6)
    scores = toy.scores()
    best = int(np.argmax(scores))
    masked = np.where(np.arange(6) == best, np.nan, scores)
    others = [i for i in range(6) if i != best]
    got = worth_along(toy.start, others, masked, add_fn=toy.add, score_fn=toy.score)
    np.testing.assert_allclose(got.best_left[0], np.nanmax(masked))
    assert np.isnan(got.best_left[-1]) and np.isfinite(got.best_left[:-1]).all()
