"""Random sets of views: what describes them, what that explains, and the script that says so."""

import dataclasses
import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from bavs_jax.cameras import pixel_rays, view_pixels
from bavs_jax.metrics.view_sets import correlation, describe, explained, fit_line, visible_surface
from bavs_jax.uncertainty.gaps import BLUR, LEAST, UNSEEN
from experiments.build import initial_views, load_config_scene
from tests.toy_runs import toy_config
from tests.toy_scenes import toy_scene

ROOT = pathlib.Path(__file__).parents[1]
BALL = 0.7  # radius of the toy scene's


def ball_with_depth(num_views=44):
    """The toy scene with its true depth, by where rays meet the ball."""
    scene = toy_scene(num_views, size=40)
    view_ids, pixels = view_pixels(scene.cameras, np.arange(num_views))
    rays = pixel_rays(scene.cameras, view_ids, pixels)
    origins, directions = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
    along = -(origins * directions).sum(-1)
    half = BALL**2 - ((origins + along[:, None] * directions) ** 2).sum(-1)
    depth = np.where(half > 0.0, along - np.sqrt(np.maximum(half, 0.0)), 0.0)
    is_pool = np.arange(num_views) % 4 == 0  # test views between them show all sides
    return dataclasses.replace(
        scene,
        depth=depth.astype(np.float32),
        pool=np.flatnonzero(is_pool).astype(np.int32),
        test=np.flatnonzero(~is_pool).astype(np.int32),
    )


@pytest.fixture(scope="module")
def ball():
    scene = ball_with_depth()
    return scene, visible_surface(scene)


def test_a_view_sees_what_faces_it_on_a_ball(ball):
    scene, surface = ball
    np.testing.assert_allclose(np.linalg.norm(surface.points, axis=-1), BALL, atol=1e-4)
    positions = np.asarray(scene.cameras.positions)
    for view in scene.pool:
        towards = positions[view] - surface.points
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        facing = (towards * surface.points / BALL).sum(-1)
        # The whole ball is in every image, and it is convex; what is seen at a slant is left out.
        clear = np.abs(facing) > 0.35
        assert clear.sum() > 100
        assert (surface.seen[view] == (facing > 0.0))[clear].mean() > 0.998
    assert not surface.seen[scene.test].any()


def test_more_views_never_leave_more_unseen(ball):
    scene, surface = ball
    order = np.random.default_rng(0).permutation(scene.pool)
    found = [describe(scene, order[:n], surface) for n in range(1, len(order) + 1)]
    for name in ("candidates_gap", "candidates_gap_largest", "test_gap", "unseen", "sides", "gaps"):
        assert (np.diff([row[name] for row in found]) <= 1e-12).all(), name
    assert found[-1]["candidates_gap"] == 0.0 < found[0]["candidates_gap"]
    assert found[0]["unseen"] > 0.3 > found[-1]["unseen"]


def test_descriptors_of_one_camera_in_closed_form(ball):
    scene, surface = ball
    view = int(scene.pool[0])
    found = describe(scene, np.array([view]), surface)
    positions = np.asarray(scene.cameras.positions, np.float64)
    radii = np.linalg.norm(positions, axis=-1)
    unit = np.median(radii[scene.pool])
    apart = [np.linalg.norm(positions[v] - positions[view]) / unit for v in scene.pool]
    np.testing.assert_allclose(found["candidates_gap"], np.mean(np.square(apart)))
    np.testing.assert_allclose(found["candidates_gap_largest"], max(apart))
    np.testing.assert_allclose(found["elevation"], positions[view, 2] / radii[view])
    np.testing.assert_allclose(found["distance"], radii[view] / unit)
    by_hand = []
    for point, towards, seen in zip(surface.points, surface.towards, surface.seen[view]):
        ray = (positions[view] - point) / np.linalg.norm(positions[view] - point)
        by_hand.append((1 - ray @ towards) / 2 if seen else 1.0)
    np.testing.assert_allclose(found["sides"], np.mean(by_hand), rtol=1e-6)
    np.testing.assert_allclose(found["gaps"], gaps_by_hand(scene, [view], surface), rtol=1e-5)
    several = scene.pool[1:4]
    found = describe(scene, several, surface)["gaps"]
    np.testing.assert_allclose(found, gaps_by_hand(scene, several, surface), rtol=1e-5)


def gaps_by_hand(scene, views, surface):
    """The mean over test views of the log of the mean predicted error of their points."""
    positions, focal = np.asarray(scene.cameras.positions), scene.cameras.intrinsics[:, 0]
    errors = {}
    for number, point in enumerate(surface.points):
        test, known = int(surface.view[number]), UNSEEN
        wanted = positions[test] - point
        for view in views:
            away = positions[view] - point
            cosine = away @ wanted / np.linalg.norm(away) / np.linalg.norm(wanted)
            coarser = np.linalg.norm(away) / focal[view] / np.linalg.norm(wanted) * focal[test]
            blur = BLUR * np.log2(max(coarser, 1.0))
            gap = np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2 + LEAST**2 + blur**2
            known += surface.seen[view, number] / gap
        errors.setdefault(test, []).append(1.0 / known)
    return np.mean([np.log(np.mean(e)) for e in errors.values()])


