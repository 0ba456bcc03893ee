"""What all real captures share: masks, depth, splits, lenses, scales and the way back."""

from __future__ import annotations

import json

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, look_at, make_cameras, pixel_rays
from bavs_jax.scenes import SceneError, load_nerfstudio, load_scene, maps
from bavs_jax.scenes.poses import user_transforms
from tests.scene_files import (
    edit_json,
    orbit,
    random_image,
    write_blender,
    write_colmap,
    write_images,
    write_llff,
    write_mipnerf360,
    write_nerfplusplus,
    write_nerfstudio,
)

WRITERS = {
    "blender": write_blender,
    "nerfstudio": write_nerfstudio,
    "llff": write_llff,
    "colmap": write_colmap,
    "mipnerf360": write_mipnerf360,
    "lightfield": write_nerfplusplus,
}


def file_poses(kind: str) -> np.ndarray:
    """The poses that a writer wrote, in the order of the loaded views."""
    if kind == "blender":
        return np.concatenate([orbit(3), orbit(2)])
    return np.array(orbit({"nerfstudio": 8, "lightfield": 6}.get(kind, 9)))


def edit_frames(root, change) -> None:
    """Lets `change(index, frame)` alter every frame of `transforms.json`."""

    def edit(data):
        for index, frame in enumerate(data["frames"]):
            change(index, frame)

    edit_json(root / "transforms.json", edit)


@pytest.mark.parametrize("kind", WRITERS)
def test_the_users_own_poses_come_back(tmp_path, kind):
    if kind in ("colmap", "mipnerf360"):
        pytest.importorskip("pycolmap", reason="pycolmap is in the extra [colmap]")
    scene = load_scene(kind, root=WRITERS[kind](tmp_path))
    back = user_transforms(scene, scene.cameras.world_from_cam)
    np.testing.assert_allclose(back, file_poses(kind), atol=1e-5)  # float32 poses of size 4
    assert scene.unbounded == (kind != "blender")


# --- masks -----------------------------------------------------------------------------------


def write_masks(root, num: int = 8, width: int = 12, height: int = 8) -> list[np.ndarray]:
    """Writes a mask for each frame: everything counts but the two left columns of the first row."""
    (root / "masks").mkdir()
    masks = []
    for i in range(num):
        mask = np.full((height, width), 255, np.uint8)
        mask[0, :2] = 0
        mask[1, 0] = 1  # not black
        masks.append(mask)
        iio.imwrite(root / f"masks/{i:03d}.png", mask)
    edit_frames(root, lambda i, frame: frame.update(mask_path=f"masks/{i:03d}.png"))
    return masks


def test_black_in_a_mask_is_ignored(tmp_path):
    root = write_nerfstudio(tmp_path)
    assert load_nerfstudio(root).pixel_mask is None
    masks = write_masks(root)
    scene = load_nerfstudio(root)
    assert scene.pixel_mask.dtype == bool
    np.testing.assert_array_equal(scene.pixel_mask, np.stack(masks).ravel() > 0)


def test_a_shrunk_pixel_counts_where_all_of_it_counts(tmp_path):
    root = write_nerfstudio(tmp_path)
    write_masks(root)
    scene = load_nerfstudio(root, image_size=4)  # 12 x 8 to 4 x 3
    expected = np.ones((3, 4), bool)
    expected[0, 0] = False
    np.testing.assert_array_equal(scene.pixel_mask[scene.view_slice(2)].reshape(3, 4), expected)


def test_masks_may_be_bilevel(tmp_path):
    from PIL import Image

    root = write_nerfstudio(tmp_path)
    masks = write_masks(root)
    for i, mask in enumerate(masks):
        Image.fromarray(mask).convert("L").point(lambda v: 255 * (v > 0)).convert("1").save(
            root / f"masks/{i:03d}.png"
        )
    np.testing.assert_array_equal(load_nerfstudio(root).pixel_mask, np.stack(masks).ravel() > 0)


# --- depth -----------------------------------------------------------------------------------


def wall_depth(scene, view: int, distance: float) -> np.ndarray:
    """Distance along each ray to a wall at right angles to the optical axis."""
    width, height = scene.cameras.sizes[view]
    pixels = image_pixels(width, height)
    rays = pixel_rays(scene.cameras, np.full(len(pixels), view), pixels)
    forward = -np.asarray(scene.cameras.world_from_cam)[view, :, 2]
    return (distance / (np.asarray(rays.directions) @ forward)).reshape(height, width)


