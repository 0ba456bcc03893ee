"""The procedural scene: its distance field, its depth and colour against brute force, its cache."""

from __future__ import annotations

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.cameras import Cameras, image_pixels, make_cameras, pixel_rays, take
from bavs_jax.scenes import SceneError, load_procedural, photographs, procedural, sculpture, sdf
from tests.oracles_scenes import brute_force_depth, distances, surface_colour

SIZE = 20  # pixels; images of these tests are small
NEAR, FAR = 2.0, 4.3  # scene units; around the object as seen from the cameras


def some_cameras(num: int = 3) -> Cameras:
    return procedural.draw_cameras(jax.random.key(7), num, image_size=SIZE)


@pytest.fixture(scope="module")
def captured():
    cameras = some_cameras()
    return cameras, *procedural.capture(cameras)


# --- distance field --------------------------------------------------------------------------


def components(*xyz: float) -> tuple:
    return tuple(jnp.asarray(c) for c in xyz)


def test_primitives_at_points_with_known_distances():
    origin = (0.0, 0.0, 0.0)
    cases = [
        (sdf.sphere(components(3.0, 4.0, 0.0), origin, 2.0), 3.0),
        (sdf.box(components(4.0, 5.0, 0.0), origin, (1.0, 1.0, 1.0)), 5.0),
        (sdf.box(components(0.0, 0.7, 0.0), origin, (1.0, 1.0, 1.0)), -0.3),
        (sdf.box(components(2.0, 0.0, 0.0), origin, (1.0, 1.0, 1.0), 0.2), 1.0),
        (sdf.disc(components(4.0, 0.0, 5.0), origin, 1.0, 1.0), 5.0),
        (sdf.disc(components(0.0, 0.0, 0.5), origin, 3.0, 1.0), -0.5),
        (sdf.capsule(components(0.0, 3.0, 9.0), origin, (0.0, 0.0, 5.0), 1.0), 4.0),
        (sdf.torus(components(3.0, 4.0, 0.0), origin, 3.0, 1.0), 3.0),
        (sdf.arch(components(3.0, 4.0, 0.0), origin, 3.0, 1.0), 3.0),
        (sdf.arch(components(-3.0, 0.0, -5.0), origin, 3.0, 1.0), 4.0),
    ]
    for number, (value, expected) in enumerate(cases):
        np.testing.assert_allclose(value, expected, atol=1e-5, err_msg=f"case {number}")


def test_signed_distance_is_1_lipschitz():
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.2, 1.2, (200_000, 3))
    # Near and far pairs: the first find wrong gradients, the others wrong unions.
    q = p + rng.normal(size=p.shape) * 10.0 ** rng.uniform(-4.0, 0.0, (len(p), 1))
    change = np.abs(distances(p) - distances(q))
    apart = np.linalg.norm(p - q, axis=-1)
    # 1e-6: the 1e-12 under the roots.
    assert (change <= apart * (1.0 + 1e-9) + 1e-6).all()


def test_object_lies_within_its_ball_and_has_an_inside():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    outside = directions * rng.uniform(sculpture.SCENE_RADIUS, 1.8, (len(directions), 1))
    assert distances(outside).min() > 0.0
    inside = distances(rng.uniform(-1.0, 1.0, (50_000, 3))) < 0.0
    assert 0.03 < inside.mean() < 0.3


def test_detail_is_uneven():
    """The carved side has much more texture than the smooth one, as selection needs it."""
    cameras = procedural.draw_cameras(jax.random.key(0), 24, image_size=32)
    pixels, _, _ = procedural.capture(cameras)
    grey = pixels.reshape(24, 32, 32, 3).mean(axis=-1)
    detail = np.abs(np.diff(grey, axis=1)).mean(axis=(1, 2))
    towards_wall = np.asarray(cameras.positions) @ [
        -np.sin(sculpture.TURN),
        np.cos(sculpture.TURN),
        0,
    ]
    carved, smooth = detail[towards_wall > 1.5], detail[towards_wall < -1.5]
    assert carved.min() > smooth.max()


# --- pictures --------------------------------------------------------------------------------


