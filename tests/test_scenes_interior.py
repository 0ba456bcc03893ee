"""The interior: its distance field, photographs against brute force, where cameras stand, a run."""

from __future__ import annotations

import json
from functools import partial

import jax
import numpy as np
import pytest

from bavs_jax.cameras import image_pixels, pixel_rays, project, take
from bavs_jax.placement.clearance import judge_positions
from bavs_jax.scenes import SceneError, interior, load_procedural, procedural
from tests.oracles_scenes import brute_force_depth, distances, surface_colour
from tests.test_run import script
from tests.toy_runs import TINY, toy_flags

SIZE = 16  # pixels; images of these tests are small
NEAR, FAR = 0.15, 3.6  # scene units; below the clearance, beyond the longest view
SUBPIXELS = (-1 / 3, 0, 1 / 3)


def room_distances(points: np.ndarray) -> np.ndarray:
    return distances(points, interior.signed_distance)


@pytest.fixture(scope="module")
def captured():
    cameras = procedural.draw_cameras(jax.random.key(3), 2, image_size=SIZE, scene="interior")
    return cameras, procedural.capture(cameras, "interior")


@pytest.fixture(scope="module")
def scene(cache):
    return load_procedural(scene="interior", image_size=SIZE, cache_dir=cache / "scenes")


# --- distance field --------------------------------------------------------------------------


def in_box(p, centre, half) -> np.ndarray:
    return (np.abs(p - np.array(centre)) < np.array(half)).all(axis=-1)


def in_disc(p, centre, radius, half_height) -> np.ndarray:
    x, y, z = (p - np.array(centre)).T
    return (np.hypot(x, y) < radius) & (np.abs(z) < half_height)


def in_matter(p: np.ndarray) -> np.ndarray:
    """Whether points [K, 3] lie in something, by inequalities; edges count as sharp."""
    air = in_box(p, *interior.ROOM) | in_box(p, *interior.NICHE)
    window = in_box(p, *interior.WINDOW)
    (rx, ry, rz), ring, tube = interior.RING
    ring_gap = np.hypot(np.hypot(p[:, 0] - rx, p[:, 2] - rz) - ring, p[:, 1] - ry)
    start, end, radius = (np.array(a) for a in interior.URN)
    nearest = np.clip(p[:, 2], start[2], end[2])
    urn_gap = np.linalg.norm(
        p - np.stack([*(np.full(len(p), c) for c in start[:2]), nearest], -1), axis=-1
    )
    return (
        ~air
        | in_box(p, *interior.LEFT_PARTITION)
        | (in_box(p, *interior.RIGHT_PARTITION) & ~window)
        | in_disc(p, *interior.ROUND_COLUMN)
        | in_box(p, *interior.SQUARE_COLUMN)
        | in_disc(p, *interior.TABLE_TOP)
        | in_disc(p, *interior.TABLE_LEG)
        | (ring_gap < tube)
        | in_box(p, *interior.BENCH)
        | (np.linalg.norm(p - np.array(interior.BALL[0]), axis=-1) < interior.BALL[1])
        | (urn_gap < radius)
    )


def test_the_sign_says_what_is_matter():
    points = np.random.default_rng(0).uniform(*interior.SCENE_BOX, (100_000, 3))
    value, solid = room_distances(points), in_matter(points)
    # Rounded edges lose up to (sqrt(3) - 1) of their radius.
    decided = np.abs(value) > interior.ROUNDING
    np.testing.assert_array_equal((value < 0.0)[decided], solid[decided])
    assert decided.mean() > 0.85 and 0.2 < solid.mean() < 0.6


def test_signed_distance_is_1_lipschitz():
    rng = np.random.default_rng(0)
    p = rng.uniform(*np.multiply(1.2, interior.SCENE_BOX), (100_000, 3))
    # Near and far pairs: the first find wrong gradients, the others wrong unions.
    q = p + rng.normal(size=p.shape) * 10.0 ** rng.uniform(-4.0, 0.0, (len(p), 1))
    change = np.abs(room_distances(p) - room_distances(q))
    # 1e-6: the 1e-12 under the roots.
    assert (change <= np.linalg.norm(p - q, axis=-1) * (1.0 + 1e-9) + 1e-6).all()


def test_the_gradient_is_that_of_a_distance_almost_everywhere():
    """A bound that is far below the distance would make rays creep."""
    points = np.random.default_rng(1).uniform(*interior.SCENE_BOX, (20_000, 3))
    points, step = points[room_distances(points) > 0.01], 1e-5
    slope = [
        (room_distances(points + step * e) - room_distances(points - step * e)) / (2.0 * step)
        for e in np.eye(3)
    ]
    length = np.linalg.norm(slope, axis=0)
    assert length.max() < 1.0 + 1e-4
    assert np.mean(length > 0.999) > 0.99