@pytest.mark.parametrize("suffix", ["png", "npy"])
def test_depth_in_millimetres_becomes_distance_along_the_ray(tmp_path, suffix):
    root = write_nerfstudio(tmp_path, camera_model="OPENCV")
    depth = np.full((8, 12), 2500, np.uint16)
    depth[3, 4] = 0
    if suffix == "png":
        iio.imwrite(root / "depth.png", depth)
    else:
        np.save(root / "depth.npy", depth.astype(np.float32))
    name = f"depth.{suffix}"
    edit_frames(root, lambda i, f: f.update(depth_file_path=name) if i == 2 else None)
    scene = load_nerfstudio(root)
    unit = 1.0 / np.cbrt(np.linalg.det(scene.user_from_scene[:3, :3]))
    expected = wall_depth(scene, 2, 2.5 * unit)
    expected[3, 4] = 0.0
    np.testing.assert_allclose(scene.depth_image(2), expected, rtol=1e-5)
    np.testing.assert_array_equal(scene.depth_image(1), 0.0)

    along_ray = load_nerfstudio(root, depth_along_ray=True, depth_unit=2e-3).depth_image(2)
    np.testing.assert_allclose(along_ray[0], 5.0 * unit, rtol=1e-6)
    half = load_nerfstudio(root, image_size=6)
    np.testing.assert_allclose(
        half.depth_image(2)[0], wall_depth(half, 2, 2.5 * unit)[0], rtol=1e-5
    )


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
def test_depth_of_a_large_image_is_that_of_each_ray_by_itself(lens):
    """At 32,400 pixels, where XLA for CPUs once gave rays the directions of others."""
    width, height = 240, 135
    distortion = [[-0.05, 0.01, 0.0, 0.0, 0.002, -0.001]] if lens == "opencv" else None
    pose = look_at([1.0, 2.0, 3.0], [0.2, 0.1, -0.3])
    cameras = make_cameras(
        [pose], [[200.0, 205.0, 118.0, 70.0]], [[width, height]], distortion=distortion, lens=lens
    )
    found = maps.along_rays(np.full((height, width), 2.5, np.float32), cameras, 0)
    with jax.enable_x64(True):
        double = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), cameras)
        pixels = jnp.asarray(image_pixels(width, height), jnp.float64)
        rays = pixel_rays(double, np.zeros(len(pixels), int), pixels)
        cosine = np.asarray(rays.directions) @ -pose[:, 2]
    np.testing.assert_allclose(found, (2.5 / cosine).reshape(height, width), rtol=2e-6)


def test_depth_sensors_may_be_coarser_than_the_camera(tmp_path):
    root = write_nerfstudio(tmp_path)
    values = np.array([[1000, 2000, 3000], [4000, 5000, 6000]], np.uint16)
    iio.imwrite(root / "depth.png", values)
    edit_frames(root, lambda i, frame: frame.update(depth_file_path="depth.png"))
    depth = load_nerfstudio(root, depth_along_ray=True, scale=1.0).depth_image(0)
    np.testing.assert_allclose(depth, np.kron(values / 1000.0, np.ones((4, 4))), rtol=1e-6)


def test_depth_is_in_units_before_the_applied_scale(tmp_path):
    root = write_nerfstudio(tmp_path, applied_scale=0.5)
    iio.imwrite(root / "depth.png", np.full((8, 12), 3000, np.uint16))
    edit_frames(root, lambda i, frame: frame.update(depth_file_path="depth.png"))
    depth = load_nerfstudio(root, depth_along_ray=True, scale=1.0).depth_image(0)
    np.testing.assert_allclose(depth, 1.5, rtol=1e-6)


# --- splits ----------------------------------------------------------------------------------


def names(*numbers: int) -> list[str]:
    return [f"images/{n:03d}.png" for n in numbers]


def test_split_that_the_file_lists(tmp_path):
    root = write_nerfstudio(
        tmp_path,
        train_filenames=names(0, 5, 2),
        val_filenames=names(3),
        test_filenames=["./images/007.png", *names(6)],
    )
    scene = load_nerfstudio(root)
    np.testing.assert_array_equal(scene.pool, [0, 2, 5])
    np.testing.assert_array_equal(scene.test, [6, 7])
    assert len(load_nerfstudio(root, pool_size=6).pool) == 6  # an option wins
    edit_json(root / "transforms.json", lambda data: data.pop("test_filenames"))
    np.testing.assert_array_equal(load_nerfstudio(root).test, [3])


