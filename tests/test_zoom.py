"""Free distance: crops of photos and cameras moved closer, against renders and projected points."""

import json

import imageio.v3 as iio
import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, pixel_rays, project, rescale, take
from bavs_jax.scenes import (
    SceneError,
    images,
    load_blender,
    load_procedural,
    load_scene,
    procedural,
)
from bavs_jax.scenes.base import photo_cameras
from bavs_jax.scenes.zoom import Zoom, cut, cut_cameras, magnifications, photo_windows
from tests.oracles_scenes import brute_force_depth
from tests.scene_files import random_image, write_blender, write_nerfstudio
from tests.scene_layouts import COLMAP, LAYOUTS
from tests.test_scenes_procedural import some_cameras

ZOOM = Zoom(3.0, 4)


def test_magnifications_fill_the_range_evenly_and_go_by_the_number_of_the_view():
    drawn = magnifications(Zoom(3.0, 0), 2000)
    assert drawn.min() >= 1.0 and drawn.max() <= 3.0
    shares = np.histogram(np.log(drawn), bins=4, range=(0.0, np.log(3.0)))[0] / 2000
    np.testing.assert_allclose(shares, 0.25, atol=0.04)
    np.testing.assert_array_equal(magnifications(Zoom(3.0, 0), 5, first=7), drawn[7:12])
    assert (magnifications(Zoom(3.0, 1), 5) != drawn[:5]).all()
    np.testing.assert_array_equal(magnifications(None, 3), 1.0)


@pytest.mark.parametrize("size", [(9, 7), (100, 75), (1, 1), (800, 600)])
@pytest.mark.parametrize("ratio", [1.0, 1.01, 2.0, 3.0])
def test_windows_are_the_middle_of_the_photo(size, ratio):
    (first, last), *_ = photo_windows([size], [ratio])
    assert (first >= 0).all() and (last <= size).all() and (last > first).all()
    assert (abs((last - first) - np.array(size) / ratio) <= 0.5).all() or size == (1, 1)
    assert (abs(first - (size - last)) <= 1).all()
    if ratio == 1.0:
        np.testing.assert_array_equal([first, last], [(0, 0), size])


# --- crops of photos ---


def test_a_crop_is_what_a_longer_lens_takes():
    """Of the sculpture: the middle third at 12 pixels, and the middle of a picture three times so.

    A pixel of the small picture is the mean of the pixels of the large one that it covers.
    """
    whole = rescale(some_cameras(1), [[96, 96]])
    (window,) = photo_windows(whole.sizes, [3.0])
    assert (window[1] - window[0] == 32).all()
    small = rescale(cut_cameras(whole, window[None]), [[16, 16]])
    np.testing.assert_allclose(small.intrinsics[0], [*(whole.intrinsics[0, :2] / 2), 8.0, 8.0])
    photo = procedural.capture(whole).pixels.reshape(96, 96, 3)
    cropped, _ = images.shrink_over(cut(photo, window), 16, 16, (1.0, 1.0, 1.0))
    taken = procedural.capture(small).pixels.reshape(16, 16, 3)
    error = np.abs(cropped.astype(float) - taken)
    assert np.ptp(taken) > 50  # there is something to see
    # What the means of 3 x 3 rays miss of edges within a pixel; half a small pixel aside is worse.
    aside, _ = images.shrink_over(cut(photo, window + np.array([1, 0])), 16, 16, (1.0, 1.0, 1.0))
    assert error.mean() < 3.0 and np.abs(aside.astype(float) - taken).mean() > 2.0 * error.mean()


@pytest.mark.parametrize("lens", ["OPENCV", "OPENCV_FISHEYE"])
def test_points_are_seen_at_the_same_place_of_the_photo(tmp_path, lens):
    """Exact projection: what is at pixel p of the photo is at the crop's (p - corner) * scale."""
    root = write_nerfstudio(tmp_path, width=61, height=47, camera_model=lens, p2=0.0)
    options = {"image_size": 12, "test_every": 4}
    scene = load_scene("nerfstudio", root=root, zoom=ZOOM, **options)
    plain = load_scene("nerfstudio", root=root, **options)
    np.testing.assert_array_equal(scene.cameras.sizes, plain.cameras.sizes)
    np.testing.assert_array_equal(scene.cameras.world_from_cam, plain.cameras.world_from_cam)
    np.testing.assert_array_equal(scene.box, plain.box)
    whole = rescale(plain.cameras, [[61, 47]] * 8)
    windows = photo_windows([(61, 47)] * 8, magnifications(ZOOM, 8))
    assert len({tuple(w.ravel()) for w in windows}) == 8
    for view in range(8):
        camera, photo = take(scene.cameras, view), take(whole, view)
        rays = pixel_rays(scene.cameras, np.full(108, view), image_pixels(12, 9))
        points = np.asarray(rays.origins) + 2.5 * np.asarray(rays.directions)
        pixels, is_seen = map(np.asarray, project(photo, points))
        (left, top), (right, bottom) = windows[view]
        scale = np.array([12 / (right - left), 9 / (bottom - top)])
        assert is_seen.all()
        np.testing.assert_allclose((pixels - [left, top]) * scale, image_pixels(12, 9), atol=2e-3)
        np.testing.assert_allclose(
            camera.intrinsics[0] / (photo.intrinsics[0] * scale[0]), 1.0, 1e-5
        )
        image = images.read_image(root / scene.names[view])[top:bottom, left:right]
        assert image.shape[0] >= 9 and image.shape[1] >= 12
        np.testing.assert_array_equal(
            scene.image(view), images.shrink_over(image, 12, 9, (1.0, 1.0, 1.0))[0]
        )
    # As one would take it: the whole sensor behind a longer lens.
    asked = photo_cameras(scene, scene.cameras)
    np.testing.assert_array_equal(asked.sizes, [[61, 47]] * 8)
    ratios = 61 / (windows[:, 1, 0] - windows[:, 0, 0])
    np.testing.assert_allclose(asked.intrinsics[:, 0], ratios * whole.intrinsics[:, 0], rtol=1e-5)


