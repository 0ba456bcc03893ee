"""AUSE against closed forms, every order of six pixels, and a plain reference."""

import itertools

import numpy as np
import pytest

from bavs_jax.metrics.ause import (
    ERRORS,
    mean_sparsification,
    removal_fractions,
    sparsification,
    sparsification_curve,
    variant_name,
)

every_error = pytest.mark.parametrize("error", ERRORS)
SIX = np.array([0.1, 0.9, 0.4, 0.2, 0.7, 0.5])


def plain_curve(errors, order_by, fractions, error):
    """Sorts, cuts and averages, a fraction at a time; for values that all differ."""
    kept_first = [e for _, e in sorted(zip(order_by, errors))]
    curve = []
    for fraction in fractions:
        kept = kept_first[: int(np.ceil(round((1 - fraction) * len(errors), 9)))]
        value = np.mean(kept) if error == "mae" else np.mean(np.square(kept))
        curve.append(np.sqrt(value) if error == "rmse" else value)
    return np.array(curve)


@every_error
@pytest.mark.parametrize("num", [1, 6, 100, 357])
def test_curve_equals_a_plain_loop(error, num):
    rng = np.random.default_rng(num)
    errors, uncertainty = rng.exponential(size=(2, num))
    fractions = removal_fractions()
    curve = sparsification_curve(errors, uncertainty, fractions, error=error)
    np.testing.assert_allclose(curve, plain_curve(errors, uncertainty, fractions, error))


def test_curve_by_hand():
    # Two pixels of error 1 and 3: both left up to one half, then the one that is kept.
    for order, last in (([0, 1], 1.0), ([1, 0], 3.0)):
        curve = sparsification_curve([1.0, 3.0], order, [0.0, 0.49, 0.5, 0.99])
        np.testing.assert_allclose(curve, [2.0, 2.0, last, last])
    curve = sparsification_curve([1.0, 3.0], [0, 1], [0.0, 0.5], error="rmse")
    np.testing.assert_allclose(curve, [np.sqrt(5.0), 1.0])


@every_error
@pytest.mark.parametrize("pooled", [True, False])
def test_a_perfect_uncertainty_has_an_ause_of_0(error, pooled):
    rng = np.random.default_rng(0)
    # Any growing function of the error is perfect; pooled, it must be the same one for all images.
    images = [(e, np.exp(3.0 * e) - 7.0) for e in rng.uniform(size=(3, 50))]
    result = mean_sparsification(images, error=error, pooled=pooled)
    assert result.ause == result.ause_unnormalised == 0.0


@every_error
def test_an_inverted_uncertainty_is_the_worst_of_all_orders_unnormalised(error):
    orders = [np.array(p, float) for p in itertools.permutations(range(6))]
    areas = [sparsification(SIX, order, error=error).ause_unnormalised for order in orders]
    inverted = sparsification(SIX, -SIX, error=error).ause_unnormalised
    np.testing.assert_allclose(max(areas), inverted)
    assert min(areas) == 0.0 and (np.array(areas) >= 0.0).all()
    perfect = sparsification(SIX, SIX, error=error)
    assert perfect.ause == 0.0


def test_under_the_joint_maximum_another_order_can_score_worse_than_the_inverted_one():
    # Why the unnormalised value always stands beside it: the maximum grows with the curve.
    errors = np.array([0.0, 0.0, 0.0, 0.0, 0.2, 1.0])
    areas = [
        sparsification(errors, np.array(p, float)).ause for p in itertools.permutations(range(6))
    ]
    assert max(areas) > sparsification(errors, -errors).ause + 1e-3


@every_error
def test_equal_uncertainties_are_the_mean_over_their_orders_and_of_rmse_its_root(error):
    uncertainty = np.array([0.0, 1.0, 1.0, 1.0, 2.0, 2.0])
    fractions = removal_fractions(12)
    power = 1 if error == "mae" else 2
    curves = []
    for tie_order in itertools.permutations(range(6)):
        curve = plain_curve(SIX**power, uncertainty + 1e-3 * np.array(tie_order), fractions, "mae")
        curves.append(curve)
    expected = np.mean(curves, axis=0)
    got = sparsification_curve(SIX, uncertainty, fractions, error=error)
    if error == "rmse":
        mean_of_roots = np.mean(np.sqrt(curves), axis=0)
        assert (mean_of_roots <= got + 1e-12).all() and (mean_of_roots < got - 1e-3).any()
        expected = np.sqrt(expected)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    for seed in range(3):
        shuffle = np.random.default_rng(seed).permutation(6)
        again = sparsification_curve(SIX[shuffle], uncertainty[shuffle], fractions, error=error)
        np.testing.assert_allclose(again, got, rtol=1e-12)


def test_a_constant_uncertainty_keeps_the_mean_error():
    result = sparsification(SIX, np.full(6, 3.0))
    np.testing.assert_allclose(result.by_uncertainty, SIX.mean())
    assert result.ause > 0.0


def test_only_the_order_of_the_uncertainty_counts_and_the_scale_of_errors_cancels():
    rng = np.random.default_rng(1)
    errors, uncertainty = rng.uniform(size=(2, 400))
    one = sparsification(errors, uncertainty)
    other = sparsification(5.0 * errors, np.log(uncertainty))
    np.testing.assert_allclose(other.ause, one.ause)
    np.testing.assert_allclose(other.ause_unnormalised, 5.0 * one.ause_unnormalised)


def test_pooled_and_per_image_differ_where_images_do():
    quiet, loud = np.linspace(0.0, 0.1, 50), np.linspace(0.0, 1.0, 50)
    # Right within each image, wrong between them.
    images = [(quiet, 10.0 + quiet), (loud, loud)]
    assert mean_sparsification(images).ause == 0.0
    assert mean_sparsification(images, pooled=True).ause > 0.1
    single = [(SIX, np.arange(6.0))]
    alone, pooled = (mean_sparsification(single, pooled=p).ause for p in (False, True))
    assert alone == pooled > 0.0


def test_nothing_wrong_anywhere_is_0():
    result = sparsification(np.zeros(5), np.arange(5))
    assert result.ause == result.ause_unnormalised == 0.0


@pytest.mark.parametrize(
    "errors, uncertainty, error, message",
    [
        ([], [], "mae", "N > 0"),
        ([1.0], [1.0, 2.0], "mae", "give one"),
        ([np.nan], [1.0], "mae", "not finite"),
        ([1.0], [np.inf], "mae", "not finite"),
        ([1.0], [1.0], "mxe", "'mxe' is unknown"),
    ],
)
def test_what_cannot_be_measured_is_an_error(errors, uncertainty, error, message):
    with pytest.raises(ValueError, match=message):
        sparsification(errors, uncertainty, error=error)
    with pytest.raises(ValueError, match="there are none"):
        mean_sparsification([])


def test_names_say_the_variant():
    names = [
        variant_name(of=of, error=error, pooled=pooled)
        for of, error, pooled in itertools.product(("depth", "colour"), ERRORS, (True, False))
    ]
    assert len(set(names)) == 12 and names[1] == "depth_mae_per_image"
