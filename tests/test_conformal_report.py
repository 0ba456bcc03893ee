"""Measures of calibrated intervals against plain loops, and the groups of views for them."""

import itertools
import json

import numpy as np
import pytest

from bavs_jax.uncertainty.conformal import LEVELS, calibrate, half_width
from bavs_jax.uncertainty.conformal_report import (
    coverage_report,
    interval_score,
    share_by_decile,
    to_json,
)
from bavs_jax.uncertainty.conformal_scale import SCALES, ViewErrors, split_views
from tests.toy_errors import differing_views


def test_report_equals_a_plain_loop():
    rng = np.random.default_rng(9)
    views = differing_views(rng, 40)
    calibrated = calibrate(views[:10], views[10:30])
    test = [ViewErrors(v.errors[: 5 + k], v.uncertainty[: 5 + k]) for k, v in enumerate(views[30:])]
    report = coverage_report(calibrated, test)
    assert (report.num_calibration_views, report.num_test_views) == (20, 10)
    for row, level in enumerate(LEVELS):
        shares, widths, scores = [], [], []
        for view in test:
            halves = [float(half_width(calibrated, u, level)) for u in view.uncertainty]
            shares.append(np.mean([e <= half for e, half in zip(view.errors, halves)]))
            widths.append(2.0 * np.mean(halves))
            missed_by = [max(e - half, 0.0) for e, half in zip(view.errors, halves)]
            scores.append(widths[-1] + 2.0 / (1.0 - level) * np.mean(missed_by))
        np.testing.assert_allclose(report.coverage[row], np.mean(shares))
        np.testing.assert_allclose(
            report.coverage_stderr[row], np.std(shares, ddof=1) / np.sqrt(10.0)
        )
        # Means over views, not over pixels: views differ in size here.
        np.testing.assert_allclose(report.mean_width[row], np.mean(widths))
        np.testing.assert_allclose(report.score[row], np.mean(scores))
        np.testing.assert_allclose(
            report.width_ratio[row], np.mean(widths) / (2.0 * calibrated.constant_half_widths[row])
        )


def test_interval_score_is_best_where_the_interval_holds_its_share():
    # Errors uniform in (0, 1): 2 h + (1 - h)^2 / (1 - level), smallest at h = level.
    errors, level = (np.arange(2000) + 0.5) / 2000.0, 0.8
    halves = np.linspace(0.0, 1.0, 101)
    scores = np.array([interval_score(errors, half, level).mean() for half in halves])
    # The grid of errors is within 1e-6 of the integral.
    np.testing.assert_allclose(scores, 2.0 * halves + 5.0 * (1.0 - halves) ** 2, atol=1e-5)
    assert halves[np.argmin(scores)] == pytest.approx(level)


def test_deciles_by_sorting_and_by_all_orders_of_ties():
    rng = np.random.default_rng(10)
    uncertainty, is_covered = rng.permutation(40.0 + np.arange(40)), rng.uniform(size=(2, 40)) < 0.7
    by_rank = is_covered[:, np.argsort(uncertainty)].reshape(2, 10, 4).mean(-1)
    np.testing.assert_allclose(share_by_decile(is_covered, uncertainty), by_rank)

    # Twenty pixels, two a tenth; those at 3, 4 and 5 are equal.
    covered, ranks = rng.uniform(size=20) < 0.5, np.arange(20.0)
    covered[3:6] = [True, False, False]
    tied = np.where((ranks > 2) & (ranks < 6), 3.0, ranks)
    orders = [np.r_[0:3, order, 6:20].astype(int) for order in itertools.permutations(range(3, 6))]
    expected = np.mean([covered[order].reshape(10, 2).mean(-1) for order in orders], axis=0)
    np.testing.assert_allclose(share_by_decile(covered[None], tied)[0], expected)
    # All equal, or fewer pixels than tenths: the same share everywhere.
    np.testing.assert_allclose(share_by_decile(covered[None], np.ones(20)), covered.mean())
    np.testing.assert_allclose(
        share_by_decile(np.array([[True, False]]), np.array([0.0, 1.0]))[0],
        np.repeat([1.0, 0.0], 5),
        atol=1e-12,
    )


