"""What was offered, scored and chosen: a file per round, and the chosen poses in a user's words."""

import pathlib

import jax
import numpy as np

from bavs_jax.active import Choice
from bavs_jax.cameras import Cameras, take
from bavs_jax.scenes.base import photo_cameras
from bavs_jax.scenes.poses import user_transforms
from experiments.files import load_arrays, write_arrays, write_json
from experiments.runtime import WorkdirError

CAMERA_FIELDS = ("world_from_cam", "intrinsics", "distortion", "sizes")


def _choice_path(folder: pathlib.Path, number: int) -> pathlib.Path:
    return folder / "choices" / f"round_{number}.npz"


def save_choice(folder: pathlib.Path, number: int, choice: Choice, *, in_scene: bool) -> None:
    """Writes the choice of round `number`, 1 for the first batch that was chosen.

    `in_scene` tells whether candidates are views of the scene, or poses drawn freely.
    """
    cameras, info = choice.candidates.cameras, choice.selection
    picked = jax.tree.map(np.asarray, take(cameras, choice.selected))
    write_arrays(
        _choice_path(folder, number),
        positions=np.asarray(cameras.positions),
        candidate_ids=choice.candidates.view_ids if in_scene else np.full(len(cameras), -1),
        scores=info.scores,
        survivors=info.survivors,
        selected=choice.selected,
        selected_scores=info.selected_scores,
        nearest_training_distance=info.nearest_training_distance,
        **{name: getattr(picked, name) for name in CAMERA_FIELDS},
    )


def load_choices(folder: pathlib.Path, num_rounds: int) -> list[dict[str, np.ndarray]]:
    """The choices of rounds 1 .. num_rounds; WorkdirError if one is missing or damaged."""
    try:
        return [load_arrays(_choice_path(folder, n)) for n in range(1, num_rounds + 1)]
    except (FileNotFoundError, ValueError) as error:
        raise WorkdirError(f"{error}: delete {folder} to run it anew") from error


def acquisition_arrays(scene, initial, choices: list[dict]) -> dict[str, np.ndarray]:
    """The arrays of `acquisition.npz`: all rounds over one numbering of views.

    The scene's views come first; candidates that are not views of the scene follow.
    """
    positions, numbering = [np.asarray(scene.cameras.positions)], []
    for choice in choices:
        ids = choice["candidate_ids"]
        if ids[0] < 0:
            ids = sum(map(len, positions)) + np.arange(len(ids))
            positions.append(choice["positions"])
        numbering.append(ids)
    num = sum(map(len, positions))
    scores = np.full((len(choices), num), np.nan, np.float32)
    survivors = np.zeros((len(choices), num), bool)
    for row, (ids, choice) in enumerate(zip(numbering, choices)):
        scores[row, ids], survivors[row, ids] = choice["scores"], choice["survivors"]
    selected = [ids[choice["selected"]] for ids, choice in zip(numbering, choices)]
    return {
        "positions": np.concatenate(positions),
        "up": np.asarray(scene.up, np.float32),
        "centre": scene.centre,
        "pool": np.asarray(scene.pool),
        "scores": scores,
        "survivors": survivors,
        "selected": np.array(selected, np.int32).reshape(len(choices), -1 if choices else 0),
        "initial": np.asarray(initial),
        "names": np.array([*scene.names, *(f"pose {i}" for i in range(num - scene.num_views))]),
    }


def nerfstudio_frames(scene, cameras: Cameras) -> list[dict]:
    """Cameras [k] of a scene as frames of a nerfstudio `transforms.json`, without names.

    Poses are in the user's coordinates, intrinsics for the size of the scene's files.
    """
    cameras = photo_cameras(scene, cameras)
    frames = []
    for i, pose in enumerate(user_transforms(scene, cameras.world_from_cam)):
        fx, fy, cx, cy = (float(x) for x in cameras.intrinsics[i])
        width, height = (int(n) for n in cameras.sizes[i])
        frame = {"transform_matrix": pose.tolist(), "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
        frame |= {"w": width, "h": height}
        distortion = np.asarray(cameras.distortion[i], float).tolist()
        frames.append(frame | dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), distortion)))
    return frames


def write_frames(path: pathlib.Path, scene, frames: list[dict]) -> None:
    """Writes frames as a nerfstudio `transforms.json`."""
    lens = "OPENCV_FISHEYE" if scene.cameras.lens == "fisheye" else "OPENCV"
    write_json(path, {"camera_model": lens, "frames": frames})


def write_next_views(path: pathlib.Path, scene, choices: list[dict]) -> None:
    """Writes the chosen poses as a nerfstudio `transforms.json`, in the user's coordinates.

    Frames come in the order of choosing; `round`, `rank` and `score` say when and why.
    """
    frames = []
    for number, choice in enumerate(choices, start=1):
        cameras = Cameras(**{name: choice[name] for name in CAMERA_FIELDS})
        for rank, frame in enumerate(nerfstudio_frames(scene, cameras)):
            view_id = int(choice["candidate_ids"][choice["selected"][rank]])
            name = scene.names[view_id] if view_id >= 0 else f"next/{number}_{rank + 1}.png"
            score = float(choice["selected_scores"][rank])
            how = {"round": number, "rank": rank + 1, "score": score}
            frames.append({"file_path": name, **frame, **how})
    write_frames(path, scene, frames)
