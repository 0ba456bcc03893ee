"""LLFF and Mip-NeRF 360: axes, scales, bounds and hold-out on files that the test writes."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from bavs_jax.scenes import SceneError, detect_kind, load_llff, load_mipnerf360
from bavs_jax.scenes.poses import user_transforms
from tests.scene_files import orbit, random_image, write_llff, write_mipnerf360


def test_axes_intrinsics_and_hold_out(tmp_path):
    scene = load_llff(write_llff(tmp_path / "toy"))
    assert scene.name == "toy"
    assert scene.names[1] == "images/001.png"
    np.testing.assert_array_equal(scene.test, [0, 8])
    np.testing.assert_array_equal(scene.pool, np.arange(1, 8))
    np.testing.assert_allclose(scene.cameras.intrinsics, [[15.0, 15.0, 6.0, 4.0]] * 9)
    np.testing.assert_array_equal(scene.image(2), random_image(2, 12, 8, 3))
    # float32 poses of size 4.
    user = user_transforms(scene, scene.cameras.world_from_cam)
    np.testing.assert_allclose(user, orbit(9), atol=1e-5)
    # The orbit looks at its middle, which is at the origin of the user's coordinates.
    middle = (np.linalg.inv(scene.user_from_scene) @ [0.0, 0.0, 0.0, 1.0])[:3]
    towards = middle - scene.cameras.positions
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(-scene.cameras.world_from_cam[:, :, 2], towards, atol=1e-5)


def test_bounds_become_near_far_and_box(tmp_path):
    root = write_llff(tmp_path)
    scene = load_llff(root, unbounded=False)
    unit = 1.0 / np.cbrt(np.linalg.det(scene.user_from_scene[:3, :3]))
    np.testing.assert_allclose(scene.near, 0.9 * 2.0 * unit, rtol=1e-6)
    stretch = np.hypot(np.hypot(6.0, 4.0) / 15.0, 1.0)  # of the corner's ray
    np.testing.assert_allclose(scene.far, 7.0 * unit * stretch, rtol=1e-6)
    for depth in (2.0 * unit, 7.0 * unit):
        centre_rays = -depth * scene.cameras.world_from_cam[:, :, 2]
        points = np.asarray(scene.cameras.positions) + centre_rays
        assert (points > scene.box[0]).all()
        assert (points < scene.box[1]).all()
    inner = load_llff(root)
    assert inner.unbounded
    assert (inner.box[0] >= scene.box[0]).all()
    assert np.prod(np.ptp(inner.box, axis=0)) < np.prod(np.ptp(scene.box, axis=0))
    cube = load_llff(root, box_half_side=2.0, near=0.5, far=3.0)
    np.testing.assert_array_equal(cube.box, [[-2.0] * 3, [2.0] * 3])
    assert (cube.near, cube.far) == (0.5, 3.0)


def test_downscale_chooses_the_folder(tmp_path):
    root = write_llff(tmp_path)
    small = load_llff(root, downscale=2)
    assert small.names[0] == "images_2/000.png"
    np.testing.assert_allclose(small.cameras.intrinsics[0], [7.5, 7.5, 3.0, 2.0])
    shutil.rmtree(root / "images")
    assert load_llff(root).names == small.names
    with pytest.raises(SceneError, match="images_4: folder is missing: choose another downscale"):
        load_llff(root, downscale=4)
    with pytest.raises(SceneError, match="neither images nor images_2"):
        load_llff(root, downscale=1)


@pytest.mark.parametrize(("options", "test"), [({"test_every": 3}, [0, 3, 6]), ({}, [0, 8])])
def test_test_every(tmp_path, options, test):
    np.testing.assert_array_equal(load_llff(write_llff(tmp_path), **options).test, test)


def test_pool_size_takes_the_place_of_the_hold_out(tmp_path):
    scene = load_llff(write_llff(tmp_path), pool_size=4)
    assert (len(scene.pool), len(scene.test)) == (4, 5)


def test_mipnerf360_reads_colmap_or_else_the_bounds(tmp_path):
    pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")
    root = write_mipnerf360(tmp_path)
    assert detect_kind(root) == "mipnerf360"
    scene = load_mipnerf360(root, downscale=2)
    np.testing.assert_array_equal(scene.test, [0, 8])
    assert scene.names[3] == "images_2/003.png"
    np.testing.assert_allclose(scene.cameras.intrinsics[0], [7.5, 7.5, 3.0, 2.0])

    shutil.rmtree(root / "sparse")
    assert detect_kind(root) == "llff"
    bounded = load_mipnerf360(root, downscale=2)
    np.testing.assert_array_equal(bounded.test, [0, 8])
    np.testing.assert_allclose(
        bounded.cameras.world_from_cam, scene.cameras.world_from_cam, atol=1e-5
    )
