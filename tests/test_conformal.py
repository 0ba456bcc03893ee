"""Split-conformal intervals against exact counting, closed forms, and their own guarantee."""

from fractions import Fraction

import numpy as np
import pytest

from bavs_jax.uncertainty.conformal import LEVELS, calibrate, half_width, interval
from bavs_jax.uncertainty.conformal_report import coverage_report, to_json
from bavs_jax.uncertainty.conformal_scale import (
    RELATIVE_FLOOR,
    SCALES,
    ViewErrors,
    evaluate_scale,
    fit_scale,
    weighted_quantile,
)
from tests.oracles_conformal import conformal_quantile_by_counting, isotonic_by_min_max
from tests.toy_errors import alike_views, differing_views

every_scale = pytest.mark.parametrize("scale", SCALES)


def mean_and_stderr(values):
    return np.mean(values, axis=0), np.std(values, axis=0, ddof=1) / np.sqrt(len(values))


# The factor of a level.


@pytest.mark.parametrize("seed", range(20))
def test_factors_equal_exact_counting(seed):
    rng = np.random.default_rng(seed)
    levels = [Fraction(k, 20) for k in range(1, 20)]
    views = []
    for size in rng.integers(1, 9, size=rng.integers(1, 8)):
        # Small integers, so that values tie within and between views.
        views.append(ViewErrors(rng.integers(0, 6, size).astype(float), np.ones(size)))
    calibrated = calibrate(views, views, scale="constant", levels=[float(one) for one in levels])
    expected = [conformal_quantile_by_counting([v.errors for v in views], one) for one in levels]
    np.testing.assert_array_equal(calibrated.constant_half_widths, expected)
    # The scale divides and multiplies: equal but for rounding.
    half = [half_width(calibrated, 3.0, float(one)) for one in levels]
    np.testing.assert_allclose(half, expected, rtol=1e-12)


def test_counting_by_hand():
    views = [[1.0, 2.0], [5.0]]
    # Weights 1/6 at 1 and 2, 1/3 at 5 and at infinity.
    for level, expected in (("1/6", 1), ("1/3", 2), ("2/5", 5), ("2/3", 5), ("7/10", np.inf)):
        assert conformal_quantile_by_counting(views, Fraction(level)) == expected


def test_weighted_quantile_by_hand():
    values, weights = np.array([3.0, 1.0, 2.0]), np.array([0.25, 0.5, 0.125])
    levels = [0.01, 0.5, 0.51, 0.625, 0.63, 0.875, 0.88]
    np.testing.assert_array_equal(
        weighted_quantile(values, weights, levels), [1, 1, 2, 2, 3, 3, np.inf]
    )


