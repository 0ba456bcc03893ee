"""Cameras: lenses, poses and rays against closed forms and an independent projection."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from bavs_jax import cameras as cams

DISTORTIONS = {
    "pinhole": np.zeros(6),
    "opencv": np.array([-0.28, 0.09, -0.02, 0.004, 0.006, -0.008]),  # a wide action camera
    "fisheye": np.array([-0.03, 0.004, -0.001, 0.0, 0.0, 0.0]),
}
WIDTH, HEIGHT = 64, 48


def random_cameras(num: int, *, lens: str = "pinhole") -> cams.Cameras:
    rng = np.random.default_rng(0)
    poses = [cams.look_at(rng.normal(size=3) * 3.0, rng.normal(size=3)) for _ in range(num)]
    intrinsics = [[40.0 + i, 42.0, 31.0, 25.0 + i] for i in range(num)]
    distortion = np.tile(DISTORTIONS[lens], (num, 1))
    sizes = [[WIDTH, HEIGHT]] * num
    return cams.make_cameras(poses, intrinsics, sizes, distortion=distortion, lens=lens)


def project(pose, intrinsics, distortion, points):
    """Pixels [N, 2] of world points [N, 3], in the textbook's way and in float64."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    x, y = local[:, 0] / -local[:, 2], -local[:, 1] / -local[:, 2]
    k1, k2, k3, k4, p1, p2 = distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    fx, fy, cx, cy = intrinsics
    return np.stack([fx * xd + cx, fy * yd + cy], axis=-1)


@pytest.mark.parametrize("seed", range(5))
def test_look_at_is_a_rotation_that_looks_at_its_target(seed):
    rng = np.random.default_rng(seed)
    position, target, up = rng.normal(size=(3, 3))
    pose = cams.look_at(position, target, up)
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose[:, :3]), 1.0, atol=1e-12)
    forward = (target - position) / np.linalg.norm(target - position)
    np.testing.assert_allclose(-pose[:, 2], forward, atol=1e-12)
    assert pose[:, 1] @ up > 0.0


def test_look_at_along_up_is_still_a_rotation():
    pose = cams.look_at([0.0, 0.0, 2.0], [0.0, 0.0, 0.0])
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-12)


@pytest.mark.parametrize("lens", ["pinhole", "opencv"])
def test_points_on_pixel_rays_project_back_to_their_pixels(lens):
    cameras = random_cameras(3, lens=lens)
    pixels = cams.image_pixels(WIDTH, HEIGHT)[::7]
    for view in range(3):
        rays = cams.pixel_rays(cameras, np.full(len(pixels), view), pixels)
        np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=-1), 1.0, atol=1e-6)
        points = np.asarray(rays.origins + 2.3 * rays.directions, np.float64)
        seen = project(
            *(
                np.asarray(a[view], np.float64)
                for a in (cameras.world_from_cam, cameras.intrinsics)
            ),
            np.asarray(cameras.distortion[view], np.float64),
            points,
        )
        # float32 rays: 1e-7 of a 60-pixel image, and some rounding of the pose.
        np.testing.assert_allclose(seen, pixels, atol=2e-4)


def test_the_middle_pixel_looks_along_the_optical_axis():
    cameras = cams.make_cameras(
        [cams.look_at([1.0, 2.0, 3.0], [0.0, 0.0, 0.0])], [[50.0, 50.0, 32.0, 24.0]], [[64, 48]]
    )
    rays = cams.pixel_rays(cameras, np.array([0]), np.array([[32.0, 24.0]], np.float32))
    np.testing.assert_allclose(rays.directions[0], -cameras.world_from_cam[0, :, 2], atol=1e-6)


