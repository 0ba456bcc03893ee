"""Pools that are not even: shares of elevation, width of an arc, what is in reach, bad input."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax import pools
from bavs_jax.cameras import look_at, make_cameras
from bavs_jax.candidates import captured_candidates, dataset_candidates, reachable_candidates
from bavs_jax.pixel_table import make_pixel_table
from bavs_jax.scenes import Scene, SceneError
from experiments.build import check_views, initial_views
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

UP = np.array([0.0, 0.0, 1.0])


def dome(num=200, num_test=20, seed=0) -> Scene:
    """Cameras all over the upper hemisphere of a scene whose centre is not the origin."""
    rng = np.random.default_rng(seed)
    azimuth, height = rng.uniform(0.0, 2.0 * np.pi, num), rng.uniform(0.02, 0.98, num)
    width = np.sqrt(1.0 - height**2)
    unit = np.stack([width * np.cos(azimuth), width * np.sin(azimuth), height], axis=-1)
    return scene_at(np.array([0.5, -1.0, 2.0]), 3.0 * unit, num_test)


def scene_at(centre, offsets, num_test=2, up=UP) -> Scene:
    """Blank views from some places around a centre."""
    num = len(offsets)
    poses = np.stack([look_at(centre + offset, centre, up) for offset in offsets])
    cameras = make_cameras(poses, np.ones((num, 4)), np.ones((num, 2)))
    return Scene(
        name="dome",
        cameras=cameras,
        pixels=np.zeros((num, 3), np.uint8),
        offsets=np.arange(num + 1),
        pool=np.arange(num - num_test, dtype=np.int32),
        test=np.arange(num - num_test, num, dtype=np.int32),
        box=np.array([centre - 1.0, centre + 1.0], np.float32),
        near=1.0,
        far=6.0,
        background=np.ones(3, np.float32),
        names=tuple(f"view_{i}" for i in range(num)),
        up=tuple(up),
    )


def turned(scene: Scene, seed: int) -> Scene:
    """The same world, turned about the origin and moved."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    move = rng.normal(size=3)
    poses = turn @ np.asarray(scene.cameras.world_from_cam, np.float64)
    poses[:, :, 3] += move
    centre = turn @ scene.centre + move
    return dataclasses.replace(
        scene,
        cameras=scene.cameras.replace(world_from_cam=poses.astype(np.float32)),
        box=np.array([centre - 1.0, centre + 1.0], np.float32),
        up=tuple(turn @ scene.up),
    )


def offsets_of(scene: Scene, view_ids) -> np.ndarray:
    return np.asarray(scene.cameras.positions, np.float64)[view_ids] - scene.box.mean(axis=0)


def heights_of(scene: Scene, view_ids) -> np.ndarray:
    """Sines of elevation, from the law of cosines with the point above the centre."""
    offsets, up = offsets_of(scene, view_ids), np.asarray(scene.up)
    length2 = (offsets**2).sum(axis=-1)
    to_above2 = ((offsets - up) ** 2).sum(axis=-1)
    return (length2 + 1.0 - to_above2) / (2.0 * np.sqrt(length2))


def widest_pair(scene: Scene, view_ids) -> float:
    """The largest angle, degrees, between two views as they are seen from straight above."""
    offsets, up = offsets_of(scene, view_ids), np.asarray(scene.up)
    flat = np.cross(up, np.cross(offsets, up))
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(flat @ flat.T, -1.0, 1.0))).max())


# --- unbalanced ---


@pytest.mark.parametrize("share", [1 / 3, 0.5, 0.75, 0.9])
@pytest.mark.parametrize("seed", range(4))
def test_an_unbalanced_pool_has_the_shares_that_are_asked_for(share, seed):
    scene = dome()
    thinned = pools.unbalanced(scene, share=share, seed=seed)
    assert set(thinned.pool) <= set(scene.pool) and len(set(thinned.pool)) == len(thinned.pool)
    np.testing.assert_array_equal(thinned.test, scene.test)
    edges = np.quantile(heights_of(scene, scene.pool), [1 / 3, 2 / 3])
    counts = np.bincount(np.searchsorted(edges, heights_of(scene, thinned.pool)), minlength=3)
    crowded = pools.crowded_band(seed)
    others = np.delete(counts, crowded)
    # Whole views: of the 60 in the crowded band at most one for each of the others is rounded away.
    assert others[0] == others[1] > 0
    assert abs(counts[crowded] - share * counts.sum()) <= 0.5
    assert counts[crowded] > 60 - 2.0 * share / (1.0 - share)


