"""Where to stand next: options, files in the user's coordinates, the script on a tiny capture."""

import csv
import dataclasses
import json
import math
import pathlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import make_cameras, take
from bavs_jax.placement.collect import PlacementError
from bavs_jax.placement.seen import count_seeing
from bavs_jax.scenes import SceneError
from bavs_jax.scenes.poses import user_points, user_transforms
from bavs_jax.selection.context import SelectionError
from bavs_jax.selection.worth import Worth
from experiments import suggestion
from experiments.reporting.suggestion import worth_words, write_poses
from experiments.runtime import ConfigError
from experiments.schema import parse_numbers
from tests.scene_files import orbit, write_nerfstudio
from tests.script_server import run_script
from tests.toy_scenes import toy_scene

ROOT = pathlib.Path(__file__).parents[1]


def options(**changes) -> suggestion.Options:
    given = suggestion.Options(
        num_views=3,
        policy="bavs",
        candidates="shell",
        num_candidates=20,
        bounds=None,
        poses_file="",
        clearance=0.0,
        spread=0.25,
        gaze_jitter=5.0,
        route=False,
        start=None,
        refine=0,
        seed=0,
    )
    return given._replace(**changes)


def similar_scene():
    """The toy scene as if its user's files were turned, three times as large and elsewhere."""
    matrix = np.eye(4)
    matrix[:3, :3] = 3.0 * Rotation.from_euler("xyz", [20, -40, 110], degrees=True).as_matrix()
    matrix[:3, 3] = [10.0, -5.0, 2.0]
    return dataclasses.replace(toy_scene(), user_from_scene=matrix)


def ball(points):
    return np.where(np.linalg.norm(points, axis=-1) < 0.7, 100.0, 0.0)


# --- options ---


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"num_candidates": 2}, "--num_candidates"),
        ({"candidates": "box"}, "--bounds: is missing"),
        ({"candidates": "file"}, "--poses_file"),
        ({"poses_file": "a.csv"}, "--poses_file"),
        ({"start": np.zeros(3)}, "--start"),
        ({"bounds": np.array([[1, 2, 3], [0, 5, 6]])}, "--bounds: each of"),
        ({"candidates": "file", "poses_file": "/nowhere.csv"}, "/nowhere.csv"),
        ({"candidates": "file", "poses_file": "a.csv", "refine": 2}, "--refine: poses of a file"),
    ],
)
def test_options_that_do_not_fit_are_refused(changes, message):
    with pytest.raises((PlacementError, SceneError), match=message):
        suggestion.check_options(options(**changes))
    suggestion.check_options(options())


@pytest.mark.parametrize("text", ["1,2", "1,2,3,4,5,x", "1,2,3,4,5,1e10", "1,2,3,4,5,nan"])
def test_numbers_that_are_no_box_are_refused(text):
    with pytest.raises(ConfigError, match=r"--bounds: .*give 6 numbers"):
        parse_numbers(text, (2, 3), "bounds")
    found = parse_numbers("0,1,2, 3,4,5", (2, 3), "bounds")
    np.testing.assert_array_equal(found, [[0, 1, 2], [3, 4, 5]])
    assert parse_numbers("", (2, 3), "bounds") is None


# --- candidates in the user's coordinates ---


@pytest.mark.parametrize("kind", ["shell", "hemisphere", "box"])
def test_candidates_stay_within_the_users_bounds_and_out_of_the_ball(kind):
    scene = similar_scene()
    middle = user_points(scene, np.zeros(3))
    bounds = np.stack([middle - 9.0, middle + np.array([9.0, 9.0, 7.0])])
    chosen = options(candidates=kind, bounds=bounds, clearance=0.9, num_candidates=600)
    around = suggestion.look_around(scene, chosen)
    got = suggestion.propose(scene, ball, around, chosen)
    user = user_transforms(scene, got.poses)[:, :3, 3]
    assert len(got.poses) == 600
    assert (user >= bounds[0] - 1e-9).all() and (user <= bounds[1] + 1e-9).all()
    # The ball's radius and the clearance of 0.9 user units, in scene units.
    assert np.linalg.norm(got.poses[:, :, 3], axis=-1).min() >= 0.7 + 0.3 - 1e-6
    if kind == "box":
        assert got.dropped["inside matter"] > 0 and got.dropped["too near to matter"] > 0
    rotations = got.poses[:, :, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1),
        np.broadcast_to(np.eye(3), rotations.shape),
        atol=1e-5,  # hemisphere poses are float32
    )


def test_poses_from_a_file_are_read_in_the_users_coordinates(tmp_path):
    scene = similar_scene()
    user = user_transforms(scene, np.asarray(scene.cameras.world_from_cam)[:5])
    (tmp_path / "reach.json").write_text(json.dumps(user.tolist()))
    chosen = options(candidates="file", poses_file=str(tmp_path / "reach.json"))
    got = suggestion.propose(scene, ball, suggestion.look_around(scene, chosen), chosen)
    np.testing.assert_allclose(got.poses, scene.cameras.world_from_cam[:5], atol=1e-5)
    assert got.num_drawn == 5
    with pytest.raises(PlacementError, match="list more poses"):
        more = chosen._replace(num_views=6)
        suggestion.propose(scene, ball, suggestion.look_around(scene, more), more)


