"""The nerfstudio loader on small real files, and how it normalises cameras."""

from __future__ import annotations

import json

import imageio.v3 as iio
import numpy as np
import pytest

from bavs_jax.scenes import SceneError, load_nerfstudio
from bavs_jax.scenes import poses as poses_module
from tests.scene_files import edit_json, random_image, write_nerfstudio


def test_intrinsics_lens_and_pixels(tmp_path):
    scene = load_nerfstudio(write_nerfstudio(tmp_path / "toy"))
    assert scene.name == "toy"
    assert scene.cameras.lens == "opencv"
    np.testing.assert_allclose(scene.cameras.intrinsics, [[15.0, 16.0, 5.5, 4.5]] * 8)
    np.testing.assert_allclose(scene.cameras.distortion, [[0.1, 0, 0, 0, 0, 0.01]] * 8)
    np.testing.assert_array_equal(scene.image(3), random_image(3, 12, 8, 3))
    assert scene.names[3] == "images/003.png"
    corner = np.max(np.abs(scene.cameras.positions) + 1.5, axis=0)
    assert scene.near < scene.far <= np.linalg.norm(corner) + 1e-6


def test_split_is_a_seeded_permutation(tmp_path):
    root = write_nerfstudio(tmp_path)
    scene = load_nerfstudio(root, pool_size=5, seed=3)
    assert len(scene.pool) == 5
    np.testing.assert_array_equal(np.sort(np.concatenate([scene.pool, scene.test])), np.arange(8))
    np.testing.assert_array_equal(load_nerfstudio(root, pool_size=5, seed=3).pool, scene.pool)
    pools = {tuple(load_nerfstudio(root, pool_size=5, seed=s).pool) for s in range(8)}
    assert len(pools) > 1
    assert len(load_nerfstudio(root).pool) == 6  # three quarters


@pytest.mark.parametrize("share, num_pool", [(0.6, 5), (0.29, 2), (0.07, 1)])
def test_a_share_is_rounded_to_whole_views(tmp_path, share, num_pool):
    root = write_nerfstudio(tmp_path)  # of 8 views: 4.8, 2.32, 0.56
    assert len(load_nerfstudio(root, pool_size=share).pool) == num_pool


@pytest.mark.parametrize(
    ("option", "message"),
    [({"image_size": float("nan")}, "no whole number"), ({"test_every": 2.5}, "give 2 or more")],
)
def test_options_that_are_no_whole_numbers(tmp_path, option, message):
    with pytest.raises(SceneError, match=message):
        load_nerfstudio(write_nerfstudio(tmp_path), **option)


def test_however_large_the_step_the_first_view_is_a_test_view(tmp_path):
    scene = load_nerfstudio(write_nerfstudio(tmp_path), test_every=2**31)
    assert len(scene.test) == 1 and scene.names[scene.test[0]] == min(scene.names)


@pytest.mark.parametrize("pool_size", [8, 9, 0, -1, 2**70, 1.0, 0.0, 1.5, float("nan"), "x"])
def test_a_split_may_not_be_empty(tmp_path, pool_size):
    with pytest.raises(SceneError, match=f"transforms.json: pool_size {pool_size}"):
        load_nerfstudio(write_nerfstudio(tmp_path), pool_size=pool_size)


def test_views_are_sorted_by_file_name(tmp_path):
    root = write_nerfstudio(tmp_path)
    before = load_nerfstudio(root)
    edit_json(root / "transforms.json", lambda data: data["frames"].reverse())
    after = load_nerfstudio(root)
    assert after.names == before.names
    np.testing.assert_allclose(
        after.cameras.world_from_cam, before.cameras.world_from_cam, atol=1e-6
    )


@pytest.mark.parametrize(("k1", "lens"), [(0.1, "opencv"), (0.0, "pinhole")])
def test_a_missing_camera_model_follows_from_the_distortion(tmp_path, k1, lens):
    root = write_nerfstudio(tmp_path, camera_model=None, k1=k1, p2=None)
    assert load_nerfstudio(root).cameras.lens == lens


def test_focal_length_falls_back_to_the_angle_of_view(tmp_path):
    root = write_nerfstudio(
        tmp_path, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, camera_angle_x=1.1
    )
    focal = 6.0 / np.tan(0.55)
    intrinsics = load_nerfstudio(root).cameras.intrinsics
    np.testing.assert_allclose(intrinsics[0], [focal, focal, 6.0, 4.0], rtol=1e-6)


def test_intrinsics_of_a_frame_win_over_those_of_the_file(tmp_path):
    root = write_nerfstudio(tmp_path, w=12.0, h=8.0)
    edit_json(root / "transforms.json", lambda data: data["frames"][2].update(fl_x=20.0, k2=0.3))
    cameras = load_nerfstudio(root).cameras
    np.testing.assert_allclose(cameras.intrinsics[:, 0], [15, 15, 20, 15, 15, 15, 15, 15])
    np.testing.assert_allclose(cameras.distortion[2], [0.1, 0.3, 0, 0, 0, 0.01])


