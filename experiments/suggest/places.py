"""Candidate poses by the user's options: drawn or read, then judged by the trained field."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from bavs_jax.cameras import Cameras, hemisphere_poses, take
from bavs_jax.placement.clearance import judge_positions, matter_density, within_bounds
from bavs_jax.placement.collect import PlacementError, check_enough, collect_poses
from bavs_jax.placement.proposals import aim, box_positions, shell_positions, turned_targets
from bavs_jax.placement.seen import focus_point, in_unknown_space, share_facing
from bavs_jax.scenes import Scene
from bavs_jax.scenes.pose_files import read_pose_file
from bavs_jax.scenes.poses import transform_poses
from experiments.build import stream_key
from experiments.runtime import shown

KINDS = ("shell", "hemisphere", "box", "file")
MAX_POSES = 100_000
MAX_LENGTH = 1e9  # user units
CLEARANCE_SHARE = 0.05  # of the median distance of the photos from what they look at
OPPOSITE = 1e-3  # length of the mean of two directions below which it has none of its own
SOLID_SHARE = 0.05  # the same, over which solid matter takes away half of the light
FIXES = {
    "out of bounds": "widen --bounds",
    "inside matter": "move --bounds or the poses into free space, or lower --holdout and raise "
    "--train_steps if the field is foggy",
    "too near to matter": "lower --clearance",
    "in unseen space": "raise --spread, or name the free space by --candidates=box and --bounds",
    "": "list more poses, or lower --num_views",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What to propose; lengths and places are in the user's coordinates."""

    num_views: int
    policy: str
    candidates: str  # one of KINDS
    num_candidates: int
    bounds: np.ndarray | None  # [2, 3]
    poses_file: str
    clearance: float  # 0: a share of the cameras' distance from what they look at
    spread: float  # of the shell, a share of that distance
    gaze_jitter: float  # degrees
    score_scale: float  # of image width and height, for scores
    route: bool
    start: np.ndarray | None  # [3] where the route begins; None: at the last photo
    seed: int


def check_options(options: Options) -> None:
    """Raises PlacementError for a combination of options that cannot be used."""
    o = options
    for name, good, fix in (
        ("num_views", o.num_views >= 1, "give 1 or more"),
        ("num_candidates", o.num_candidates >= o.num_views, "give at least --num_views"),
        ("candidates", o.candidates in KINDS, f"use one of {', '.join(KINDS)}"),
        ("clearance", 0.0 <= o.clearance <= MAX_LENGTH, "give 0 or more, up to 1e9"),
        ("spread", 0.0 < o.spread <= 1000.0, "give a number above 0, up to 1000"),
        ("gaze_jitter", 0.0 <= o.gaze_jitter <= 90.0, "give degrees from 0 to 90"),
        ("score_scale", 0.0 < o.score_scale <= 1.0, "give a share above 0 and up to 1"),
    ):
        if not good:
            raise PlacementError(f"--{name}: {getattr(o, name)!r} cannot be used: {fix}")
    if o.candidates == "box" and o.bounds is None:
        raise PlacementError("--bounds: is missing: --candidates=box needs x0,y0,z0,x1,y1,z1")
    if (o.candidates == "file") != bool(o.poses_file):
        raise PlacementError("--poses_file: goes with --candidates=file: give both or neither")
    if o.start is not None and not o.route:
        raise PlacementError("--start: is only of use with --route: give both or neither")


def parse_numbers(text: str, count: int, flag: str) -> np.ndarray | None:
    """`count` numbers with commas between them; None for an empty text."""
    if not text.strip():
        return None
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError as error:
        raise PlacementError(f"--{flag}: {error}: give {count} numbers with commas") from error
    if values.shape != (count,) or not (abs(values) <= MAX_LENGTH).all():
        raise PlacementError(
            f"--{flag}: {shown(text)}: give {count} numbers of at most 1e9 with commas"
        )
    return values


def parse_bounds(text: str) -> np.ndarray | None:
    """The corners [2, 3] of `x0,y0,z0,x1,y1,z1`."""
    values = parse_numbers(text, 6, "bounds")
    if values is None:
        return None
    bounds = values.reshape(2, 3)
    if not (bounds[0] < bounds[1]).all():
        raise PlacementError(f"--bounds: {text!r}: each of x1,y1,z1 must be above x0,y0,z0")
    return bounds


