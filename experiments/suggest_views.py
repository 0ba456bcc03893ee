"""Where to stand next: proposes camera poses for a capture that has no candidate images.

    python -m experiments.suggest_views --data=FOLDER --num_views=10 --workdir=runs/suggestion

Trains a field on every photo, estimates its uncertainty, and chooses among free poses that are
clear of matter and within bounds. Poses are written in the coordinates of the user's own files.
The same command goes on with a run that was stopped; with other candidates it uses the same field.
"""

import pathlib
import time
from functools import partial

from absl import flags
from ml_collections import config_flags

from bavs_jax.scenes import LOADERS, load_scene
from experiments import runtime, suggestion
from experiments.build import Problem
from experiments.files import check_claim, claim
from experiments.reporting.suggestion import write_results
from experiments.schema import MAX_SEED, MAX_WIDTH, check_config, parse_numbers
from experiments.suggestion import Options
from experiments.trained import FIRST_ROUND, train_run

MAX_POSES = 100_000
LEAST = 1e-6  # of a share that must be above 0
FLAGS = flags.FLAGS
runtime.define_cache_flags()
flags.DEFINE_string("data", None, "Folder of the capture, in any layout that can be loaded.")
flags.DEFINE_string("workdir", None, "Folder for poses, checkpoints and report.html.")
flags.DEFINE_integer("num_views", 10, "How many poses to propose.", 1, MAX_POSES)
flags.DEFINE_string("policy", "bavs_spread", "Acquisition policy that chooses.")
flags.DEFINE_integer("holdout", 0, "Photos left out of training, to measure the field on.", 0)
flags.DEFINE_enum("loader", "auto", [*LOADERS, "auto"], "Layout of the folder; auto: by its files.")
flags.DEFINE_integer(
    "image_size", 135, "Width in pixels to which the widest photo is reduced.", 1, MAX_WIDTH
)
flags.DEFINE_integer("train_steps", 2400, "Optimiser steps of the field.", 1)
config_flags.DEFINE_config_dict(
    "config",
    suggestion.default_config(),
    "Every other option of the field and its uncertainty, as --config.name=value; they are "
    "explained in experiments/configs/base.py.",
)
flags.DEFINE_integer("seed", 0, "Of everything that is drawn.", 0, MAX_SEED)
flags.DEFINE_enum("candidates", "shell", suggestion.KINDS, "Where a camera could stand.")
flags.DEFINE_integer("num_candidates", 150, "Poses to choose from.", 1, MAX_POSES)
flags.DEFINE_string("bounds", "", "x0,y0,z0,x1,y1,z1 in user coordinates; no pose is outside.")
flags.DEFINE_string("poses_file", "", "JSON or CSV of reachable poses, for --candidates=file.")
flags.DEFINE_float("clearance", 0.0, "Free radius around a camera in user units; 0: 5 %.", 0, 1e9)
flags.DEFINE_float("spread", 0.25, "Share by which the shell goes beyond the photos.", LEAST, 1000)
flags.DEFINE_float("gaze_jitter", 8.0, "Degrees by which shell and box poses look aside.", 0, 90)
flags.DEFINE_float("score_scale", 0.25, "Size of the images that are scored, a share.", LEAST, 1)
REFINE = "Steps by which each chosen pose is moved and turned to where it tells more; 0: none."
flags.DEFINE_integer("refine", 0, REFINE, 0, 1000)
flags.DEFINE_bool("route", False, "Order the poses along a short route.")
flags.DEFINE_string("start", "", "x,y,z where the route begins; default: at the last photo.")


def read_options() -> Options:
    """The flags as options, checked; errors as in `check_options`."""
    given = {name: FLAGS[name].value for name in Options._fields}
    given["bounds"] = parse_numbers(FLAGS.bounds, (2, 3), "bounds")
    given["start"] = parse_numbers(FLAGS.start, (3,), "start")
    options = Options(**given)
    suggestion.check_options(options)
    return options


def read_config(data: pathlib.Path):
    """The config with what flags of their own say, checked.

    Raises:
      ConfigError: an option that cannot be used.
    """
    config = FLAGS.config
    config.loader, config.image_size = FLAGS.loader, FLAGS.image_size
    config.holdout, config.train.num_steps = FLAGS.holdout, FLAGS.train_steps
    config.num_initial, config.candidates.image_scale = 0, FLAGS.score_scale
    config.scene, config.data_dir = data.resolve().name, str(data.resolve().parent)
    return check_config(config, "holdout")


def suggest_views(config, data: pathlib.Path, folder: pathlib.Path, options: Options) -> None:
    """Trains, proposes, chooses and writes."""
    begin = time.monotonic()
    check_claim(folder, config)
    scene = load_scene(FLAGS.loader, root=data, image_size=FLAGS.image_size)
    scene = suggestion.all_for_training(scene, FLAGS.holdout)
    around = suggestion.look_around(scene, options)
    print(f"{scene.name}: {len(scene.pool)} photos to train on, {len(scene.test)} left out")

    problem = Problem(config, scene)
    claim(folder, config)
    run = train_run(config, problem, folder, FIRST_ROUND, options.seed)
    jac_sq_sum = suggestion.photo_curvature(run)
    density_fn = partial(problem.density, run.state.train)
    proposals = suggestion.propose(scene, density_fn, around, options)
    print(f"candidates ({options.candidates}): {proposals.in_words()}")
    found = suggestion.suggest(run, jac_sq_sum, around, proposals, options)
    files = write_results(folder, run, jac_sq_sum, found, options, begin)
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