def test_depth_equals_brute_force(captured):
    cameras, _, _, depth = captured
    for view in range(2):
        rays = pixel_rays(cameras, np.full(SIZE**2, view), image_pixels(SIZE, SIZE))
        expected, clipped = brute_force_depth(
            *(np.asarray(a) for a in (rays.origins, rays.directions)), near=NEAR, far=FAR, step=1e-3
        )
        found = depth[view * SIZE**2 : (view + 1) * SIZE**2]
        assert clipped.mean() < 0.05  # the exception, not the rule
        assert (expected > 0.0).mean() > 0.2
        np.testing.assert_array_equal((found > 0.0)[~clipped], (expected > 0.0)[~clipped])
        # Float32 positions of size 3 are good to 3e-7; a grazing ray magnifies that.
        np.testing.assert_allclose(found[~clipped], expected[~clipped], atol=1e-4)


def test_colour_is_the_mean_over_the_pixel(captured):
    cameras, pixels, *_ = captured
    chosen = np.random.default_rng(0).choice(SIZE**2, 120, replace=False)
    centres, ids = image_pixels(SIZE, SIZE)[chosen], np.zeros(len(chosen), int)
    total = np.zeros((len(chosen), 3))
    for dx in (-1 / 3, 0, 1 / 3):
        for dy in (-1 / 3, 0, 1 / 3):
            rays = pixel_rays(cameras, ids, centres + np.float32([dx, dy]))
            origins, directions = (np.asarray(a) for a in (rays.origins, rays.directions))
            depth, _ = brute_force_depth(origins, directions, near=NEAR, far=FAR, step=4e-3)
            points = origins + depth[:, None].astype(np.float32) * directions
            total += np.where(
                depth[:, None] > 0.0, surface_colour(sculpture.shade, points, directions), 1.0
            )
    error = np.abs(pixels[chosen] - 255.0 * total / 9.0).max(axis=-1)
    # Half a step of rounding, and what 3e-4 of the surface's distance changes. At this size one ray
    # of nine may fall to the other side of an edge, up to 255 / 9: rare.
    assert np.median(error) < 0.6
    assert np.mean(error < 2.0) > 0.9
    assert error.max() < 2.0 * 255.0 / 9.0


def test_the_field_of_view_holds_the_whole_object(captured):
    silhouette = np.arcsin(sculpture.SCENE_RADIUS / procedural.CAMERA_RADIUS)
    assert silhouette < 0.5 * procedural.FIELD_OF_VIEW
    _, pixels, _, depth = captured
    images, depths = pixels.reshape(-1, SIZE, SIZE, 3), depth.reshape(-1, SIZE, SIZE)
    np.testing.assert_array_equal(images[:, 0, [0, -1]], 255)  # white corners
    np.testing.assert_array_equal(depths[(images == 255).all(axis=-1)], 0.0)


def test_highlights_move_with_the_viewer():
    # The top of the ring, where the surface is level.
    (u, v, w), ring, tube = sculpture.RING
    cos, sin = np.cos(sculpture.TURN), np.sin(sculpture.TURN)
    top = [[cos * u - sin * v, sin * u + cos * v, w + ring + tube + sculpture.LIFT]]
    np.testing.assert_allclose(distances(np.array(top)), 0.0, atol=1e-6)
    towards_mirror = np.array([[-sculpture.SUN[0], -sculpture.SUN[1], sculpture.SUN[2]]])
    bright = surface_colour(sculpture.shade, np.float32(top), -np.float32(towards_mirror))
    dull = surface_colour(sculpture.shade, np.float32(top), np.float32([[0.0, 0.0, -1.0]]))
    assert (bright - dull).max() > 0.2
    assert (bright >= dull).all()


def test_captures_of_any_poses_agree_and_compile_nothing_new(captured):
    cameras, pixels, alpha, depth = captured
    steps = photographs.compiled_steps(procedural.subject("sculpture"))
    compiled = [step._cache_size() for step in steps]
    other_pixels, other_alpha, other_depth = procedural.capture(take(cameras, np.array([2, 0])))
    rows = SIZE**2
    np.testing.assert_array_equal(other_pixels, np.r_[pixels[2 * rows :], pixels[:rows]])
    np.testing.assert_array_equal(other_alpha, np.r_[alpha[2 * rows :], alpha[:rows]])
    np.testing.assert_array_equal(other_depth, np.r_[depth[2 * rows :], depth[:rows]])
    assert [step._cache_size() for step in steps] == compiled