# --- the place and its candidates --------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """What the photos say about the place, in scene units; `unit` leads to the user's."""

    focus: np.ndarray  # [3] what the photos look at
    distance: float  # median of the photos from there
    faces_focus: bool  # false: the photos look outwards
    clearance: float
    solid_density: float
    unit: float  # user units per scene unit
    user_from_scene: np.ndarray  # [4, 4]

    def to_user(self, positions) -> np.ndarray:
        """Points [..., 3] in the user's coordinates."""
        matrix = self.user_from_scene
        return np.asarray(positions, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]

    def to_scene(self, positions) -> np.ndarray:
        """Points [..., 3] from the user's coordinates."""
        matrix = np.linalg.inv(self.user_from_scene)
        return np.asarray(positions, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def look_around(scene: Scene, options: Options) -> Surroundings:
    """Finds the focus of the photos and sets the lengths that follow from it."""
    poses = np.asarray(scene.cameras.world_from_cam)
    focus = focus_point(poses, scene.centre)
    distance = float(np.median(np.linalg.norm(poses[:, :, 3] - focus, axis=-1)))
    matrix = np.asarray(scene.user_from_scene, np.float64)
    unit = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return Surroundings(
        focus=focus,
        distance=distance,
        faces_focus=share_facing(poses, focus) >= 0.5,
        clearance=options.clearance / unit or CLEARANCE_SHARE * distance,
        solid_density=matter_density(SOLID_SHARE * distance),
        unit=unit,
        user_from_scene=matrix,
    )


def propose(scene: Scene, density_fn: Callable, around: Surroundings, options: Options):
    """Draws and judges candidate poses.

    Args:
      scene: the capture.
      density_fn: points [K, 3] -> density [K], scene units.
      around: from `look_around`.
      options: what the user asked for.

    Returns:
      `Proposals`.

    Raises:
      PlacementError: fewer than `options.num_views` are left.
      SceneError: the file of poses cannot be used.
    """

    def judge(poses):
        positions = poses[:, :, 3]
        inside, near = judge_positions(
            positions,
            density_fn,
            clearance=around.clearance,
            solid_density=around.solid_density,
        )
        in_bounds = within_bounds(around.to_user(positions), options.bounds)
        # The first reason counts, in the order of `clearance.REASONS`.
        reason = np.select([~in_bounds, inside, near], [0, 1, 2], -1)
        if options.candidates == "shell":
            # The other kinds are places that the user has named.
            left = np.flatnonzero(reason < 0)
            reach = options.spread * around.distance
            unseen = in_unknown_space(positions[left], photos, density_fn, reach=reach)
            reason[left[unseen]] = 3
        return reason

    photos = take(scene.cameras, scene.pool)

    draw = _make_draw_fn(scene, around, options)
    wanted = options.num_candidates
    if options.candidates == "file":
        wanted = max(wanted, len(draw(0)))
    proposals = collect_poses(draw, judge, wanted)
    check_enough(proposals, options.num_views, fixes=FIXES)
    return proposals


def photos_in_matter(scene: Scene, density_fn: Callable, around: Surroundings) -> int:
    """How many photos the same test would turn away: where not 0, the field has fog or floaters."""
    positions = np.asarray(scene.cameras.positions)
    inside, _ = judge_positions(
        positions, density_fn, clearance=around.clearance, solid_density=around.solid_density
    )
    return int(inside.sum())


def candidate_cameras(scene: Scene, poses) -> Cameras:
    """The poses as cameras with the lens of a photo whose image size is the commonest."""
    sizes, which = np.unique(np.asarray(scene.cameras.sizes), axis=0, return_inverse=True)
    first = int(np.argmax(which == np.bincount(which, minlength=len(sizes)).argmax()))
    one = take(jax.tree.map(np.asarray, scene.cameras), np.array([first]))
    cameras = jax.tree.map(lambda x: np.repeat(x, len(poses), axis=0), one)
    return cameras.replace(world_from_cam=np.asarray(poses, np.float32))


def gaze_between(directions) -> np.ndarray:
    """Unit directions [N, 3] midway between two [N, 2, 3]; of opposite ones, the first."""
    middle = directions.mean(axis=1)
    length = np.linalg.norm(middle, axis=-1, keepdims=True)
    return np.where(length > OPPOSITE, middle / np.maximum(length, OPPOSITE), directions[:, 0])


def _make_draw_fn(scene: Scene, around: Surroundings, options: Options) -> Callable:
    """Lap number -> poses [n, 3, 4] in scene coordinates."""
    cameras = np.asarray(scene.cameras.world_from_cam, np.float64)
    num, up = options.num_candidates, scene.up

    def shell(rng, lap):
        positions, pairs = shell_positions(
            rng, num, cameras[:, :, 3], focus=around.focus, up=up, spread=options.spread
        )
        targets = np.broadcast_to(around.focus, positions.shape)
        if not around.faces_focus:
            # Photos that look outwards have nothing in common to look at.
            targets = positions + around.distance * gaze_between(-cameras[pairs, :, 2])
        return aim(positions, turned_targets(rng, positions, targets, options.gaze_jitter), up)

    def hemisphere(rng, lap):
        key = jax.random.fold_in(stream_key(options.seed, "places"), lap)
        return hemisphere_poses(key, num, centre=around.focus, radius=around.distance, up=up)

    def box(rng, lap):
        positions = around.to_scene(box_positions(rng, num, options.bounds))
        targets = np.broadcast_to(around.focus, positions.shape)
        return aim(positions, turned_targets(rng, positions, targets, options.gaze_jitter), up)

    def file(rng, lap):
        poses = read_pose_file(options.poses_file) if lap == 0 else np.zeros((0, 3, 4))
        return transform_poses(np.linalg.inv(around.user_from_scene), poses)

    draw_lap = {"shell": shell, "hemisphere": hemisphere, "box": box, "file": file}
    chosen = draw_lap[options.candidates]
    return lambda lap: chosen(np.random.default_rng([options.seed, lap]), lap)
