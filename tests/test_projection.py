"""Points to pixels: the inverse of rays through pixels, for every lens."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, look_at, make_cameras, pixel_rays, project
from tests import oracles_pixel as oracles

SIZE = (40, 30)
LENSES = {
    "pinhole": np.zeros(6),
    "opencv": np.array([-0.28, 0.09, -0.02, 0.004, 0.006, -0.008]),
    "fisheye": np.array([-0.02, 0.003, -0.0005, 0.0001, 0.0, 0.0]),
}


def cameras_of(lens, *, focal=30.0):
    rng = np.random.default_rng(0)
    poses = [look_at(4.0 * p / np.linalg.norm(p), np.zeros(3)) for p in rng.normal(size=(3, 3))]
    return make_cameras(
        np.stack(poses),
        [[focal, 1.1 * focal, 19.0, 16.0]] * 3,
        [SIZE] * 3,
        distortion=np.tile(LENSES[lens], (3, 1)).astype(np.float32),
        lens=lens,
    )


# Every camera at points [K, 3] of its own, or at the same ones.
project_own = jax.jit(jax.vmap(project))
project_all = jax.jit(jax.vmap(project, in_axes=(0, None)))


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_come_back_from_points_on_their_rays(lens):
    cameras = cameras_of(lens)
    pixels = image_pixels(*SIZE)
    ids = np.repeat(np.arange(3), len(pixels))
    rays = pixel_rays(cameras, ids, jnp.tile(pixels, (3, 1)))
    distance = np.random.default_rng(1).uniform(0.5, 9.0, (len(ids), 1))
    points = (rays.origins + distance * rays.directions).reshape(3, -1, 3)
    seen, is_in_image = project_own(cameras, points)
    assert is_in_image.all()
    # A thousandth of a pixel: float32, and Newton's rest of the undistortion.
    np.testing.assert_allclose(seen, np.broadcast_to(pixels, seen.shape), atol=1e-3)


def test_pinhole_against_similar_triangles():
    cameras = cameras_of("pinhole")
    points = np.random.default_rng(2).normal(size=(200, 3)).astype(np.float32) * 3.0
    seen, is_in_image = project_all(cameras, points)
    assert 0.05 < np.mean(is_in_image) < 0.95
    for v in range(3):
        for k in range(200):
            pixel = oracles.sees(cameras.world_from_cam[v], cameras.intrinsics[v], SIZE, points[k])
            assert is_in_image[v, k] == (pixel is not None)
            expected = (0.0, 0.0) if pixel is None else pixel
            np.testing.assert_allclose(seen[v, k], expected, atol=1e-3)  # float32, 40 pixels


@pytest.mark.parametrize("lens", LENSES)
def test_what_lies_behind_is_not_seen_and_nothing_is_infinite(lens):
    cameras = cameras_of(lens)
    ahead = -cameras.world_from_cam[:, :, 2]
    centre = cameras.positions
    points = np.stack([centre - ahead, centre, centre + 1e-30 * ahead, centre + ahead], axis=1)
    pixels, is_in_image = project_own(cameras, points)
    np.testing.assert_array_equal(is_in_image, np.tile([False, False, False, True], (3, 1)))
    assert np.isfinite(pixels).all()


def test_a_barrel_lens_does_not_fold_the_outside_into_its_image():
    """`r (1 - 0.3 r^2)` is 0 again at r = 1.83: a direction of 61 degrees, far outside."""
    radius = np.sqrt(1.0 / 0.3)
    camera = make_cameras(
        [look_at([0.0, -1.0, 0.0], np.zeros(3))],
        [[30.0, 30.0, 20.0, 15.0]],
        [SIZE],
        distortion=[[-0.3, 0.0, 0.0, 0.0, 0.0, 0.0]],
        lens="opencv",
    )
    points = np.array([[[radius, 0.0, 0.0], [0.5, 0.0, 0.0]]], np.float32)
    _, is_in_image = project_own(camera, points)
    np.testing.assert_array_equal(is_in_image, [[False, True]])


def test_a_wide_fisheye_sees_what_lies_to_its_side_and_behind():
    camera = make_cameras(
        [look_at([0.0, -1.0, 0.0], [0.0, 0.0, 0.0])],
        [[6.0, 6.0, 20.0, 15.0]],
        [SIZE],
        lens="fisheye",
    )
    points = np.array([[[5.0, -1.0, 0.0], [5.0, -6.0, 0.0]]], np.float32)  # at 90 and 135 degrees
    pixels, is_in_image = project_own(camera, points)
    assert is_in_image.all()
    expected = [[20.0 + 6.0 * np.pi / 2, 15.0], [20.0 + 6.0 * 0.75 * np.pi, 15.0]]
    np.testing.assert_allclose(pixels[0], expected, atol=1e-4)  # float32