def test_uniform_errors_of_views_that_are_alike():
    # Errors uniform in (0, 1]: the quantile of `level` is level (V + 1) / V.
    views = alike_views(9, np.arange(1, 1001) / 1000.0)
    calibrated = calibrate(views, views, scale="uncertainty", levels=[0.45, 0.72, 0.9, 0.91])
    expected = np.array([0.5, 0.8, 1.0, np.inf])
    np.testing.assert_array_equal(calibrated.constant_half_widths, expected)
    # The uncertainty is 1 and its floor RELATIVE_FLOOR of that.
    np.testing.assert_allclose(calibrated.factors, expected / (1.0 + RELATIVE_FLOOR), rtol=1e-12)
    report = coverage_report(calibrated, views)
    np.testing.assert_allclose(report.coverage, [0.5, 0.8, 1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(report.coverage_stderr, 0.0, atol=1e-15)
    np.testing.assert_allclose(report.mean_width, 2.0 * expected, rtol=1e-12)
    np.testing.assert_allclose(report.width_ratio, [1.0, 1.0, 1.0, np.nan], rtol=1e-12)


@pytest.mark.parametrize("num_views, finite", [(1, 1), (3, 1), (4, 2), (8, 2), (9, 3), (19, 4)])
def test_too_few_views_have_infinite_intervals(num_views, finite):
    # A level is finite from V >= level / (1 - level) on: 1, 4, 9 and 19 views.
    views = differing_views(np.random.default_rng(0), num_views)
    calibrated = calibrate(views, views)
    np.testing.assert_array_equal(np.isfinite(calibrated.factors), np.arange(4) < finite)
    lower, upper = interval(calibrated, 0.4, 1.0, LEVELS[finite - 1])
    assert np.isfinite([lower, upper]).all()
    if finite < 4:
        assert interval(calibrated, 0.4, 1.0, LEVELS[finite]) == (-np.inf, np.inf)
        assert interval(calibrated, 0.4, 1.0, LEVELS[finite], bounds=(0.0, 1.0)) == (0.0, 1.0)
        report = to_json(coverage_report(calibrated, views))
        assert report["coverage"][finite:] == [1.0] * (4 - finite)
        assert report["mean_width"][finite:] == [None] * (4 - finite)


# The guarantee.


@every_scale
@pytest.mark.parametrize("num_views, levels", [(7, (0.3, 0.5, 0.8)), (25, LEVELS)])
def test_coverage_of_new_views_is_what_is_promised(scale, num_views, levels):
    rng = np.random.default_rng(0)
    num_pixels, coverages = 30, []
    for _ in range(400):
        views = differing_views(rng, 4 + num_views + 3, num_pixels=num_pixels)
        calibrated = calibrate(views[:4], views[4:-3], scale=scale, levels=levels)
        coverages.append(coverage_report(calibrated, views[-3:]).coverage)
    coverage, stderr = mean_and_stderr(coverages)
    # 4 standard errors over repetitions, each with views of its own.
    slack = 1.0 / (num_views + 1) + 1.0 / ((num_views + 1) * num_pixels)
    assert (coverage >= np.array(levels) - 4.0 * stderr).all()
    assert (coverage <= np.array(levels) + slack + 4.0 * stderr).all()
    assert (stderr < 0.015).all()


def test_coverage_of_views_of_a_single_pixel_is_known_exactly():
    # Then the rank of a new error among V + 1 is uniform: ceil(level (V + 1)) / (V + 1).
    rng, levels = np.random.default_rng(1), np.array([0.25, 0.5, 0.8])
    coverages = []
    for _ in range(400):
        views = differing_views(rng, 2 + 6 + 20, num_pixels=1)
        calibrated = calibrate(views[:2], views[2:8], scale="uncertainty", levels=levels)
        coverages.append(coverage_report(calibrated, views[8:]).coverage)
    coverage, stderr = mean_and_stderr(coverages)
    error = np.abs(coverage - np.ceil(levels * 7.0) / 7.0)
    assert (error < 4.0 * stderr).all() and (stderr < 0.02).all()


def test_a_quantile_of_pooled_pixels_covers_too_little_where_few_views_differ():
    # Three views of 30 pixels are not 90 pixels: the quantile of the pool promises what it cannot.
    # It holds nearly all of two views, and a new one is below the louder of two half the time.
    rng, level = np.random.default_rng(2), 0.65
    pooled, ours = [], []
    for _ in range(400):
        views = differing_views(rng, 2 + 3 + 20, spread=4.0)
        errors = [view.errors for view in views]
        rank = int(np.ceil(level * (3 * 30 + 1)))  # split-conformal, if pixels were exchangeable
        quantile = np.sort(np.concatenate(errors[2:5]))[rank - 1]
        pooled.append(np.mean(np.concatenate(errors[5:]) <= quantile))
        calibrated = calibrate(views[:2], views[2:5], scale="constant", levels=[level])
        ours.append(coverage_report(calibrated, views[5:]).coverage[0])
    (pooled, pooled_stderr), (ours, ours_stderr) = mean_and_stderr(pooled), mean_and_stderr(ours)
    assert pooled < level - 4.0 * pooled_stderr
    assert ours >= level - 4.0 * ours_stderr


def test_large_views_do_not_outvote_small_ones():
    quiet, loud = ViewErrors(np.full(1000, 0.1), np.ones(1000)), ViewErrors(np.ones(5), np.ones(5))
    views = [quiet, loud] * 3
    # Half the views are loud: 3 of 7 cover 0.42 of the weight, all six 0.85.
    calibrated = calibrate(views, views, scale="constant", levels=[0.4, 0.5, 0.8])
    np.testing.assert_allclose(calibrated.constant_half_widths, [0.1, 1.0, 1.0])
    report = coverage_report(calibrated, views)
    np.testing.assert_allclose(report.coverage, [0.5, 1.0, 1.0])
    # Standard error of 1, 0, 1, 0, 1, 0 by hand: sqrt(6 / 4 / 5 / 6).
    np.testing.assert_allclose(report.coverage_stderr, [np.sqrt(0.05), 0.0, 0.0])


# The scale.


def test_two_kinds_of_pixels_by_hand():
    # One half has errors uniform in (0, 1], the other in (0, 3]: divided by their means both are
    # uniform in (0, 2], so the mean half-width at p is 2 p; one for all must be 6 (p - 1/2).
    grid = np.arange(1, 1001) / 1000.0
    errors, uncertainty = np.append(grid, 3.0 * grid), np.repeat([4.0, 40.0], 1000)
    views = alike_views(9, errors, uncertainty)
    share = np.array([0.8, 0.9])
    calibrated = calibrate(views, views, levels=share * 9.0 / 10.0)
    # The floor and the grid, 1e-3 each.
    np.testing.assert_allclose(calibrated.scale.values, [0.5, 1.5], rtol=2e-3)
    np.testing.assert_array_equal(calibrated.scale.knots, [4.0, 40.0])
    report = coverage_report(calibrated, views)
    np.testing.assert_allclose(report.mean_width, 2.0 * 2.0 * share, rtol=3e-3)
    np.testing.assert_allclose(report.width_ratio, 2.0 * share / (6.0 * (share - 0.5)), rtol=3e-3)
    np.testing.assert_allclose(report.coverage, share, atol=1e-3)
    np.testing.assert_allclose(report.decile_coverage, share[:, None].repeat(10, 1), atol=2e-3)
    np.testing.assert_allclose(evaluate_scale(calibrated.scale, 22.0), 1.0, rtol=3e-3)
    for beyond, at in ((0.0, 4.0), (1e9, 40.0)):
        assert evaluate_scale(calibrated.scale, beyond) == evaluate_scale(calibrated.scale, at)


def test_isotonic_scale_is_the_regression_of_the_error_on_the_uncertainty():
    rng = np.random.default_rng(3)
    # Fewer pixels than bins: each is its own bin.
    errors, uncertainty = rng.exponential(size=20), rng.permutation(20.0 + np.arange(20))
    scale = fit_scale([ViewErrors(errors, uncertainty)], scale="isotonic")
    order = np.argsort(uncertainty)
    np.testing.assert_array_equal(scale.knots, uncertainty[order])
    np.testing.assert_allclose(
        scale.values, isotonic_by_min_max(errors[order], np.ones(20)), rtol=1e-12
    )
    # And with many: the mean error of each fiftieth, in the order of an error that only grows.
    grid = np.arange(5000.0)
    scale = fit_scale([ViewErrors(grid**2, grid)], scale="isotonic")
    np.testing.assert_allclose(scale.values, np.square(grid).reshape(50, 100).mean(1))
    np.testing.assert_allclose(scale.knots, grid.reshape(50, 100)[:, 49])


def test_error_that_falls_with_the_uncertainty_makes_the_isotonic_scale_constant():
    uncertainty = np.linspace(0.0, 1.0, 300)
    scale = fit_scale([ViewErrors(1.0 - uncertainty, uncertainty)], scale="isotonic")
    np.testing.assert_allclose(scale.values, 0.5)


@every_scale
def test_nothing_wrong_or_nothing_uncertain_stays_finite(scale):
    for errors, uncertainty in ((0.0, 1.0), (0.0, 0.0), (1.0, 0.0)):
        views = alike_views(20, np.full(5, errors), np.full(5, uncertainty))
        calibrated = calibrate(views, views, scale=scale)
        np.testing.assert_allclose(half_width(calibrated, uncertainty, 0.9), errors, rtol=1e-12)
        report = coverage_report(calibrated, views)
        # All pixels stand on the edge of their interval, and none may fall off by rounding.
        np.testing.assert_array_equal(report.coverage, 1.0)


# What must not matter.


@every_scale
def test_half_width_grows_with_the_level_and_the_uncertainty(scale):
    rng = np.random.default_rng(5)
    views = differing_views(rng, 40)
    calibrated = calibrate(views[:10], views[10:], scale=scale, levels=np.linspace(0.05, 0.95, 19))
    uncertainty = np.linspace(0.0, 30.0, 200)
    half = np.stack([half_width(calibrated, uncertainty, one) for one in calibrated.levels])
    assert (np.diff(half, axis=0) >= 0.0).all() and (np.diff(half, axis=1) >= 0.0).all()
    assert (half > 0.0).all() and (half[-1] > half[0]).all()


@every_scale
def test_order_of_views_and_pixels_does_not_matter(scale):
    rng = np.random.default_rng(6)
    views = differing_views(rng, 40)
    views = [ViewErrors(v.errors, np.round(v.uncertainty, 1)) for v in views]  # with ties

    def shuffled(views):
        for row in rng.permutation(len(views)):
            order = rng.permutation(30)
            yield ViewErrors(views[row].errors[order], views[row].uncertainty[order])

    def report(change):
        fit, calibration, test = (list(change(v)) for v in (views[:10], views[10:30], views[30:]))
        return coverage_report(calibrate(fit, calibration, scale=scale), test)

    for one, other in zip(report(shuffled), report(lambda same: same)):
        # Sums in another order.
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-15)


def test_the_isotonic_scale_does_not_depend_on_the_unit_of_the_uncertainty():
    views = differing_views(np.random.default_rng(7), 60, num_pixels=500)

    def calibrated_with(transform):
        changed = [ViewErrors(v.errors, transform(v.uncertainty)) for v in views]
        return calibrate(changed[:20], changed[20:]), changed

    plain, _ = calibrated_with(lambda u: u)
    uncertainty = np.linspace(0.0, 20.0, 500)
    half = half_width(plain, uncertainty, 0.9)

    linear, _ = calibrated_with(lambda u: 7.0 * u + 3.0)
    np.testing.assert_allclose(half_width(linear, 7.0 * uncertainty + 3.0, 0.9), half, rtol=1e-10)
    for transform in (np.square, np.sqrt, np.log1p):
        other, changed = calibrated_with(transform)
        # What is learned at the knots is the same; only lines between knots bend.
        np.testing.assert_allclose(other.scale.knots, transform(plain.scale.knots), rtol=1e-12)
        np.testing.assert_allclose(other.scale.values, plain.scale.values, rtol=1e-12)
        np.testing.assert_allclose(half_width(other, transform(uncertainty), 0.9), half, rtol=0.05)
        ratio = (
            coverage_report(other, changed).mean_width / coverage_report(plain, views).mean_width
        )
        np.testing.assert_allclose(ratio, 1.0, rtol=5e-3)


@every_scale
def test_errors_in_another_unit_give_intervals_in_that_unit(scale):
    views = differing_views(np.random.default_rng(8), 40)
    large = [ViewErrors(1000.0 * v.errors, v.uncertainty) for v in views]
    one, other = (calibrate(v[:10], v[10:], scale=scale) for v in (views, large))
    uncertainty = np.linspace(0.0, 5.0, 50)
    expected = 1000.0 * half_width(one, uncertainty, 0.8)
    np.testing.assert_allclose(half_width(other, uncertainty, 0.8), expected, rtol=1e-10)


# The interval.


def test_interval_of_depth_and_of_colour():
    views = alike_views(9, np.arange(1, 11) / 10.0)
    calibrated = calibrate(views, views, scale="constant", levels=[0.45])
    assert half_width(calibrated, 1.0, 0.45) == pytest.approx(0.5)
    lower, upper = interval(calibrated, [[2.0, 0.2]], [[1.0, 9.0]], 0.45)
    np.testing.assert_allclose((lower, upper), ([[1.5, -0.3]], [[2.5, 0.7]]))
    lower, upper = interval(calibrated, [2.0, 0.2], [1.0, 9.0], 0.45, bounds=(0.0, np.inf))
    np.testing.assert_allclose((lower, upper), ([1.5, 0.0], [2.5, 0.7]))
    rgb = np.array([[0.1, 0.5, 0.7], [1.0, 0.0, 0.2]])
    lower, upper = interval(calibrated, rgb, [1.0, 2.0], 0.45, bounds=(0.0, 1.0))
    np.testing.assert_allclose(lower, [[0.0, 0.0, 0.2], [0.5, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(upper, [[0.6, 1.0, 1.0], [1.0, 0.5, 0.7]])
    with pytest.raises(ValueError, match=r"prediction \(2, 3\): the uncertainty is \(3,\)"):
        interval(calibrated, rgb, [1.0, 2.0, 3.0], 0.45)


# Faults.

GOOD = ViewErrors(np.ones(3), np.ones(3))


@pytest.mark.parametrize(
    "fit, calibration, options, message",
    [
        ([], [GOOD], {}, "fit views: there are none"),
        ([GOOD], [], {}, "calibration views: there are none"),
        ([GOOD], [GOOD, ViewErrors(np.ones(0), np.ones(0))], {}, "calibration view 1: .*N > 0"),
        ([ViewErrors(np.ones(3), np.ones(2))], [GOOD], {}, r"fit view 0: errors \(3,\) and unc"),
        ([ViewErrors(np.ones((2, 2)), np.ones((2, 2)))], [GOOD], {}, "give one"),
        ([ViewErrors(np.array([np.nan]), np.ones(1))], [GOOD], {}, "fit view 0: errors: a value"),
        ([ViewErrors(np.array([-1.0]), np.ones(1))], [GOOD], {}, "errors: a value is negative"),
        ([GOOD], [ViewErrors(np.ones(1), np.array([np.inf]))], {}, "uncertainty: a value"),
        ([GOOD], [GOOD], {"scale": "linear"}, "'linear' is unknown; use one of isotonic"),
        ([GOOD], [GOOD], {"levels": []}, "give at least one"),
        ([GOOD], [GOOD], {"levels": [0.5, 1.0]}, "each in"),
    ],
)
def test_what_cannot_be_calibrated_is_an_error(fit, calibration, options, message):
    with pytest.raises(ValueError, match=message):
        calibrate(fit, calibration, **options)


def test_what_was_not_calibrated_is_an_error():
    calibrated = calibrate([GOOD], [GOOD], levels=[0.5, 0.9])
    with pytest.raises(ValueError, match=r"level 0.8: calibrated are \[0.5, 0.9\]"):
        half_width(calibrated, 1.0, 0.8)
    for uncertainty in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="finite and >= 0"):
            half_width(calibrated, uncertainty, 0.5)
    with pytest.raises(ValueError, match="test views: there are none"):
        coverage_report(calibrated, [])