def test_every_band_is_crowded_by_some_seed_and_other_seeds_draw_other_views():
    assert {pools.crowded_band(seed) for seed in range(20)} == {0, 1, 2}
    scene = dome()
    same = [s for s in range(20) if pools.crowded_band(s) == 0][:2]
    first, other = (pools.unbalanced(scene, share=0.75, seed=s).pool for s in same)
    assert set(first) != set(other)
    np.testing.assert_array_equal(first, pools.unbalanced(scene, share=0.75, seed=same[0]).pool)


def test_the_setting_of_sbv_keeps_40_of_100_views():
    thinned = pools.unbalanced(dome(101, 1), share=0.75, seed=0)
    assert len(thinned.pool) == 40


@pytest.mark.parametrize("seed", range(3))
def test_pools_do_not_depend_on_how_the_world_is_turned(seed):
    scene = dome()
    world = turned(scene, seed)
    for pool in ({"share": 0.75, "seed": seed}, {"share": 0.5, "seed": seed + 5}):
        found, wanted = (pools.unbalanced(s, **pool).pool for s in (world, scene))
        np.testing.assert_array_equal(found, wanted)
    found, wanted = (pools.arc(s, degrees=60.0, seed=seed).start for s in (world, scene))
    np.testing.assert_array_equal(found, wanted)


def test_a_pool_of_one_elevation_or_of_too_few_views_is_an_error():
    angles = 2.0 * np.pi * np.arange(40) / 40
    ring = np.stack([np.cos(angles), np.sin(angles), 0.5 + 0.0 * angles], axis=-1)
    with pytest.raises(SceneError, match=r"pool\.kind: 'unbalanced' needs a pool of several"):
        pools.unbalanced(scene_at(np.zeros(3), ring), share=0.75, seed=0)
    small = dome(19, 2)
    with pytest.raises(
        SceneError, match=r"pool\.share: of 0\.75 takes 6 views in a third .* 5:|6:"
    ):
        pools.unbalanced(dome(17, 2), share=0.75, seed=0)
    assert len(pools.unbalanced(small, share=0.5, seed=0).pool) > 0


def test_taking_more_than_a_thinned_pool_has_is_an_error():
    config = toy_config(pool__kind="unbalanced", num_rounds=4, batch_size=10, num_initial=4)
    scene = pools.unbalanced(dome(101, 1), share=0.75, seed=0)
    with pytest.raises(
        ValueError, match=r"config\.batch_size: 4 rounds of 10 take 40 views.* 36 in"
    ):
        check_views(config, scene)


# --- arc ---


@pytest.mark.parametrize("degrees", [20.0, 60.0, 200.0])
@pytest.mark.parametrize("seed", range(5))
def test_runs_begin_within_the_arc_and_candidates_are_everywhere(degrees, seed):
    scene = dome(1000)
    begun = pools.arc(turned(scene, seed), degrees=degrees, seed=seed)
    np.testing.assert_array_equal(begun.pool, scene.pool)
    np.testing.assert_array_equal(begun.test, scene.test)
    for run_seed in range(5):
        initial = initial_views(begun, run_seed, 4)
        assert len(set(initial)) == 4 and set(initial) <= set(scene.pool)
        assert widest_pair(begun, initial) <= degrees + 1e-4
    # All of the arc is begun with by some run: its share of the views is that of the circle.
    assert 0.6 < len(begun.start) / len(scene.pool) / (degrees / 360.0) < 1.5
    assert widest_pair(begun, begun.start) > min(degrees, 180.0) - 10.0


def test_the_arc_is_drawn_by_its_seed_and_may_be_the_whole_circle():
    scene = dome()
    starts = {tuple(pools.arc(scene, degrees=60.0, seed=s).start) for s in range(6)}
    assert len(starts) > 3
    np.testing.assert_array_equal(pools.arc(scene, degrees=360.0, seed=1).start, scene.pool)


