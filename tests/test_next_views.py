"""Chosen poses, exported and read back as a capture: the same rays in the user's coordinates."""

from __future__ import annotations

import json

import imageio.v3 as iio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bavs_jax.cameras import Cameras, image_pixels, look_at, pixel_rays, take
from bavs_jax.scenes import load_nerfstudio
from bavs_jax.scenes.base import Scene, photo_cameras
from experiments.choices import CAMERA_FIELDS, write_next_views
from experiments.reporting.suggestion import write_poses
from tests.scene_files import edit_json, random_image, write_nerfstudio

WIDTH, HEIGHT = 24, 16
LENSES = {
    "pinhole": {"camera_model": "PINHOLE", "k1": None, "p2": None},
    "opencv": {"k1": -0.1, "k2": 0.03, "k3": -0.004, "k4": 0.001, "p1": 0.004, "p2": 0.01},
    "fisheye": {"camera_model": "OPENCV_FISHEYE", "k1": -0.02, "k4": 0.001, "p2": None},
}
NUM = 5


def turned_capture(root, lens: str) -> Scene:
    """A capture whose files lie askew, far off and at three times the size, read at half of it."""
    write_nerfstudio(root, width=WIDTH, height=HEIGHT, fl_x=25.0, fl_y=27.0, **LENSES[lens])

    def turn(data):
        rotation = Rotation.from_euler("xyz", [20, -40, 110], degrees=True).as_matrix()
        for frame in data["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] = rotation @ pose[:3, :3]
            pose[:3, 3] = 3.0 * rotation @ pose[:3, 3] + [10.0, -5.0, 2.0]
            frame["transform_matrix"] = pose.tolist()

    edit_json(root / "transforms.json", turn)
    scene = load_nerfstudio(root, image_size=WIDTH // 2)
    assert scene.cameras.lens == lens
    return scene


def free_cameras(scene: Scene) -> Cameras:
    """Cameras at new places in the scene, with the lens of its first views."""
    rng = np.random.default_rng(0)
    poses = [look_at(rng.normal(size=3), 0.1 * rng.normal(size=3)) for _ in range(NUM)]
    return take(scene.cameras, np.arange(NUM)).replace(world_from_cam=np.float32(poses))


def user_rays(scene: Scene, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Places [V, 3] and directions [V, N, 3] of whole photos, in the user's coordinates."""
    pixels = np.tile(image_pixels(WIDTH, HEIGHT), (len(cameras), 1))
    views = np.repeat(np.arange(len(cameras)), WIDTH * HEIGHT)
    rays = pixel_rays(cameras, views, pixels)
    matrix = scene.user_from_scene
    directions = np.asarray(rays.directions) @ matrix[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    places = np.asarray(cameras.positions) @ matrix[:3, :3].T + matrix[:3, 3]
    return places, directions.reshape(len(cameras), -1, 3)


def read_back(folder) -> tuple[Scene, list[int]]:
    """The export as a capture whose photos were taken, and which view each frame became."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    for number, frame in enumerate(frames):
        path = folder / frame["file_path"]
        path.parent.mkdir(parents=True, exist_ok=True)
        iio.imwrite(path, random_image(number, frame["w"], frame["h"], 3))
    scene = load_nerfstudio(folder)
    return scene, [scene.names.index(frame["file_path"]) for frame in frames]


def assert_same_rays(scene, cameras, folder):
    """Of `cameras`, in the order of the frames, and of the export."""
    again, views = read_back(folder)
    expected = user_rays(scene, photo_cameras(scene, cameras))
    places, directions = user_rays(again, take(again.cameras, np.array(views)))
    # float32 poses and lenses, of places some 12 units from the origin.
    np.testing.assert_allclose(places, expected[0], atol=2e-5)
    np.testing.assert_allclose(directions, expected[1], atol=5e-6)


@pytest.mark.parametrize("lens", LENSES)
def test_suggested_views_come_back(tmp_path, lens):
    scene = turned_capture(tmp_path / "capture", lens)
    cameras, folder = free_cameras(scene), tmp_path / "next_views"
    rows = [
        {"order": i + 1, "picked": NUM - i, "score": 0.5, "share_of_best": 1.0} for i in range(5)
    ]
    write_poses(folder, scene, cameras, rows)
    assert_same_rays(scene, cameras, folder)


@pytest.mark.parametrize("free", [True, False])
@pytest.mark.parametrize("lens", LENSES)
def test_acquired_views_come_back(tmp_path, lens, free):
    scene = turned_capture(tmp_path / "capture", lens)
    cameras = free_cameras(scene) if free else take(scene.cameras, np.arange(NUM))
    picks = [np.array([3, 0]), np.array([4, 1, 2])]  # of two rounds
    choices = [
        {
            **{name: np.asarray(getattr(take(cameras, pick), name)) for name in CAMERA_FIELDS},
            "selected": pick,
            "selected_scores": np.ones(len(pick)),
            "candidate_ids": np.full(NUM, -1) if free else np.arange(NUM),
        }
        for pick in picks
    ]
    folder = tmp_path / "next_views"
    folder.mkdir()
    write_next_views(folder / "transforms.json", scene, choices)
    assert_same_rays(scene, take(cameras, np.concatenate(picks)), folder)