def test_masks_and_depth_are_cut_with_the_photo(tmp_path):
    """A mask and a depth map that say where a pixel was; the map at half the photo's size."""
    root = write_nerfstudio(tmp_path, num=6, width=36, height=24, k1=0.0, p2=0.0)
    data = json.loads((root / "transforms.json").read_text())
    (root / "extra").mkdir()
    mask = np.zeros((24, 36), np.uint8)
    mask[8:16, 15:36] = 255
    depth = (100 * np.arange(1, 13)[:, None] + np.arange(1, 19)).astype(np.uint16)
    iio.imwrite(root / "extra/mask.png", mask)
    iio.imwrite(root / "extra/depth.png", depth)
    for frame in data["frames"]:
        frame |= {"mask_path": "extra/mask.png", "depth_file_path": "extra/depth.png"}
    (root / "transforms.json").write_text(json.dumps(data))
    scene = load_scene("nerfstudio", root=root, image_size=12, zoom=ZOOM, test_every=3)
    windows = photo_windows([(36, 24)] * 6, magnifications(ZOOM, 6))
    unit = 0.001 / np.cbrt(np.linalg.det(scene.user_from_scene[:3, :3]))
    for view, ((left, top), (right, bottom)) in enumerate(windows):
        column = left + (np.arange(12) + 0.5) * (right - left) / 12  # centres, pixels of the photo
        row = top + (np.arange(8) + 0.5) * (bottom - top) / 8
        along = unit * depth[(row / 2).astype(int)[:, None], (column / 2).astype(int)]
        rays = pixel_rays(scene.cameras, np.full(96, view), image_pixels(12, 8))
        ahead = -np.asarray(scene.cameras.world_from_cam)[view, :, 2]
        cosine = (np.asarray(rays.directions) @ ahead).reshape(8, 12)
        np.testing.assert_allclose(scene.depth_image(view), along / cosine, rtol=1e-4)
        half = 0.5 * np.array([(right - left) / 12, (bottom - top) / 8])
        inside_x = (column - half[0] > 15 - 1e-6) & (column + half[0] < 36 + 1e-6)
        inside_y = (row - half[1] > 8 - 1e-6) & (row + half[1] < 16 + 1e-6)
        np.testing.assert_array_equal(scene.mask_image(view), inside_y[:, None] & inside_x)


def test_crops_of_nerf_synthetic_with_depth_of_pool_and_test_views(tmp_path):
    root = write_blender(tmp_path, width=40, height=30)
    values = random_image(5, 40, 30, 1)[..., 0]
    iio.imwrite(root / "test/r_1_depth_0001.png", values)
    scene, plain = (load_blender(root, image_size=10, zoom=z) for z in (ZOOM, None))
    windows = photo_windows([(40, 30)] * 5, magnifications(ZOOM, 5))
    focal = 20.0 / np.tan(0.35)
    for view, window in enumerate(windows):
        (left, top), (right, bottom) = window
        scale = np.array([10 / (right - left), 8 / (bottom - top)])
        fx, fy, cx, cy = scene.cameras.intrinsics[view]
        np.testing.assert_allclose([fx, fy], focal * scale, rtol=1e-6)
        np.testing.assert_allclose([cx, cy], (np.array([20, 15]) - [left, top]) * scale, rtol=1e-6)
        image = images.read_image(root / scene.names[view])[top:bottom, left:right]
        colour, alpha = images.shrink_over(image, 10, 8, (1.0, 1.0, 1.0))
        np.testing.assert_array_equal(scene.image(view), colour)
        np.testing.assert_array_equal(scene.alpha[scene.view_slice(view)].reshape(8, 10), alpha)
    (left, top), (right, bottom) = windows[4]
    alpha = iio.imread(root / "test/r_1.png")[..., 3]
    distance = np.where((values > 0) & (alpha > 0), 8.0 * (1.0 - values / 255.0), 0.0)
    column = (left + (np.arange(10) + 0.5) * (right - left) / 10).astype(int)
    row = (top + (np.arange(8) + 0.5) * (bottom - top) / 8).astype(int)
    np.testing.assert_allclose(scene.depth_image(4), distance[row[:, None], column], atol=1e-5)
    assert (scene.pool.tolist(), scene.test.tolist()) == (plain.pool.tolist(), plain.test.tolist())