# --- facts ---


def test_photos_see_what_is_before_them_and_not_behind_the_ball():
    scene = toy_scene()  # cameras at azimuths 0, 30, ... of the pool of 9
    cameras = take(scene.cameras, scene.pool)
    beside = np.array([0.0, 0.0, 0.95])  # above the ball, in sight of every photo
    behind = np.asarray(scene.cameras.positions)[0] * 5.0
    assert count_seeing(cameras, beside, ball) == len(scene.pool)
    assert count_seeing(cameras, np.zeros(3), ball) == 0
    direction = -np.asarray(scene.cameras.positions)[0]
    shadow = 0.75 * direction / np.linalg.norm(direction)  # hidden from photo 0 by the ball
    assert 0 < count_seeing(cameras, shadow, ball) < len(scene.pool)
    assert count_seeing(cameras, behind, ball) < len(scene.pool)


def test_worth_in_words():
    worth = Worth(np.array([50.0, 30.0]), np.array([60.0, 55.0, 45.0]))
    words = worth_words(worth, 40.0)
    assert "60 nats at first, after 2 picks 45 nats" in words and "40" in words
    nothing_left = Worth(np.array([60.0]), np.array([60.0, np.nan]))
    assert "after 1 picks none" in worth_words(nothing_left, 40.0)


# --- files ---


@pytest.fixture
def written(tmp_path):
    poses = np.array(orbit(3))
    cameras = make_cameras(
        poses, np.tile([30.0, 32.0, 19.5, 30.5], (3, 1)), np.tile([40, 60], (3, 1)),
        distortion=np.tile([0.1, 0, 0, 0, 0, 0.02], (3, 1)), lens="opencv",
    )  # fmt: skip
    rows = [
        {"order": i + 1, "picked": 3 - i, "score": 0.5, "share_of_best": 0.25 * i} for i in range(3)
    ]
    write_poses(tmp_path, dataclasses.replace(toy_scene(), cameras=cameras), cameras, rows)
    return tmp_path, poses


def test_transforms_parse_back(written):
    folder, poses = written
    data = json.loads((folder / "transforms.json").read_text())
    assert data["camera_model"] == "OPENCV"
    np.testing.assert_allclose([f["transform_matrix"] for f in data["frames"]], poses, atol=1e-6)
    first = data["frames"][0]
    np.testing.assert_allclose([first[k] for k in ("k1", "p2", "fl_y", "h")], [0.1, 0.02, 32, 60])


def test_camera_path_has_the_viewers_form(written):
    folder, poses = written
    data = json.loads((folder / "camera_path.json").read_text())
    assert {"camera_type", "render_height", "render_width", "fps", "seconds"} <= data.keys()
    assert data["camera_type"] == "perspective" and data["is_cycle"] is False
    for view, pose in zip(data["camera_path"], poses, strict=True):
        np.testing.assert_allclose(np.reshape(view["camera_to_world"], (4, 4)), pose, atol=1e-6)
        # nerfstudio: focal = height / 2 / tan(fov / 2), fov vertical in degrees.
        focal = 0.5 * data["render_height"] / math.tan(math.radians(view["fov"]) / 2)
        np.testing.assert_allclose([focal, view["aspect"]], [32.0, 40 / 60], rtol=1e-6)


