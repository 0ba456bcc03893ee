"""Pixels beyond the fold of a distortion: found, said, and left out of training and measures."""

from __future__ import annotations

import warnings

import imageio.v3 as iio
import jax
import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, look_at, make_cameras, pixel_rays
from bavs_jax.lenses import rising_radii
from bavs_jax.pixel_table import make_pixel_table, sample_pixels
from bavs_jax.scenes import SceneError, load_nerfstudio
from bavs_jax.scenes.folds import LARGEST_MISS, shown_pixels
from experiments.evaluate import mean_quality
from tests.scene_files import edit_json, write_nerfstudio
from tests.test_cameras import project

SIZE = WIDTH, HEIGHT = 48, 27
INTRINSICS = np.array([0.52 * WIDTH, 0.52 * WIDTH, 24.5, 13.0])
WIDE = {"k1": -0.27, "k2": 0.03}  # an action camera, calibrated with too few coefficients
HARMLESS = {"k1": -0.27, "k2": 0.09}
FIELDS = {"width": WIDTH, "height": HEIGHT, **dict(zip(("fl_x", "fl_y", "cx", "cy"), INTRINSICS))}


def seen_radii() -> np.ndarray:
    """Of pixel centres, focal lengths."""
    x, y = (image_pixels(WIDTH, HEIGHT) - INTRINSICS[2:]).T / INTRINSICS[0]
    return np.hypot(x, y).reshape(HEIGHT, WIDTH)


def beyond_the_fold(k1: float, k2: float) -> np.ndarray:
    """How many pixels each one lies beyond the largest radius that the polynomial reaches."""
    radii = np.linspace(0.0, 10.0, 1_000_001)
    values = radii * (1.0 + k1 * radii**2 + k2 * radii**4)
    return (seen_radii() - values[(np.diff(values) < 0.0).argmax()]) * INTRINSICS[0]


def folded() -> np.ndarray:
    return shown_pixels(INTRINSICS, coefficients(**WIDE), SIZE, lens="opencv")


def write_capture(root, **fields):
    return write_nerfstudio(root, **{**FIELDS, "p2": None, **WIDE, **fields})


def coefficients(k1=0.0, k2=0.0, p1=0.0, p2=0.0) -> np.ndarray:
    return np.array([k1, k2, 0.0, 0.0, p1, p2])


# --- which pixels ----------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_what_lies_beyond_the_fold_is_hidden(lens):
    beyond = beyond_the_fold(**WIDE)
    clear = np.abs(beyond) > 1.5 * LARGEST_MISS
    found = shown_pixels(INTRINSICS, coefficients(**WIDE), SIZE, lens=lens)
    np.testing.assert_array_equal(found[clear], beyond[clear] < 0.0)
    assert clear.mean() > 0.97 and 0.1 < (beyond > 0.0).mean() < 0.3


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
@pytest.mark.parametrize("distortion", [HARMLESS, {}, {"k1": 0.3}])
def test_a_lens_that_does_not_fold_in_the_image_hides_nothing(lens, distortion):
    assert shown_pixels(INTRINSICS, coefficients(**distortion), SIZE, lens=lens) is None


@pytest.mark.parametrize("tangential", [{}, {"p1": 0.01, "p2": -0.02}])
def test_just_the_pixels_that_are_shown_are_seen_along_their_own_rays(tangential):
    pose = look_at([1.0, 2.0, 3.0], [0.0, 0.5, 0.0])
    distortion = coefficients(**WIDE, **tangential)
    cameras = make_cameras([pose], [INTRINSICS], [SIZE], distortion=[distortion], lens="opencv")
    pixels = image_pixels(WIDTH, HEIGHT)
    rays = pixel_rays(cameras, np.zeros(len(pixels), int), pixels)
    points = np.asarray(rays.origins + 2.0 * rays.directions, np.float64)
    miss = np.abs(project(pose, INTRINSICS, distortion, points) - pixels).max(axis=-1)
    shown = shown_pixels(INTRINSICS, distortion, SIZE, lens="opencv").ravel()
    assert 0.1 < 1.0 - shown.mean() < 0.3
    assert miss[shown].max() < 1.01 * LARGEST_MISS
    # What is seen there again by another branch of the polynomial looks beyond the lens's range.
    local = (points - pose[:, 3]) @ pose[:, :3]
    edge = rising_radii(np.float32(distortion), lens="opencv")[-1]
    beyond = np.hypot(local[:, 0], local[:, 1]) / -local[:, 2] > edge
    assert (beyond | (miss > 0.99 * LARGEST_MISS))[~shown].all()