def test_test_every_takes_sorted_views_from_the_first_on(tmp_path):
    scene = load_nerfstudio(write_nerfstudio(tmp_path), test_every=3)
    np.testing.assert_array_equal(scene.test, [0, 3, 6])
    np.testing.assert_array_equal(scene.pool, [1, 2, 4, 5, 7])
    with pytest.raises(SceneError, match="pool_size and test_every are both given"):
        load_nerfstudio(tmp_path, test_every=3, pool_size=2)
    with pytest.raises(SceneError, match="test_every 1: give 2 or more"):
        load_nerfstudio(tmp_path, test_every=1)


# --- lenses, scales, coordinates -------------------------------------------------------------


def test_fisheye(tmp_path):
    fields = {"camera_model": "OPENCV_FISHEYE", "k1": -0.02, "k4": 0.001, "p2": None}
    scene = load_nerfstudio(write_nerfstudio(tmp_path, **fields))
    assert scene.cameras.lens == "fisheye"
    np.testing.assert_allclose(scene.cameras.distortion, [[-0.02, 0, 0, 0.001, 0, 0]] * 8)


def test_instant_ngp_says_fisheye_in_its_own_way(tmp_path):
    root = write_nerfstudio(tmp_path, camera_model=None, is_fisheye=True, p2=None)
    assert load_nerfstudio(root).cameras.lens == "fisheye"


def test_downscale_takes_the_copies(tmp_path):
    root = write_nerfstudio(tmp_path)
    write_images(root / "images_2", 8, 6, 4)
    write_masks(root)
    with pytest.raises(SceneError, match=r"masks_2/000\.png: mask of 000\.png is missing"):
        load_nerfstudio(root, downscale=2)
    (root / "masks_2").mkdir()
    for i in range(8):
        iio.imwrite(root / f"masks_2/{i:03d}.png", np.full((4, 6), 255, np.uint8))
    scene = load_nerfstudio(root, downscale=2)
    assert scene.names[1] == "images_2/001.png"
    np.testing.assert_array_equal(scene.image(1), random_image(1, 6, 4, 3))
    np.testing.assert_allclose(scene.cameras.intrinsics[0], [7.5, 8.0, 2.75, 2.25])
    assert scene.pixel_mask.all()


def test_original_coordinates_undo_what_was_applied(tmp_path):
    """`X_file = applied_scale (T X_original)`."""
    swap = np.array([[0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 0]])
    root = write_nerfstudio(tmp_path, applied_transform=swap.tolist(), applied_scale=2.0)
    scene = load_nerfstudio(root, original_coordinates=True)
    original = user_transforms(scene, scene.cameras.world_from_cam)
    again = swap @ original
    again[:, :, 3] *= 2.0
    np.testing.assert_allclose(again, np.array(orbit(8))[:, :3], atol=1e-5)
    own = load_nerfstudio(root)
    np.testing.assert_allclose(
        user_transforms(own, own.cameras.world_from_cam), orbit(8), atol=1e-5
    )


def test_a_byte_order_mark_does_no_harm(tmp_path):
    root = write_nerfstudio(tmp_path)
    text = (root / "transforms.json").read_text()
    (root / "transforms.json").write_text(text, encoding="utf-8-sig")
    assert load_nerfstudio(root).num_views == len(json.loads(text)["frames"])


def test_near_far_box_and_unbounded_are_options(tmp_path):
    root = write_nerfstudio(tmp_path)
    scene = load_nerfstudio(root, near=0.2, far=9.0, box_half_side=2.0, unbounded=False)
    assert (scene.near, scene.far, scene.unbounded) == (0.2, 9.0, False)
    np.testing.assert_array_equal(scene.box, [[-2.0] * 3, [2.0] * 3])
    for options in ({"near": 5.0, "far": 4.0}, {"near": 0.0}, {"far": float("nan")}):
        with pytest.raises(SceneError, match="give 0 < near < far"):
            load_nerfstudio(root, **options)
    with pytest.raises(SceneError, match="box_half_side 0: give a number above 0"):
        load_nerfstudio(root, box_half_side=0)
