"""The Light Field dataset in its four layouts, with its published splits and depth."""

from __future__ import annotations

import numpy as np
import pytest

from bavs_jax.scenes import SceneError, detect_kind, load_lightfield, load_scene
from bavs_jax.scenes.lightfield import SPLITS
from bavs_jax.scenes.poses import user_transforms
from tests.scene_files import (
    orbit,
    write_colmap,
    write_images,
    write_llff,
    write_nerfplusplus,
    write_nerfstudio,
)

PUBLISHED = {
    "africa": ([5, 7, 9, 11, 13], [6, 8, 10, 12]),
    "basket": ([43, 45, 47, 49], [42, 44, 46, 48]),
    "basket-cfnerf": ([43, 45, 47, 49], [44, 46, 48]),
    "statue": ([67, 69, 71, 73, 75], [68, 70, 72, 74]),
    "torch": ([8, 10, 12, 14, 16], [9, 11, 13, 15]),
}


def test_published_splits():
    assert {name: (list(s.pool), list(s.test)) for name, s in SPLITS.items()} == PUBLISHED


@pytest.mark.parametrize("write", [write_nerfstudio, write_colmap, write_llff])
def test_layouts_agree_on_units_and_split(tmp_path, write):
    if write is write_colmap:
        pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")
    root = write(tmp_path, num=14)
    scene = load_lightfield(root, split="africa")
    np.testing.assert_array_equal(scene.pool, PUBLISHED["africa"][0])
    np.testing.assert_array_equal(scene.test, PUBLISHED["africa"][1])
    assert (scene.near, scene.far, scene.unbounded) == (1.0, 100.0, False)
    np.testing.assert_array_equal(scene.box, [[-36.0] * 3, [36.0] * 3])
    np.testing.assert_allclose(np.linalg.det(scene.user_from_scene), 1.0)  # units are kept
    user = user_transforms(scene, scene.cameras.world_from_cam)
    np.testing.assert_allclose(user, orbit(14), atol=1e-5)
    seeded = load_lightfield(root, pool_size=10, far=50.0)
    assert (len(seeded.test), seeded.far) == (4, 50.0)


def test_copies_at_half_the_size_are_preferred(tmp_path):
    root = write_nerfstudio(tmp_path, num=14)
    write_images(root / "images_2", 14, 6, 4)
    scene = load_lightfield(root, split="africa")
    np.testing.assert_array_equal(scene.cameras.sizes[0], [6, 4])
    np.testing.assert_array_equal(load_lightfield(root, downscale=1).cameras.sizes[0], [12, 8])


def test_true_depth_of_the_test_views(tmp_path):
    """`depth_gt` is along the optical axis, and `scale_parameters` of its units are one."""
    root = write_nerfstudio(tmp_path, num=14, k1=0.0, p2=0.0, camera_model="PINHOLE")
    for n in range(4):
        np.save(root / f"depth_gt_{n:02d}.npy", np.full((8, 12), 10.0 + n))
    (root / "scale_parameters.txt").write_text("2.5\n")
    scene = load_lightfield(root, split="africa")
    np.testing.assert_array_equal(scene.depth_image(5), 0.0)
    x, y = np.meshgrid((np.arange(12) + 0.5 - 5.5) / 15.0, (np.arange(8) + 0.5 - 4.5) / 16.0)
    along_ray = np.sqrt(1.0 + x**2 + y**2)
    np.testing.assert_allclose(scene.depth_image(8), 11.0 / 2.5 * along_ray, rtol=1e-6)
    (root / "scale_parameters.txt").unlink()
    with pytest.raises(SceneError, match=r"scale_parameters\.txt: file is missing"):
        load_lightfield(root, split="africa")


def test_nerfplusplus_keeps_its_own_split(tmp_path):
    root = write_nerfplusplus(tmp_path)
    assert detect_kind(root) == "lightfield"
    scene = load_scene("auto", root=root)
    np.testing.assert_array_equal(scene.pool, [0, 1, 2, 3])
    np.testing.assert_array_equal(scene.test, [4, 5])
    assert scene.names[4] == "test/rgb/000.png"
    assert scene.unbounded
    np.testing.assert_allclose(scene.cameras.intrinsics, [[15.0, 16.0, 5.5, 4.5]] * 6)
    user = user_transforms(scene, scene.cameras.world_from_cam)
    np.testing.assert_allclose(user, orbit(6), atol=1e-5)


def test_a_split_must_be_known_and_fit(tmp_path):
    root = write_nerfstudio(tmp_path, num=12)
    with pytest.raises(SceneError, match="split 'afrika' is unknown: use one of africa, basket"):
        load_lightfield(root, split="afrika")
    with pytest.raises(SceneError, match="the pool split asks for view 13 of 12"):
        load_lightfield(root, split="africa")
    with pytest.raises(SceneError, match="split and pool_size are both given"):
        load_lightfield(root, split="africa", pool_size=3)