def test_nothing_leads_out_of_the_room():
    """All faces of the scene box, which bounds the field, are solid."""
    rng = np.random.default_rng(2)
    lower, upper = np.array(interior.SCENE_BOX)
    points = rng.uniform(lower, upper, (30_000, 3))
    axis = rng.integers(0, 3, len(points))
    rows = np.arange(len(points))
    points[rows, axis] = np.where(rng.random(len(points)) < 0.5, lower[axis], upper[axis])
    assert room_distances(points).max() < -0.04


# --- pictures --------------------------------------------------------------------------------


def test_depth_equals_brute_force_and_every_pixel_is_opaque(captured):
    cameras, photos = captured
    assert (photos.alpha == 255).all() and (photos.depth > interior.CLEARANCE).all()
    rays = pixel_rays(
        cameras, np.repeat([0, 1], SIZE**2), np.tile(image_pixels(SIZE, SIZE), (2, 1))
    )
    expected, clipped = brute_force_depth(
        *(np.asarray(a) for a in (rays.origins, rays.directions)),
        **{"near": NEAR, "far": FAR, "step": 2e-3, "signed_distance": interior.signed_distance},
    )
    assert clipped.mean() < 0.05  # the exception, not the rule
    np.testing.assert_allclose(photos.depth[~clipped], expected[~clipped], atol=1e-4)


def test_colour_is_the_mean_over_the_pixel(captured):
    cameras, photos = captured
    chosen = np.random.default_rng(0).choice(SIZE**2, 60, replace=False)
    centres, ids = image_pixels(SIZE, SIZE)[chosen], np.zeros(len(chosen), int)
    total = np.zeros((len(chosen), 3))
    colour_fn = partial(surface_colour, interior.shade)
    for offset in np.float32([(dx, dy) for dx in SUBPIXELS for dy in SUBPIXELS]):
        rays = pixel_rays(cameras, ids, centres + offset)
        origins, directions = (np.asarray(a) for a in (rays.origins, rays.directions))
        steps = {"near": NEAR, "far": FAR, "step": 4e-3}
        depth, _ = brute_force_depth(
            origins, directions, **steps, signed_distance=interior.signed_distance
        )
        total += colour_fn(origins + depth[:, None].astype(np.float32) * directions, directions)
    error = np.abs(photos.pixels[chosen] - 255.0 * total / 9.0).max(axis=-1)
    # As for the sculpture; one ray of nine may fall to the other side of an edge.
    assert np.median(error) < 0.6 and np.mean(error < 2.0) > 0.9
    assert error.max() < 2.0 * 255.0 / 9.0


def test_highlights_move_with_the_viewer():
    towards_lamp = np.subtract(interior.LAMP, interior.BALL[0])
    towards_lamp = towards_lamp / np.linalg.norm(towards_lamp)
    top = np.float32([np.array(interior.BALL[0]) + interior.BALL[1] * towards_lamp])
    np.testing.assert_allclose(room_distances(top), 0.0, atol=1e-6)
    aside = np.cross(towards_lamp, [0.0, 0.0, 1.0]) / np.linalg.norm(towards_lamp[:2])
    bright, dull = (
        surface_colour(interior.shade, top, np.float32([-look]))
        for look in (towards_lamp, 0.6 * towards_lamp + 0.8 * aside)
    )
    assert (bright - dull).max() > 0.1 and (bright >= dull).all()


def test_colours_are_not_finer_than_pixels():
    """Within a pixel of a view from across the room, paint on one plane hardly changes."""
    points = np.random.default_rng(0).uniform((-1.3, -1.1, -0.5), (1.3, -1.1, 0.5), (4000, 3))
    points = np.float32(points)
    apart = np.float32([0.01, 0.0, 0.0])
    colour_fn = jax.jit(interior.paint_walls)
    here, there = (np.stack(colour_fn(tuple(p.T)), -1) for p in (points, points + apart))
    change = np.abs(here - there).max(axis=-1)
    assert change.max() < 0.06
    assert np.ptp(here, axis=0).max() > 0.3  # and yet there is something to see


# --- cameras ---------------------------------------------------------------------------------


def test_cameras_stand_free_upright_and_look_at_nothing_near():
    poses = interior.room_poses(jax.random.key(0), 150)
    positions, ahead = poses[:, :, 3], -poses[:, :, 2]
    assert room_distances(positions).min() >= interior.CLEARANCE - 1e-6
    # The outermost shell lies at 1.05 of the clearance asked for.
    solid = {"clearance": interior.CLEARANCE / 1.05, "solid_density": 0.5}
    inside, near = judge_positions(positions, lambda p: room_distances(p) < 0.0, **solid)
    assert not inside.any() and not near.any()
    depth, _ = brute_force_depth(
        positions, ahead, near=0.0, far=FAR, step=5e-3, signed_distance=interior.signed_distance
    )
    assert depth.min() >= interior.ARM - 1e-3
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-6)
    # All around: each quadrant of azimuth and of the room has some.
    for x, y in (ahead[:, :2].T, positions[:, :2].T):
        assert np.bincount(2 * (x > 0.0) + (y > 0.0), minlength=4).min() > 10