def test_csv_parses_back(written):
    folder, poses = written
    with open(folder / "next_views.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, pose in zip(rows, poses, strict=True):
        place = [float(row[k]) for k in ("x", "y", "z")]
        quaternion = [float(row[k]) for k in ("qx", "qy", "qz", "qw")]
        np.testing.assert_allclose(place, pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(
            Rotation.from_quat(quaternion).as_matrix(), pose[:3, :3], atol=1e-6
        )
        look = [float(row[f"look_{k}"]) for k in "xyz"]
        np.testing.assert_allclose(look, -pose[:3, 2], atol=1e-6)
    assert [row["order"] for row in rows] == ["1", "2", "3"]


# --- the script ---

SMALL = {
    "hash_grid.num_levels": 2, "hash_grid.finest": 32, "hash_grid.width": 16,
    "hash_grid.direction_degree": 1,
    "march.num_steps": 32, "march.num_slots": 16, "march.occupancy_resolution": 16,
    "train.steps_per_call": 4, "train.num_rays": 64, "train.capacity": 1024,
    "uncertainty.log2_cells": 3,
}  # fmt: skip


def script(*flags):
    small = [f"--config.{name}={value}" for name, value in SMALL.items()]
    return run_script("experiments.suggest_views", *small, *flags)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The script on a capture of 8 noise images, with a route."""
    base = tmp_path_factory.mktemp("suggest")
    data = write_nerfstudio(base / "capture", width=48, height=32, fl_x=60.0, fl_y=62.0)
    flags = [f"--data={data}", f"--workdir={base / 'out'}", "--image_size=24", "--train_steps=16"]
    flags += ["--num_views=3", "--num_candidates=12", "--score_scale=0.5"]
    flags += ["--config.hash_grid.num_levels=2", "--config.proposal.num_levels=1"]
    done = script(*flags, "--route", "--start=4,0,1", "--holdout=2")
    assert done.returncode == 0, done.stderr
    return base, flags, done.stdout


def test_script_writes_poses_that_agree_with_each_other(finished):
    base, _, out = finished
    folder = base / "out" / "next_views"
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    path = json.loads((folder / "camera_path.json").read_text())["camera_path"]
    with open(folder / "next_views.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(frames) == len(path) == len(rows) == 3
    for frame, view, row in zip(frames, path, rows):
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(np.reshape(view["camera_to_world"], (4, 4)), pose)
        # Trained at half the size; a photo is taken at the size of the others.
        assert (frame["w"], frame["h"]) == (48, 32)
        np.testing.assert_allclose([frame["fl_x"], frame["fl_y"]], [60.0, 62.0], rtol=1e-6)
        np.testing.assert_allclose([float(row[k]) for k in "xyz"], pose[:3, 3], rtol=1e-6)
        # The capture is an orbit of radius 4 at height 1 about the origin, which has no noise in
        # its heights and distances: the shell reaches about the noise beyond.
        assert 1.5 < np.linalg.norm(pose[:3, 3]) < 7.0
    assert sorted(int(row["picked"]) for row in rows) == [1, 2, 3]
    summary = json.loads((base / "out" / "suggestion.json").read_text())
    assert summary["drawn"] == summary["kept"] + sum(summary["dropped"].values())
    assert (np.diff(summary["best_left"]) <= 1e-6).all()
    assert summary["worth"] and all(view["why"] for view in summary["views"])
    report = (base / "out" / "report.html").read_text()
    assert "PSNR" in report and all(view["why"].split("; ")[1] for view in summary["views"])
    assert "remaining" in out and "dropped" in out and "route: " in out


def test_same_folder_uses_the_same_field_for_other_candidates_and_policies(finished):
    base, flags, _ = finished
    box = ["--candidates=box", "--bounds=-6,-6,0.5,6,6,5"]
    done = script(*flags, "--holdout=2", *box, "--policy=directional")
    assert done.returncode == 0, done.stderr
    assert "train on" not in done.stdout.replace("photos to train on", "")
    frames = json.loads((base / "out/next_views/transforms.json").read_text())["frames"]
    places_ = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    assert (places_ >= [-6, -6, 0.5]).all() and (places_ <= [6, 6, 5]).all()


def test_refined_poses_tell_more_and_stay_within_bounds(finished):
    base, flags, _ = finished
    box = ["--candidates=box", "--bounds=-6,-6,0.5,6,6,5", "--holdout=2", "--policy=bavs_spread"]
    frames = {}
    for steps in (0, 2):
        done = script(*flags, *box, f"--refine={steps}")
        assert done.returncode == 0, done.stderr
        found = json.loads((base / "out/next_views/transforms.json").read_text())["frames"]
        frames[steps] = np.array([frame["transform_matrix"] for frame in found])
    refined = json.loads((base / "out/suggestion.json").read_text())["refined"]
    before, after = np.array(refined["before"]), np.array(refined["after"])
    assert (after >= before * (1 - 1e-5)).all() and after.sum() > before.sum()
    assert "raised their scores by" in (base / "out/report.html").read_text()
    places_ = frames[2][:, :3, 3]
    assert (places_ >= [-6, -6, 0.5]).all() and (places_ <= [6, 6, 5]).all()
    apart = np.linalg.norm(places_ - frames[0][:, :3, 3], axis=-1)
    assert 0 < apart.max() < 0.15 * np.sqrt(3) * 6.0  # of the photos' distance, on three axes


@pytest.mark.parametrize("flag", ["--data=/nowhere", "--gaze_jitter=91", "--score_scale=0"])
def test_a_flag_that_cannot_be_used_ends_in_one_line(finished, tmp_path, flag):
    _, usual, _ = finished
    done = script(*usual, f"--workdir={tmp_path}", flag)
    assert done.returncode != 0 and all(word in done.stderr for word in flag.split("="))
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_policy_that_is_unknown_or_needs_what_one_field_has_not_is_refused():
    for name in ("bavs", "directional", "coverage", "entropy"):
        suggestion.check_options(options(policy=name))
    for name in ("random", "coverage", "surface_coverage"):
        with pytest.raises(SelectionError, match="--refine"):
            suggestion.check_options(options(policy=name, refine=3))
    refused = {"bavz": "bavz", "oracle": "photos", "activenerf": "field of kind 'variance'"}
    for name, message in refused.items():
        with pytest.raises(SelectionError, match=message):
            suggestion.check_options(options(policy=name))