def test_azimuths_are_those_of_the_angles_that_cameras_were_put_at():
    angles = np.radians([0.0, 30.0, 90.0, -150.0, 179.0])
    flat = np.stack([np.cos(angles), np.sin(angles), np.linspace(-0.5, 2.0, 5)], axis=-1)
    scene = scene_at(np.array([1.0, 2.0, 3.0]), [*flat, UP])
    found = np.degrees(pools.azimuths(scene, range(6), 0))
    np.testing.assert_allclose(found, [0.0, 30.0, 90.0, -150.0, 179.0, np.nan], atol=1e-4)
    found = np.degrees(pools.azimuths(scene, range(4), 3))
    np.testing.assert_allclose(found, [150.0, 180.0, -120.0, 0.0], atol=1e-4)
    found = np.degrees(pools.elevations(scene, range(6)))
    wanted = [*np.degrees(np.arctan(flat[:, 2])), 90.0]
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_sides_are_those_of_what_cameras_look_at_wherever_the_box_is():
    scene = dome()
    moved = dataclasses.replace(scene, box=scene.box + np.float32([2.0, -1.0, 0.5]))
    for seed in range(3):
        found, wanted = (pools.unbalanced(s, share=0.75, seed=seed).pool for s in (moved, scene))
        np.testing.assert_array_equal(found, wanted)
        found, wanted = (pools.arc(s, degrees=60.0, seed=seed).start for s in (moved, scene))
        np.testing.assert_array_equal(found, wanted)


def test_an_arc_of_too_few_views_or_of_none_is_an_error():
    scene = pools.arc(dome(30, 2), degrees=20.0, seed=0)
    num = len(scene.start)
    assert len(initial_views(scene, 0, 0)) == num < 28
    with pytest.raises(SceneError, match=rf"is 20, but the arc to begin in has {num} .*pool\.deg"):
        initial_views(scene, 0, 20)
    with pytest.raises(SceneError, match=r"pool\.kind: 'arc' needs views around the scene"):
        pools.arc(scene_at(np.zeros(3), [UP, 2 * UP, -UP, 3 * UP, UP]), degrees=60.0, seed=0)


def test_a_view_straight_above_is_not_begun_with():
    scene = scene_at(np.zeros(3), [UP, [1.0, 0.0, 0.3], 2 * UP, UP, UP])
    for seed in range(5):
        np.testing.assert_array_equal(pools.arc(scene, degrees=360.0, seed=seed).start, [1])


# --- reachable ---


def nearest_unused(scene, used, current, num) -> set:
    """The num views of the pool that are nearest to the current one and not used, slowly."""
    places = np.asarray(scene.cameras.positions, np.float64)
    free = [int(view) for view in scene.pool if view not in used]
    return set(sorted(free, key=lambda v: sum((places[v] - places[current]) ** 2))[:num])


@pytest.mark.parametrize("num", [1, 5, 300])
def test_only_the_nearest_unused_views_are_reached(num):
    scene = dome()
    table = make_pixel_table(scene)
    rng = np.random.default_rng(0)
    for seed in range(5):
        used = rng.permutation(scene.pool)[:20]
        current = int(used[-1])
        is_training = jnp.zeros(scene.num_views, bool).at[used].set(True)
        source = reachable_candidates(dataset_candidates(scene), current, num)
        offered = source.propose(jax.random.key(seed), table, is_training)
        assert set(offered.view_ids[offered.mask]) == nearest_unused(scene, used, current, num)
        assert len(offered.view_ids) == len(scene.pool)  # one shape, whatever is on offer
    everything = is_training | jnp.ones_like(is_training)
    assert not source.propose(jax.random.key(0), table, everything).mask.any()


def test_free_poses_are_reached_from_where_the_last_picture_was_taken():
    scene = toy_scene()
    source = captured_candidates(scene, lambda c: None, num_candidates=30, first_slot=12)
    table, used = make_pixel_table(scene), jnp.zeros(12, bool)
    whole = source.propose(jax.random.key(0), table, used)
    offered = reachable_candidates(source, 3, 4).propose(jax.random.key(0), table, used)
    np.testing.assert_array_equal(offered.cameras.positions, whole.cameras.positions)
    apart = np.linalg.norm(whole.cameras.positions - table.cameras.positions[3], axis=-1)
    assert offered.mask.sum() == 4 and apart[offered.mask].max() < apart[~offered.mask].min()