def test_results_are_strict_json():
    views = differing_views(np.random.default_rng(11), 12)
    calibrated = calibrate(views[:3], views[3:11])
    report = to_json(coverage_report(calibrated, views[11:]))
    for value in (report, to_json(calibrated)):
        assert json.loads(json.dumps(value, allow_nan=False)) == value
    assert report["levels"] == list(LEVELS) and report["num_calibration_views"] == 8
    # One test view has no standard error, and eight views promise no 0.9.
    assert report["coverage_stderr"] == [None] * 4
    assert report["width_ratio"][2:] == [None, None] and report["width_ratio"][0] > 0.0
    assert to_json(calibrated)["scale"]["name"] == "isotonic"


def test_width_follows_errors_that_follow_the_uncertainty():
    rng = np.random.default_rng(4)
    views = differing_views(rng, 90, spread=0.1, num_pixels=400)
    reports = {
        scale: coverage_report(calibrate(views[:25], views[25:65], scale=scale), views[65:])
        for scale in SCALES
    }
    np.testing.assert_allclose(reports["constant"].width_ratio, 1.0, rtol=1e-12)
    # Errors grow as the root of the uncertainty: it is not the scale by itself, but what is learned
    # from it is. Learned ratios are 0.96, 0.87, 0.80 and 0.73; those of the other are above 1.
    assert (reports["isotonic"].score_ratio < 0.98).all()
    assert (reports["uncertainty"].score_ratio > 1.0).all()
    # Widths are shorter at high levels alone: at one half, the constant interval gives up on the
    # uncertain pixels, as the module says.
    assert (reports["isotonic"].width_ratio[2:] < 0.95).all()
    assert reports["isotonic"].width_ratio[0] > 1.0
    # The learned scale holds for the certain as for the uncertain, where one width for all does
    # not. 0.08 is five standard errors of a decile: 0.5 / sqrt(1000) from its 1000 pixels.
    nominal = np.array(LEVELS)[:, None]
    assert np.abs(reports["isotonic"].decile_coverage - nominal).max() < 0.08
    assert np.abs(reports["constant"].decile_coverage - nominal).max() > 0.2
    for report in reports.values():
        np.testing.assert_allclose(report.decile_coverage.mean(1), report.coverage, rtol=1e-12)
        assert (report.constant_coverage == reports["constant"].constant_coverage).all()


@pytest.mark.parametrize("seed", [None, 0, 1])
@pytest.mark.parametrize("shares", [(0.25, 0.5, 0.25), (0.1, 0.2, 0.7), (1 / 3, 1 / 3, 1 / 3)])
def test_groups_are_disjoint_complete_and_as_large_as_asked(seed, shares):
    for num in (10, 37, 200):
        views = 3 * np.arange(num)
        groups = split_views(views, seed=seed, shares=shares)
        np.testing.assert_array_equal(np.sort(np.concatenate(groups)), views)
        sizes = [len(group) for group in groups]
        # Within a view of the share.
        np.testing.assert_allclose(sizes, np.array(shares) * num, atol=1.0)


def test_an_interleaved_split_is_spread_over_the_order_and_a_random_one_is_its_seed():
    fit, calibration, test = split_views(range(100), seed=None)
    assert set(np.diff(fit)) == set(np.diff(test)) == {4}
    assert set(np.diff(calibration)) <= {1, 2, 3}
    one, same, other = (
        split_views(v, seed=s).test
        for v, s in ((range(100), 0), (range(99, -1, -1), 0), (range(100), 1))
    )
    np.testing.assert_array_equal(one, same)
    assert (one != other).any() and (one != test).any()


@pytest.mark.parametrize(
    "views, shares, message",
    [
        ([], (0.25, 0.5, 0.25), "0 are too few"),
        ([4, 5], (0.25, 0.5, 0.25), "2 are too few.*give more views"),
        (range(9), (0.02, 0.49, 0.49), "they would get"),
        ([1, 2, 2, 3], (0.25, 0.5, 0.25), "each view once"),
        (range(9), (0.5, 0.5, 0.0), "each > 0, sum 1"),
        (range(9), (0.5, 0.5), "give three"),
        (range(9), (0.5, 0.5, 0.5), "sum 1"),
    ],
)
def test_views_that_cannot_be_split_are_an_error(views, shares, message):
    with pytest.raises(ValueError, match=message):
        split_views(views, seed=None, shares=shares)
