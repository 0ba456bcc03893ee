"""Baselines by hand on images of one colour."""

import dataclasses

import numpy as np
import pytest

from experiments.evaluate import image_psnr, mean_quality, measure_baselines
from tests.toy_scenes import toy_scene


def flat_scene(levels, positions):
    """Views of one grey level each, at given distances along a line."""
    scene = toy_scene(num_views=len(levels), num_test=1)
    poses = np.array(scene.cameras.world_from_cam)
    poses[:, :, 3] = 0.0
    poses[:, 0, 3] = positions
    pixels = np.repeat(np.asarray(levels, np.uint8), 64)[:, None].repeat(3, axis=1)
    cameras = scene.cameras.replace(world_from_cam=poses)
    return dataclasses.replace(scene, pixels=pixels, cameras=cameras)


def test_psnr_of_a_known_error():
    truth = np.full((2, 2, 3), 100, np.uint8)
    assert image_psnr(truth + 51, truth) == pytest.approx(20 * np.log10(5))  # 51 / 255
    assert image_psnr(truth, truth) == pytest.approx(20 * np.log10(255))
    mask = np.array([[True, False], [False, False]])
    spoilt = truth.copy()
    spoilt[1] = 255
    assert image_psnr(spoilt, truth, mask) == image_psnr(truth, truth)


def test_baselines_of_flat_views():
    scene = flat_scene([0, 100, 140, 90], [5.0, 1.0, -3.0, 0.0])
    got = measure_baselines(scene, [0, 1, 2], [3])
    # The mean of 0, 100 and 140 is 80; the nearest camera saw 100. Both are 10 levels off.
    want = 20 * np.log10(25.5)
    np.testing.assert_allclose([got["mean_colour_psnr"], got["nearest_image_psnr"]], want)
    only = measure_baselines(scene, [0, 2], [3])
    np.testing.assert_allclose(only["nearest_image_psnr"], 20 * np.log10(255 / 50))


def test_masked_pixels_do_not_count():
    scene = flat_scene([10, 100, 90], [1.0, 2.0, 0.0])
    mask = np.ones(3 * 64, bool)
    mask[64 * 2 : 64 * 2 + 32] = False
    pixels = scene.pixels.copy()
    pixels[~mask] = 255
    scene = dataclasses.replace(scene, pixels=pixels, pixel_mask=mask)
    got = measure_baselines(scene, [1], [2])
    np.testing.assert_allclose(got["nearest_image_psnr"], 20 * np.log10(25.5))


def test_a_view_of_another_exposure_is_measured_at_its_own_too():
    scene = toy_scene(num_views=3, num_test=2, size=16)
    truth = [scene.image(v) / 255.0 for v in (0, 1)]
    images = [{"rgb": 0.6 * picture + 0.1, "depth": picture[..., 0]} for picture in truth]
    got = mean_quality(scene, (0, 1), images, exposure=True)
    assert got["psnr_exposure"] > 45 > 30 > got["psnr"]
    assert mean_quality(scene, (0, 1), images)["psnr_exposure"] is None
