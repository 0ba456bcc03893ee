"""The Blender loader on small real files: content, depth, and a table of faults."""

from __future__ import annotations

import json

import imageio.v3 as iio
import numpy as np
import pytest

from bavs_jax.scenes import SceneError, images, load_blender, load_scene
from tests.scene_files import random_image, write_blender


def test_splits_cameras_and_pixels(tmp_path):
    root = write_blender(tmp_path / "toy")
    scene = load_blender(root)
    assert scene.name == "toy"
    np.testing.assert_array_equal(scene.pool, [0, 1, 2])
    np.testing.assert_array_equal(scene.test, [3, 4])
    assert scene.names[3] == "test/r_0.png"
    np.testing.assert_array_equal(scene.offsets, 48 * np.arange(6))
    np.testing.assert_array_equal(scene.cameras.sizes, [[8, 6]] * 5)
    focal = 4.0 / np.tan(0.35)
    np.testing.assert_allclose(scene.cameras.intrinsics[2], [focal, focal, 4.0, 3.0], rtol=1e-6)
    frames = json.loads((root / "transforms_test.json").read_text())["frames"]
    np.testing.assert_allclose(
        scene.cameras.world_from_cam[4], np.array(frames[1]["transform_matrix"])[:3], atol=1e-6
    )
    rgba = iio.imread(root / "train/r_1.png").astype(np.float64) / 255.0
    over_white = rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]
    # Half a step of rounding, and float32 on its edge.
    np.testing.assert_allclose(scene.image(1), 255.0 * over_white, atol=0.501)
    assert scene.depth is None
    np.testing.assert_array_equal(scene.user_from_scene, np.eye(4))


def test_shrinking_keeps_the_field_of_view(tmp_path):
    root = write_blender(tmp_path, width=9, height=7)
    scene = load_blender(root, image_size=4, background=(0.0, 0.5, 1.0))
    np.testing.assert_array_equal(scene.cameras.sizes, [[4, 3]] * 5)
    fx, fy, cx, cy = scene.cameras.intrinsics[0]
    np.testing.assert_allclose([4 / fx, 2 * cx, 2 * cy], [2 * np.tan(0.35), 4, 3], rtol=1e-6)
    # Rows shrink by 3 / 7 where columns shrink by 4 / 9.
    np.testing.assert_allclose(fy / fx, (3 / 7) / (4 / 9), rtol=1e-6)
    image = images.read_image(root / "train/r_0.png")
    colour, alpha = images.shrink_over(image, 4, 3, (0.0, 0.5, 1.0))
    np.testing.assert_array_equal(scene.image(0), colour)
    np.testing.assert_array_equal(scene.alpha[scene.view_slice(0)].reshape(3, 4), alpha)


def test_depth_is_read_where_it_exists(tmp_path):
    root = write_blender(tmp_path)
    values = random_image(5, 8, 6, 1)[..., 0]
    values[0, 0], values[0, 1] = 0, 51
    iio.imwrite(root / "test/r_0_depth_0001.png", values)
    rgba = iio.imread(root / "test/r_0.png").copy()
    rgba[..., 3] = 255
    rgba[2, 3, 3] = 0
    iio.imwrite(root / "test/r_0.png", rgba)

    scene = load_blender(root)
    depth = scene.depth_image(3)
    expected = np.where(values > 0, 8.0 - values * (8.0 / 255.0), 0.0)
    expected[2, 3] = 0.0
    np.testing.assert_allclose(depth, expected, atol=1e-6)
    assert depth[0, 0] == 0.0  # background
    np.testing.assert_allclose(depth[0, 1], 6.4, rtol=1e-6)
    for view in (0, 4):
        np.testing.assert_array_equal(scene.depth_image(view), 0.0)

    half = load_blender(root, image_size=4)
    assert set(half.depth_image(3).ravel()) <= set(depth.ravel())


def test_missing_images_are_skipped_with_one_warning(tmp_path):
    root = write_blender(tmp_path)
    (root / "train/r_1.png").unlink()
    with pytest.warns(UserWarning, match=r"1 of 3 images have no file \(\./train/r_1\)") as caught:
        scene = load_blender(root)
    assert len(caught) == 1
    assert scene.names[:2] == ("train/r_0.png", "train/r_2.png")
    with pytest.raises(SceneError, match="1 of 3 images have no file"):
        load_blender(root, strict=True)


@pytest.mark.parametrize("size", [0, 9])
def test_image_size_must_not_exceed_the_original(tmp_path, size):
    with pytest.raises(SceneError, match=f"image_size {size} is outside of 1 to 8"):
        load_blender(write_blender(tmp_path), image_size=size)


def test_load_scene_names_the_known_kinds(tmp_path):
    scene = load_scene("blender", root=write_blender(tmp_path))
    assert scene.num_views == 5
    with pytest.raises(
        SceneError, match="'blend' is unknown: use one of blender, nerfstudio, llff"
    ):
        load_scene("blend", root=tmp_path)
    with pytest.raises(
        SceneError, match="option pool_size is unknown: use some of root, image_size"
    ):
        load_scene("blender", root=tmp_path, pool_size=3)
    with pytest.raises(SceneError, match="'blender': root: missing"):
        load_scene("blender")
