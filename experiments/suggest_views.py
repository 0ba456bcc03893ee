"""Where to stand next: proposes camera poses for a capture that has no candidate images.

    python -m experiments.suggest_views --data=FOLDER --num_views=10 --workdir=runs/suggestion

Trains a field on every photo, estimates its uncertainty, and chooses among free poses that are
clear of matter and within bounds. Poses are written in the coordinates of the user's own files.
The same command goes on with a run that was stopped; with other candidates it uses the same field.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time

from absl import flags
from ml_collections import config_flags

from bavs_jax.scenes import LOADERS, load_scene
from bavs_jax.scenes.pose_files import read_pose_file
from experiments import runtime
from experiments.build import Problem
from experiments.files import check_claim, claim
from experiments.schema import MAX_SEED, MAX_WIDTH, check_config
from experiments.suggest import choosing, places, results

FLAGS = flags.FLAGS
runtime.define_cache_flags()
flags.DEFINE_string("data", None, "Folder of the capture, in any layout that can be loaded.")
flags.DEFINE_string("workdir", None, "Folder for poses, checkpoints and report.html.")
flags.DEFINE_integer("num_views", 10, "How many poses to propose.", 1, places.MAX_POSES)
flags.DEFINE_string("policy", "bavs_spread", "Acquisition policy that chooses.")
flags.DEFINE_integer("holdout", 0, "Photos left out of training, to measure the field on.", 0)
flags.DEFINE_enum("loader", "auto", [*LOADERS, "auto"], "Layout of the folder; auto: by its files.")
flags.DEFINE_integer(
    "image_size", 135, "Width in pixels to which the widest photo is reduced.", 1, MAX_WIDTH
)
flags.DEFINE_integer("train_steps", 2400, "Optimiser steps of the field.", 1)
config_flags.DEFINE_config_dict(
    "config",
    choosing.default_config(),
    "Every other option of the field and its uncertainty, as --config.name=value; they are "
    "explained in experiments/configs/base.py.",
)
flags.DEFINE_integer("seed", 0, "Of everything that is drawn.", 0, MAX_SEED)
flags.DEFINE_enum("candidates", "shell", places.KINDS, "Where a camera could stand.")
flags.DEFINE_integer("num_candidates", 150, "Poses to choose from.", 1, places.MAX_POSES)
flags.DEFINE_string("bounds", "", "x0,y0,z0,x1,y1,z1 in user coordinates; no pose is outside.")
flags.DEFINE_string("poses_file", "", "JSON or CSV of reachable poses, for --candidates=file.")
flags.DEFINE_float("clearance", 0.0, "Free radius around a camera in user units; 0: 5 %.")
flags.DEFINE_float("spread", 0.25, "How far the shell goes beyond the photos, as a share.")
flags.DEFINE_float("gaze_jitter", 8.0, "Degrees by which shell and box poses look aside.")
flags.DEFINE_float("score_scale", 0.25, "Size of the images that are scored, as a share.")
flags.DEFINE_bool("route", False, "Order the poses along a short route.")
flags.DEFINE_string("start", "", "x,y,z where the route begins; default: at the last photo.")


def read_options() -> places.Options:
    """The flags as options, checked.

    Raises:
      PlacementError, SelectionError, SceneError: a value or a file that cannot be used.
    """
    given = {field.name: FLAGS[field.name].value for field in dataclasses.fields(places.Options)}
    given["bounds"] = places.parse_bounds(FLAGS.bounds)
    given["start"] = places.parse_numbers(FLAGS.start, 3, "start")
    options = places.Options(**given)
    places.check_options(options)
    if options.poses_file:
        read_pose_file(options.poses_file)  # what is wrong there shows before anything is trained
    choosing.check_policy(options.policy)
    return options


def read_config(data: pathlib.Path):
    """The config with what flags of their own say, checked.

    Raises:
      ConfigError: an option that cannot be used.
    """
    config = FLAGS.config
    config.loader, config.image_size = FLAGS.loader, FLAGS.image_size
    config.holdout, config.train.num_steps = FLAGS.holdout, FLAGS.train_steps
    config.candidates.image_scale = FLAGS.score_scale
    config.scene, config.data_dir = data.resolve().name, str(data.resolve().parent)
    return check_config(config, "holdout")


def suggest_views(
    config, data: pathlib.Path, folder: pathlib.Path, options: places.Options
) -> None:
    """Trains, proposes, chooses and writes."""
    begin = time.monotonic()
    check_claim(folder, config)
    scene = load_scene(FLAGS.loader, root=data, image_size=FLAGS.image_size)
    scene = choosing.all_for_training(scene, FLAGS.holdout)
    around = places.look_around(scene, options)
    print(f"{scene.name}: {len(scene.pool)} photos to train on, {len(scene.test)} left out")

    problem = Problem(config, scene)
    claim(folder, config)
    field_folder = folder / "field" / f"seed_{options.seed}"
    train = choosing.train_field(config, problem, field_folder, options.seed)
    jac_sq_sum = choosing.photo_curvature(problem, train, field_folder, options.seed)
    quality = choosing.holdout_quality(problem, train)

    proposals = places.propose(
        scene, lambda positions: problem.density(train, positions), around, options
    )
    print(f"candidates ({options.candidates}): {proposals.in_words()}")
    cameras = places.candidate_cameras(scene, proposals.poses)
    suggestion = choosing.suggest(problem, train, jac_sq_sum, cameras, around.focus, options)
    files = results.write_results(
        folder,
        problem=problem,
        train=train,
        jac_sq_sum=jac_sq_sum,
        around=around,
        proposals=proposals,
        cameras=cameras,
        suggestion=suggestion,
        options=options,
        quality=quality,
        command=runtime.command_line(),
        seconds_fn=lambda: time.monotonic() - begin,
    )
    for name, path in files.items():
        print(f"{name + ':':13}{path}")
    print(f"({time.monotonic() - begin:.0f} s in all)")


def main() -> None:
    data = runtime.given_folder("data", "the folder of the capture", exists=True)
    folder = runtime.given_folder("workdir", "a folder for the results")
    options, config = read_options(), read_config(data)
    runtime.start_cache()
    suggest_views(config, data, folder, options)


if __name__ == "__main__":
    runtime.run_script(main)