def test_mixed_sizes_and_views_past_the_object():
    pose = np.array(some_cameras(1).world_from_cam)[0]
    away = pose.copy()
    away[:, [0, 2]] *= -1.0  # turned by half a circle
    cameras = make_cameras(
        [pose, away], [[10.0, 10.0, 4.0, 3.0], [9.0, 9.0, 2.0, 2.0]], [[8, 6], [4, 4]]
    )
    pixels, alpha, depth = procedural.capture(cameras)
    assert pixels.shape == (48 + 16, 3)
    assert (depth[:48] > 0.0).any()
    np.testing.assert_array_equal(pixels[48:], 255)
    np.testing.assert_array_equal(alpha[48:], 0)
    # A pixel whose middle meets the object is at least partly covered, and far from it none is.
    assert (alpha[:48][depth[:48] > 0.0] > 0).all() and (alpha[:48] == 0).any()
    np.testing.assert_array_equal(depth[48:], 0.0)


# --- scene and cache -------------------------------------------------------------------------

TINY = {"image_size": 8, "num_train": 3, "num_test": 2}


def test_scene_has_splits_depth_and_a_box_between_near_and_far():
    scene = load_procedural(**TINY)
    np.testing.assert_array_equal(scene.pool, [0, 1, 2])
    np.testing.assert_array_equal(scene.test, [3, 4])
    assert scene.num_views == 5
    assert scene.image(4).shape == (8, 8, 3)
    assert scene.pixels.dtype == np.uint8
    found = scene.depth[scene.depth > 0.0]
    assert scene.near < found.min() < found.max() < scene.far
    positions = np.asarray(scene.cameras.positions)
    assert (positions[:, 2] >= -1e-6).all()  # upper hemisphere
    np.testing.assert_allclose(np.linalg.norm(positions, axis=-1), 3.2, rtol=1e-6)
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)[~np.eye(5, dtype=bool)]
    assert gaps.min() > 0.0  # train and test poses come from different keys


def test_a_cached_scene_equals_a_fresh_one(tmp_path, monkeypatch):
    fresh = load_procedural(**TINY)
    first = load_procedural(**TINY, cache_dir=tmp_path / "cache")

    def refuse(cameras):
        raise AssertionError("rendered although there is a cache")

    monkeypatch.setattr(procedural, "capture", refuse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        second = load_procedural(**TINY, cache_dir=tmp_path / "cache")
    for scene in (first, second):
        np.testing.assert_array_equal(scene.pixels, fresh.pixels)
        np.testing.assert_array_equal(scene.depth, fresh.depth)
        np.testing.assert_array_equal(scene.cameras.world_from_cam, fresh.cameras.world_from_cam)
    assert [path.suffix for path in (tmp_path / "cache").iterdir()] == [".npz"]


def test_other_arguments_use_other_caches(tmp_path):
    first = load_procedural(**TINY, cache_dir=tmp_path)
    other = load_procedural(**TINY, cache_dir=tmp_path, seed=1)
    assert len(list(tmp_path.iterdir())) == 2
    assert (first.pixels != other.pixels).any()


@pytest.mark.parametrize("damage", ["cut", "flipped", "text", "empty", "shape"])
def test_a_damaged_cache_is_made_anew_with_a_warning(tmp_path, damage):
    fresh = load_procedural(**TINY, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        content[len(content) // 2] ^= 0xFF
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("no archive")
    elif damage == "empty":
        path.write_bytes(b"")
    else:
        np.savez(path, pixels=np.zeros((3, 3), np.uint8), depth=np.zeros(3, np.float32))
    with pytest.warns(UserWarning, match=r"procedural-.*\.npz: cache .* made anew"):
        again = load_procedural(**TINY, cache_dir=tmp_path)
    np.testing.assert_array_equal(again.pixels, fresh.pixels)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_procedural(**TINY, cache_dir=tmp_path)


@pytest.mark.parametrize("field", ["image_size", "num_train", "num_test"])
def test_sizes_below_one_are_named(field):
    with pytest.raises(SceneError, match=f"{field}: is 0"):
        load_procedural(**{**TINY, field: 0})
