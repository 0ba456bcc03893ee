"""Lenses: round trips over the whole image, strong and wide ones, and OpenCV where it agrees."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax import lenses

# k1, k2, k3, k4, p1, p2, and the largest radius in use: in the plane z = -1, or radians.
OPENCV_LENSES = {
    "phone": ([0.08, -0.19, 0.12, 0.0, 0.001, -0.002], 1.0),
    "action camera": ([-0.28, 0.09, -0.02, 0.004, 0.006, -0.008], 3.0),
    "barrel that folds": ([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0], 1.05),
    "pincushion": ([0.5, 0.2, 0.0, 0.0, 0.01, 0.01], 2.0),
}
FISHEYE_LENSES = {
    "equidistant": ([0.0, 0.0, 0.0, 0.0], np.pi),
    "mirrorless": ([-0.02, 0.003, -0.0005, 0.0001], 1.5),
    "over 180 degrees": ([-0.03, -0.005, 0.001, -0.0002], 2.0),
    "stretched": ([0.1, -0.01, 0.0, 0.0], 2.5),
}


def disc(radius: float, num: int = 41) -> np.ndarray:
    """Points [N, 2] all over a disc, with its centre."""
    axis = np.linspace(-radius, radius, num)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.linalg.norm(points, axis=-1) <= radius]


def undistort(points, distortion, lens):
    fn = jax.vmap(lambda p: lenses.undistort(p, jnp.asarray(distortion), lens=lens))
    return np.asarray(jax.jit(fn)(jnp.asarray(points)))


@pytest.mark.parametrize("name", OPENCV_LENSES)
def test_opencv_comes_back_over_the_whole_image(name):
    distortion, radius = OPENCV_LENSES[name]
    with jax.enable_x64(True):
        points = disc(0.99 * radius)
        seen = lenses.distort_opencv(jnp.asarray(points), jnp.asarray(distortion))
        # Newton converges quadratically: the rest is rounding, magnified close to the fold.
        np.testing.assert_allclose(undistort(seen, distortion, "opencv"), points, atol=1e-11)


@pytest.mark.parametrize("name", FISHEYE_LENSES)
def test_fisheye_comes_back_over_the_whole_image(name):
    coefficients, radius = FISHEYE_LENSES[name]
    distortion = np.array([*coefficients, 0.0, 0.0])
    with jax.enable_x64(True):
        points = disc(0.99 * radius)
        seen = lenses.distort_fisheye(jnp.asarray(points), jnp.asarray(distortion))
        np.testing.assert_allclose(undistort(seen, distortion, "fisheye"), points, atol=1e-11)


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_single_precision_is_good_for_a_thousandth_of_a_pixel(lens):
    distortion = np.array([-0.05, 0.01, -0.002, 0.0004, 0.0, 0.0], np.float32)
    points = disc(1.4).astype(np.float32)
    seen = lenses.LENSES[lens](jnp.asarray(points), jnp.asarray(distortion))
    # 1e-6 of a focal length of 1,000 pixels.
    np.testing.assert_allclose(undistort(seen, distortion, lens), points, atol=1e-6)


def test_range_ends_where_the_lens_folds():
    """`r + k1 r^3` is highest at `r = 1 / sqrt(-3 k1)`."""
    distortion = jnp.array([-0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    for lens in ("opencv", "fisheye"):
        radii = lenses.rising_radii(distortion, lens=lens)
        # The slope is parabolic, and taken for straight between radii 0.04 apart.
        np.testing.assert_allclose(radii[-1], 1.0 / np.sqrt(0.9), rtol=1e-3)
        assert (np.diff(radii) >= 0.0).all()
    ideal = lenses.rising_radii(jnp.zeros(6), lens="fisheye")
    np.testing.assert_allclose(ideal[-1], np.pi, rtol=1e-6)


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
def test_what_no_direction_is_seen_at_gets_the_edge(lens):
    distortion = jnp.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0])  # r (1 - r^2 / 2) is at most 0.545
    far_out = undistort(np.array([[0.9, 0.9], [-30.0, 1.0]]), distortion, lens)
    edge = lenses.rising_radii(distortion, lens=lens)[-1]
    np.testing.assert_allclose(np.linalg.norm(far_out, axis=-1), edge, rtol=1e-6)


@pytest.mark.parametrize("lens", lenses.LENSES)
def test_the_centre_is_seen_at_the_centre_and_has_a_gradient(lens):
    distortion = jnp.array([0.1, 0.02, 0.0, 0.0, 0.0, 0.0])

    def direction(point):
        return lenses.lens_directions(lenses.undistort(point, distortion, lens=lens), lens=lens)

    np.testing.assert_allclose(direction(jnp.zeros(2)), [0.0, 0.0, -1.0], atol=1e-7)
    assert np.isfinite(jax.jacrev(direction)(jnp.zeros(2))).all()


def test_fisheye_directions_turn_by_the_angle():
    """Also beyond 90 degrees, where a direction has no place on the plane z = -1."""
    theta = np.array([0.0, 0.3, 1.2, 0.5 * np.pi, 2.0, 3.0])
    phi = 0.7
    points = theta[:, None] * np.array([np.cos(phi), np.sin(phi)])
    directions = np.asarray(lenses.lens_directions(jnp.asarray(points), lens="fisheye"))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(np.arccos(-directions[:, 2].clip(-1, 1)), theta, atol=1e-3)
    sideways = np.sin(theta)[:, None] * [np.cos(phi), -np.sin(phi)]
    np.testing.assert_allclose(directions[:, :2], sideways, atol=1e-6)


# --- against OpenCV --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["phone", "action camera", "pincushion"])
def test_opencv_agrees_with_opencv(name):
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is in the extra [test]")
    k1, k2, k3, _, p1, p2 = OPENCV_LENSES[name][0]
    distortion = np.array([k1, k2, k3, 0.0, p1, p2])  # OpenCV's k4 is a denominator's
    seen = disc(0.6)
    # OpenCV iterates a fixed point: 5 times unless it is told to go on.
    goal = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    theirs = cv2.undistortPoints(
        seen[:, None], np.eye(3), np.array([k1, k2, p1, p2, k3]), None, None, None, goal
    )[:, 0]
    with jax.enable_x64(True):
        np.testing.assert_allclose(undistort(seen, distortion, "opencv"), theirs, atol=1e-9)


@pytest.mark.parametrize("name", ["equidistant", "mirrorless", "stretched"])
def test_fisheye_agrees_with_opencv(name):
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is in the extra [test]")
    coefficients = np.array(FISHEYE_LENSES[name][0])
    seen = disc(1.3)
    theirs = cv2.fisheye.undistortPoints(seen[:, None], np.eye(3), coefficients.reshape(4, 1))[:, 0]
    with jax.enable_x64(True):
        angles = undistort(seen, np.array([*coefficients, 0.0, 0.0]), "fisheye")
        directions = np.asarray(lenses.lens_directions(jnp.asarray(angles), lens="fisheye"))
    mine = directions[:, :2] * [1.0, -1.0] / -directions[:, 2:]
    # OpenCV stops at steps of 1e-8 radians; the tangent of 85 degrees magnifies them by 100.
    np.testing.assert_allclose(mine, theirs, rtol=1e-6, atol=1e-8)