@pytest.mark.parametrize("name", LAYOUTS)
def test_photos_that_are_not_larger_than_what_is_trained_on_cannot_be_cropped(tmp_path, name):
    if name in COLMAP:
        pytest.importorskip("pycolmap")
    root, kind = LAYOUTS[name].write(tmp_path / "scene") or tmp_path / "scene", LAYOUTS[name].kind
    with pytest.raises(
        SceneError, match=r"pool\.factor: zoom by 3 .* image_size of at most \d, or"
    ):
        load_scene(kind, root=root, zoom=ZOOM)
    scene = load_scene(kind, root=root, zoom=Zoom(2.0, 0), image_size=2)
    plain = load_scene(kind, root=root, image_size=2)
    ratios = scene.cameras.intrinsics[:, 0] / plain.cameras.intrinsics[:, 0]
    assert (ratios >= 1.0).all() and (ratios > 1.1).any()


# --- cameras moved ---


@pytest.fixture(scope="module")
def moved():
    return load_procedural(image_size=20, num_train=6, num_test=6, zoom=ZOOM)


def test_the_procedural_cameras_stand_between_a_root_and_its_inverse(moved):
    plain = load_procedural(image_size=20, num_train=6, num_test=6)
    ratio = np.linalg.norm(moved.cameras.positions, axis=-1) / 3.2
    assert (ratio > 3**-0.5 - 1e-6).all() and (ratio < 3**0.5 + 1e-6).all()
    for part in (moved.pool, moved.test):
        assert ratio[part].min() < 0.9 and ratio[part].max() > 1.1
    np.testing.assert_allclose(
        moved.cameras.positions, ratio[:, None] * plain.cameras.positions, rtol=1e-5, atol=1e-6
    )
    turn = slice(None), slice(None), slice(3)
    np.testing.assert_array_equal(
        moved.cameras.world_from_cam[turn], plain.cameras.world_from_cam[turn]
    )
    np.testing.assert_array_equal(moved.cameras.intrinsics, plain.cameras.intrinsics)
    corner = np.sqrt(3.0)
    lengths = np.linalg.norm(moved.cameras.positions, axis=-1)
    assert 0.0 < moved.near <= lengths.min() - corner and moved.far >= lengths.max() + corner
    assert (plain.near, plain.far) == (3.2 - corner, 3.2 + corner)


def test_photos_are_taken_anew_from_there(moved):
    lengths = np.linalg.norm(moved.cameras.positions, axis=-1)
    for view in (int(lengths.argmin()), int(lengths.argmax())):
        rays = pixel_rays(moved.cameras, np.full(400, view), image_pixels(20, 20))
        expected, clipped = brute_force_depth(
            *(np.asarray(a) for a in (rays.origins, rays.directions)),
            near=max(lengths[view] - 1.0, 0.0),
            far=lengths[view] + 1.0,
            step=1e-3,
        )
        found = moved.depth_image(view).ravel()
        assert clipped.mean() < 0.1
        np.testing.assert_array_equal((found > 0.0)[~clipped], (expected > 0.0)[~clipped])
        np.testing.assert_allclose(found[~clipped], expected[~clipped], atol=1e-4)
    seen = (moved.depth.reshape(12, -1) > 0.0).mean(axis=1)
    assert seen[lengths.argmin()] > 2.0 * seen[lengths.argmax()]


def test_a_cache_of_other_distances_is_another_one(tmp_path, moved):
    options = {"image_size": 20, "num_train": 6, "num_test": 6, "cache_dir": tmp_path}
    for zoom in (None, ZOOM, ZOOM._replace(seed=5), ZOOM._replace(factor=2.0)):
        load_procedural(zoom=zoom, **options)
    assert len([*tmp_path.iterdir()]) == 4
    np.testing.assert_array_equal(load_procedural(zoom=ZOOM, **options).pixels, moved.pixels)


def test_cameras_do_not_go_inside_of_the_scene():
    with pytest.raises(SceneError, match=r"pool\.factor: zoom by 10 .* give at most 9\.4"):
        load_procedural(image_size=4, zoom=Zoom(10.0, 0))
    assert load_procedural(image_size=2, num_train=1, num_test=1, zoom=Zoom(9.4, 0)).near == 0.05