def test_descriptors_do_not_depend_on_the_unit_and_need_no_depth(ball):
    scene, surface = ball
    views = scene.pool[:3]
    whole = describe(scene, views, surface)
    cameras = scene.cameras
    poses = np.array(cameras.world_from_cam)
    poses[:, :, 3] *= 5.0
    large = dataclasses.replace(
        scene,
        cameras=cameras.replace(world_from_cam=poses),
        box=5.0 * scene.box,
        depth=5.0 * scene.depth,
    )
    again = describe(large, views, visible_surface(large))
    assert again.keys() == whole.keys()
    for name, value in whole.items():
        np.testing.assert_allclose(again[name], value, atol=2e-3, err_msg=name)
    assert visible_surface(dataclasses.replace(scene, depth=None)) is None
    assert describe(scene, views, None).keys() < whole.keys()


def test_what_is_explained_is_what_is_predicted_of_others():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(120, 4)) * [1.0, 10.0, 0.1, 0.0] + [0, 5, 0, 3]
    signal = features @ [1.0, 0.2, 0.0, 0.0]
    assert explained(features, signal) == pytest.approx(1.0)
    noise = rng.normal(size=120)
    assert explained(features, noise) < 0.1
    half = explained(features, signal + np.std(signal) * noise)
    assert 0.3 < half < 0.65
    assert explained(features[:11], signal[:11]) is None
    np.testing.assert_allclose(fit_line(features, signal)(features[:5]), signal[:5])
    assert correlation(signal, np.exp(signal)) == pytest.approx(1.0)
    assert correlation(signal, np.ones(120)) is None


# --- the script ------------------------------------------------------------------------------


def write_runs(folder, runs):
    """A summary of finished runs, given as (policy, seed, config, rounds)."""
    rows = [
        {
            "schema_version": 1,
            "scene": {"name": "procedural", "kind": "procedural", "image_size": [16, 16]},
            "policy": policy,
            "seed": seed,
            "command": "made by a test",
            "config": config.to_dict(),
            "device": "CPU",
            "completed": True,
            "rounds": rounds,
        }
        for policy, seed, config, rounds in runs
    ]
    folder.mkdir()
    (folder / "summary.json").write_text(json.dumps({"schema_version": 1, "runs": rows}))


def script(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "experiments.view_sets", *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )


def test_the_script_finds_what_the_sets_are_worth(tmp_path, cache):
    config = toy_config(num_initial=6, num_rounds=0)
    scene = load_config_scene(config, cache_dir=str(cache / "bavs_jax" / "scenes"))
    surface, rng, runs = visible_surface(scene), np.random.default_rng(0), []

    def psnr(views):
        return 30.0 - 4.0 * describe(scene, views, surface)["test_gap"] + rng.normal(0.0, 0.02)

    for seed in range(60):
        views = initial_views(scene, seed, 6)
        rounds = [{"num_views": 6, "selected": views.tolist(), "psnr": psnr(views)}]
        runs.append(("random", seed, config, rounds))
    write_runs(tmp_path / "sets", runs)
    same = toy_config(num_initial=6, num_rounds=0, view_seed=0)
    views = initial_views(scene, 0, 6)
    write_runs(
        tmp_path / "noise",
        [("random", s, same, [{"num_views": 6, "selected": [], "psnr": psnr(views)}])
         for s in range(5)],
    )  # fmt: skip
    chosen = toy_config(num_initial=4, num_rounds=1, batch_size=2)
    first = initial_views(scene, 3, 4)
    added = [int(v) for v in scene.pool if v not in first][:2]
    rounds = [{"num_views": 4, "selected": [], "psnr": 20.0}]
    rounds.append({"num_views": 6, "selected": added, "psnr": psnr([*first, *added])})
    write_runs(tmp_path / "other", [("farthest", 3, chosen, rounds)])
    folders = [f"--runs={tmp_path / name}" for name in ("sets", "noise", "other")]
    done = script(*folders, f"--workdir={tmp_path / 'out'}")
    assert done.returncode == 0, done.stderr
    first_round, group = json.loads((tmp_path / "out" / "view_sets.json").read_text())["numbers"]
    assert first_round["num_views"] == 4 and first_round["rows"][0]["policy"] == "random"
    assert (group["num_views"], group["num_sets"], len(group["random_psnr"])) == (6, 61, 60)
    assert 0.01 < group["noise"] < 0.04
    assert group["explained"] > 0.75 and group["features"]["test_gap"] < -0.95
    (row,) = [row for row in group["rows"] if row["policy"] == "farthest"]
    assert row["views"] == sorted([*first.tolist(), *added])
    assert row["predicted"] == pytest.approx(row["psnr"], abs=0.2)
    assert "<svg" in (tmp_path / "out" / "view_sets.html").read_text()
    assert "unseen" in done.stdout


def test_runs_that_were_trained_in_other_ways_are_not_mixed(tmp_path):
    rounds = [{"num_views": 6, "selected": [], "psnr": 20.0}]
    for name, steps in (("a", 8), ("b", 16)):
        config = toy_config(num_initial=6, num_rounds=0, train__num_steps=steps)
        write_runs(tmp_path / name, [("random", 0, config, rounds)])
    out = f"--workdir={tmp_path / 'out'}"
    for arguments, words in (
        ([f"--runs={tmp_path / 'a'}", f"--runs={tmp_path / 'b'}"], "train.num_steps is 8"),
        ([f"--runs={tmp_path / 'none'}"], "holds no finished run"),
        ([], "--runs: give a folder"),
    ):
        done = script(*arguments, out)
        assert done.returncode == 1 and words in done.stderr, done.stderr
        assert not (tmp_path / "out" / "view_sets.json").exists()