def test_images_at_another_scale_than_stated_scale_the_intrinsics(tmp_path):
    root = write_nerfstudio(tmp_path, w=24, h=16)
    np.testing.assert_allclose(load_nerfstudio(root).cameras.intrinsics[0], [7.5, 8.0, 2.75, 2.25])
    # 25 x 17 rounds to 12 x 8 when halved: within a pixel.
    edit_json(root / "transforms.json", lambda data: data.update(w=25, h=17))
    np.testing.assert_allclose(load_nerfstudio(root).cameras.intrinsics[0, 0], 15 * 12 / 25)


def test_image_size_scales_all_images_by_one_factor(tmp_path):
    root = write_nerfstudio(tmp_path, w=None, h=None)
    iio.imwrite(root / "images/002.png", random_image(2, 8, 12, 3))  # held upright
    scene = load_nerfstudio(root, image_size=6)
    np.testing.assert_array_equal(scene.cameras.sizes[[0, 2]], [[6, 4], [4, 6]])
    np.testing.assert_allclose(scene.cameras.intrinsics[2], [7.5, 8.0, 2.75, 2.25])
    assert scene.image(2).shape == (6, 4, 3)
    with pytest.raises(SceneError, match="image_size 13 is outside of 1 to 12"):
        load_nerfstudio(root, image_size=13)


def test_missing_images_are_skipped_with_one_warning(tmp_path):
    root = write_nerfstudio(tmp_path)
    for i in (1, 3, 4, 6):
        (root / f"images/{i:03d}.png").unlink()
    with pytest.warns(UserWarning, match=r"4 of 8 images have no file \(images/001") as caught:
        scene = load_nerfstudio(root)
    assert len(caught) == 1
    assert str(caught[0].message).endswith("images/004.png, ...): skipped")
    assert scene.names == tuple(f"images/{i:03d}.png" for i in (0, 2, 5, 7))
    with pytest.raises(SceneError, match="4 of 8 images have no file"):
        load_nerfstudio(root, strict=True)


# --- normalisation ---------------------------------------------------------------------------


def random_poses(num: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotations = np.linalg.qr(rng.normal(size=(num, 3, 3)))[0]
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    positions = 5.0 * rng.normal(size=(num, 3, 1)) + 20.0
    return np.concatenate([rotations, positions], axis=-1)


def test_capture_becomes_upright_centred_and_of_unit_size():
    poses = random_poses(9)
    similarity = poses_module.level_and_scale(poses)
    moved = poses_module.transform_poses(similarity, poses)
    up = moved[:, :, 1].mean(axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(moved[:, :, 3].mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(moved[:, :, 3]).max(), 1.0, rtol=1e-12)
    back = poses_module.transform_poses(np.linalg.inv(similarity), moved)
    np.testing.assert_allclose(back, poses, atol=1e-10)


def test_normalisation_does_not_depend_on_where_or_how_large_the_capture_was():
    poses = random_poses(9)
    shifted = poses.copy()
    shifted[:, :, 3] = 7.0 * poses[:, :, 3] + [1.0, 2.0, 3.0]
    first, second = (
        poses_module.transform_poses(poses_module.level_and_scale(p), p) for p in (poses, shifted)
    )
    np.testing.assert_allclose(second, first, atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_rotation_between_is_the_shortest_rotation(seed):
    source, target = np.random.default_rng(seed).normal(size=(2, 3))
    rotation = poses_module.rotation_between(source, target)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    moved = rotation @ source / np.linalg.norm(source)
    np.testing.assert_allclose(moved, target / np.linalg.norm(target), atol=1e-12)
    axis = np.cross(source, target)
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-12)


def test_rotation_between_parallel_directions():
    np.testing.assert_allclose(poses_module.rotation_between([0, 0, 2], [0, 0, 1]), np.eye(3))
    turned = poses_module.rotation_between([0, 0, -1], [0, 0, 1])
    np.testing.assert_allclose(turned @ [0, 0, -1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turned), 1.0)


def test_a_single_camera_still_normalises():
    similarity = poses_module.level_and_scale(random_poses(1))
    assert np.isfinite(similarity).all()
    np.testing.assert_allclose(np.linalg.det(similarity[:3, :3]), 1.0)


def test_user_coordinates_come_back(tmp_path):
    root = write_nerfstudio(tmp_path)
    scene = load_nerfstudio(root)
    back = poses_module.transform_poses(scene.user_from_scene, scene.cameras.world_from_cam)
    frames = json.loads((root / "transforms.json").read_text())["frames"]
    user = np.array([frame["transform_matrix"] for frame in frames])[:, :3]
    np.testing.assert_allclose(back, user, atol=1e-5)  # float32 poses of size 4