def test_more_poses_of_a_key_begin_with_the_fewer_ones():
    few, many = (interior.room_poses(jax.random.key(5), n) for n in (3, interior.NUM_DRAWN))
    np.testing.assert_array_equal(few, many[:3])
    assert len(np.unique(many[:, :, 3], axis=0)) == len(many)
    assert (interior.room_poses(jax.random.key(6), 3) != few).any()


def test_test_views_show_what_the_pool_has_seen(scene):
    """Nearly all that is asked for can be learnt from the pool, and little from any one view."""
    rows = np.concatenate([np.arange(SIZE**2) + scene.offsets[v] for v in scene.test])
    rows = np.random.default_rng(0).choice(rows, 600, replace=False)
    view_ids, pixels = rows // SIZE**2, image_pixels(SIZE, SIZE)[rows % SIZE**2]
    rays = pixel_rays(scene.cameras, view_ids, pixels)
    points = np.asarray(rays.origins + scene.depth[rows, None] * rays.directions)
    times = np.zeros(len(points), int)
    project_fn = jax.jit(project)
    for view in scene.pool:
        camera = take(scene.cameras, view)
        places, is_shown = (np.asarray(a) for a in project_fn(camera, points))
        x, y = np.minimum(places.astype(int), SIZE - 1).T
        away = np.linalg.norm(points - camera.positions, axis=-1)
        times += is_shown & (away < 1.1 * scene.depth_image(view)[y, x])
    assert np.mean(times >= 3) > 0.97
    assert np.mean(times / len(scene.pool)) < 0.3


# --- scene and cache -------------------------------------------------------------------------

FEW = {"image_size": 4, "num_train": 3, "num_test": 2}


def test_the_scene_is_closed_and_its_cameras_are_within_its_box(scene):
    assert (len(scene.pool), len(scene.test), scene.name) == (150, 50, "interior")
    assert scene.alpha is None
    assert 0.0 < scene.near < scene.depth.min() and scene.depth.max() < scene.far
    lower, upper = scene.box
    positions = np.asarray(scene.cameras.positions)
    assert ((positions > lower) & (positions < upper)).all()
    across = 2.0 * np.arctan(0.5 * SIZE / scene.cameras.intrinsics[:, 0])
    np.testing.assert_allclose(np.degrees(across), 69.0, rtol=1e-5)


def test_scenes_are_drawn_by_seed_and_kept_by_name(tmp_path):
    first = load_procedural(scene="interior", **FEW, cache_dir=tmp_path)
    again = load_procedural(scene="interior", **FEW)
    other = load_procedural(scene="interior", **FEW, seed=1)
    np.testing.assert_array_equal(first.pixels, again.pixels)
    np.testing.assert_array_equal(first.depth, again.depth)
    assert (first.cameras.world_from_cam != other.cameras.world_from_cam).any()
    sculpture = load_procedural(**FEW, cache_dir=tmp_path)
    assert len([*tmp_path.iterdir()]) == 2
    kept = load_procedural(scene="interior", **FEW, cache_dir=tmp_path)
    np.testing.assert_array_equal(kept.pixels, first.pixels)
    assert sculpture.alpha is not None and (sculpture.pixels != first.pixels).any()


@pytest.mark.parametrize("name", ["lego", "", None, 3, ["interior"]])
def test_an_unknown_scene_is_refused_with_those_that_there_are(name):
    with pytest.raises(SceneError, match=r"scene: is .*: use one of sculpture, interior$"):
        load_procedural(scene=name, **FEW)


# --- as a user runs it -----------------------------------------------------------------------


def test_a_run_with_free_poses_ends_with_its_page(tmp_path):
    options = {"candidates__source": "free", "candidates__hemisphere_draws": 6, "image_size": 12}
    flags = toy_flags(scene="interior", policies="('bavs',)", **TINY, **options)
    done = script(f"--workdir={tmp_path}", *flags)
    assert done.returncode == 0, done.stderr
    assert "interior: 150 views to choose from" in done.stdout + done.stderr
    page = (tmp_path / "report.html").read_text()
    assert "interior" in page and "report.html" in done.stdout
    result = json.loads((tmp_path / "bavs" / "seed_0" / "result.json").read_text())
    assert result["scene"]["name"] == "interior"
    last = result["rounds"][-1]
    assert last["num_views"] == 4 and np.isfinite([last["psnr"], last["depth_mae"]]).all()
    with np.load(tmp_path / "bavs" / "seed_0" / "acquisition.npz") as acquisition:
        chosen = acquisition["positions"][acquisition["selected"][0]]
    assert room_distances(chosen).min() >= interior.CLEARANCE - 1e-6
