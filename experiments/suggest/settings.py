"""The options of a suggestion, and the training config that they lead to."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np

from bavs_jax.placement.collect import PlacementError
from experiments.configs import capture
from experiments.errors import shown

KINDS = ("shell", "hemisphere", "box", "file")
MAX_POSES = 100_000
MAX_LENGTH = 1e9  # user units


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


def default_config():
    """The config of a field that is trained once on every photo of a capture."""
    config = capture.get_config()
    config.loader, config.image_size = "auto", 135
    config.holdout = 0  # photos left out of training, to measure the field on
    config.train.num_steps = 2400
    config.lpips_net = ""
    config.checkpoint_seconds = 20.0
    # Every photo's rays weigh in the curvature through a uniform subset, scaled up.
    config.uncertainty.max_rays = 40_000
    return config


def name_scene(config, data: pathlib.Path) -> None:
    """Puts the capture's folder into the config."""
    config.scene, config.data_dir = data.resolve().name, str(data.resolve().parent)