def test_a_fisheye_shows_nothing_beyond_a_full_turn():
    """Equidistant: the direction straight back is seen at a radius of pi."""
    focal = 10.0 / np.pi
    shown = shown_pixels([focal, focal, 12.0, 12.0], np.zeros(6), (24, 24), lens="fisheye")
    radius = np.hypot(*(image_pixels(24, 24) - 12.0).T).reshape(24, 24)
    np.testing.assert_array_equal(shown, radius < 10.0)


# --- captures --------------------------------------------------------------------------------


def test_a_capture_says_how_many_and_leaves_them_out(tmp_path):
    root = write_capture(tmp_path)
    with pytest.warns(UserWarning) as caught:
        scene = load_nerfstudio(root)
    expected = folded()
    (said,) = [str(w.message) for w in caught if "folds back" in str(w.message)]
    assert "\n" not in said and str(root / "transforms.json") in said
    assert f"{1.0 - expected.mean():.1%} of all pixels" in said
    assert "in 8 of 8 views (images/000.png, images/001.png, images/002.png, ...)" in said
    np.testing.assert_array_equal(scene.pixel_mask, np.tile(expected.ravel(), 8))

    # Training: they are drawn with a weight of 0.
    table = make_pixel_table(scene)
    batch = sample_pixels(jax.random.key(0), table, np.ones(8, bool), 2000)
    share = 1.0 - np.mean(batch.pixel_weight)
    assert set(np.unique(batch.pixel_weight)) == {0.0, 1.0}
    hidden = 1.0 - expected.mean()  # 5 standard errors
    assert abs(share - hidden) < 5.0 * np.sqrt(hidden * (1.0 - hidden) / 2000)


def test_a_capture_without_folds_has_no_mask(tmp_path):
    root = write_capture(tmp_path, **HARMLESS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_nerfstudio(root)
    assert scene.pixel_mask is None
    assert make_pixel_table(scene).pixel_mask.shape == (1,)


def test_only_views_whose_lens_folds_lose_pixels(tmp_path):
    root = write_capture(tmp_path, **HARMLESS)
    edit_json(root / "transforms.json", lambda data: data["frames"][3].update(WIDE))
    with pytest.warns(UserWarning, match=r"in 1 of 8 views \(images/003\.png\): left out"):
        scene = load_nerfstudio(root)
    for view in range(8):
        expected = folded() if view == 3 else np.ones((HEIGHT, WIDTH), bool)
        np.testing.assert_array_equal(scene.mask_image(view), expected)


def test_a_mask_and_a_fold_both_leave_out(tmp_path):
    root = write_capture(tmp_path)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :20] = 0
    iio.imwrite(root / "mask.png", mask)

    def add(data):
        for frame in data["frames"]:
            frame["mask_path"] = "mask.png"

    edit_json(root / "transforms.json", add)
    with pytest.warns(UserWarning, match="folds back"):
        scene = load_nerfstudio(root)
    np.testing.assert_array_equal(scene.mask_image(5), folded() & (mask > 0))


def test_a_reduced_image_folds_at_the_same_place(tmp_path):
    root = write_capture(tmp_path)
    with pytest.warns(UserWarning, match="folds back"):
        scene = load_nerfstudio(root, image_size=WIDTH // 2)
    whole = folded().mean()
    # The fold is some 60 pixels long, and each pixel in or out is a 336th of the image.
    np.testing.assert_allclose(scene.pixel_mask.mean(), whole, atol=0.03)


def test_a_lens_that_shows_no_pixel_is_refused(tmp_path):
    root = write_capture(tmp_path, cx=900.0)
    with pytest.raises(SceneError, match=r"images/000\.png: no pixel lies within the range"):
        load_nerfstudio(root)


def test_measures_of_test_views_leave_them_out(tmp_path):
    root = write_capture(tmp_path)
    iio.imwrite(root / "depth.png", np.full((HEIGHT, WIDTH), 2500, np.uint16))

    def add(data):
        for frame in data["frames"]:
            frame["depth_file_path"] = "depth.png"

    edit_json(root / "transforms.json", add)
    with pytest.warns(UserWarning, match="folds back"):
        scene = load_nerfstudio(root)
    view = int(scene.test[0])
    image = {
        "rgb": np.clip(scene.image(view) / 255.0 + 0.1, 0.0, 1.0).astype(np.float32),
        "depth": scene.depth_image(view) + 0.5,
    }
    good = mean_quality(scene, [view], [image])
    hidden = ~scene.mask_image(view)
    spoilt = {name: np.where(hidden.T, 9.0, x.T).T for name, x in image.items()}
    assert good["depth_mae"] == pytest.approx(0.5, rel=1e-5)
    for name in ("psnr", "depth_mae"):
        assert mean_quality(scene, [view], [spoilt])[name] == pytest.approx(good[name], rel=1e-5)