def test_fisheye_rays_reach_behind_the_camera():
    """An equidistant fisheye of 220 degrees: rays at the edge point backwards."""
    focal = 32.0 / np.deg2rad(110.0)
    pose = cams.look_at([1.0, 2.0, 3.0], [0.0, 0.5, 0.0])
    cameras = cams.make_cameras([pose], [[focal, focal, 32.0, 32.0]], [[64, 64]], lens="fisheye")
    pixels = np.array([[64.0, 32.0], [32.0, 0.0], [32.0, 32.0], [48.0, 32.0]], np.float32)
    rays = cams.pixel_rays(cameras, np.zeros(4, int), pixels)
    local = np.asarray(rays.directions) @ pose[:, :3]
    wide = np.deg2rad(110.0)
    expected = [
        [np.sin(wide), 0.0, -np.cos(wide)],
        [0.0, np.sin(wide), -np.cos(wide)],  # the upper edge of the image is up
        [0.0, 0.0, -1.0],
        [np.sin(0.5 * wide), 0.0, -np.cos(0.5 * wide)],
    ]
    np.testing.assert_allclose(local, expected, atol=1e-6)
    assert local[0, 2] > 0.3


@pytest.mark.parametrize("lens", ["pinhole", "opencv", "fisheye"])
def test_rescale_keeps_rays(lens):
    cameras = random_cameras(2, lens=lens)
    sizes = np.array([[32, 24], [20, 31]])  # the second one changes the aspect
    small = cams.rescale(cameras, sizes)
    ids = np.arange(2)
    pixels = np.array([[13.0, 40.0], [50.5, 7.25]], np.float32)
    factor = (sizes / np.array([WIDTH, HEIGHT])).astype(np.float32)
    rays = cams.pixel_rays(cameras, ids, pixels)
    scaled = cams.pixel_rays(small, ids, pixels * factor)
    np.testing.assert_allclose(scaled.directions, rays.directions, atol=1e-6)
    np.testing.assert_array_equal(small.sizes, sizes)


def test_take_selects_views_in_order():
    cameras = random_cameras(4)
    chosen = cams.take(cameras, np.array([2, 0]))
    np.testing.assert_array_equal(chosen.intrinsics, np.asarray(cameras.intrinsics)[[2, 0]])
    assert len(chosen) == 2
    assert chosen.lens == cameras.lens


def test_image_pixels_are_centres_in_row_order():
    np.testing.assert_array_equal(
        cams.image_pixels(2, 2), [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]]
    )


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, -2.0, 0.5)])
def test_hemisphere_is_uniform_in_area_and_looks_at_its_centre(up):
    num, centre, radius = 4000, np.array([0.5, -1.0, 2.0]), 3.0
    poses = cams.hemisphere_poses(jax.random.key(1), num, centre=centre, radius=radius, up=up)
    offsets = (poses[:, :, 3] - centre) / radius
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(-poses[:, :, 2], -offsets, atol=1e-6)
    gram = np.einsum("vij,vik->vjk", poses[:, :, :3], poses[:, :, :3])
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), gram.shape), atol=1e-6)

    # Archimedes: equal areas are equal heights, so the height is uniform on [0, 1].
    height = np.sort(offsets @ (np.array(up) / np.linalg.norm(up)))
    assert height[0] >= -1e-6
    steps = np.arange(num) / num
    distance = np.maximum(np.abs(height - steps), np.abs(height - steps - 1 / num)).max()
    # Kolmogorov: P(D > 1.95 / sqrt(n)) is 1e-3.
    assert distance < 1.95 / np.sqrt(num)
    # Around the pole no direction is preferred: 5 standard errors, each 1 / sqrt(3 n) per axis.
    sideways = offsets - np.outer(offsets @ up, up) / np.dot(up, up)
    np.testing.assert_allclose(sideways.mean(axis=0), 0.0, atol=5.0 / np.sqrt(3.0 * num))


def test_hemisphere_depends_on_its_key_only():
    args = {"centre": (0.0, 0.0, 0.0), "radius": 1.0}
    first, again = (cams.hemisphere_poses(jax.random.key(3), 5, **args) for _ in range(2))
    other = cams.hemisphere_poses(jax.random.key(4), 5, **args)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
