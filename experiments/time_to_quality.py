"""Measures how long it takes from starting a process to a field that is as good as it gets.

    python -m experiments.time_to_quality --workdir=runs/quality
    python -m experiments.time_to_quality --workdir=runs/quality_lego \\
        --config=experiments/configs/blender.py --config.data_dir=FOLDER

Starts a fresh process twice, first with an empty compilation cache, then with what the first has
left there, and writes `time_to_quality.json` and `time_to_quality.html`: seconds to some PSNRs, and
to within 0.3 dB of the best one of the whole round. The clock runs from the start of the process,
with imports, loading and compilation, and stands while test views are measured. The procedural
scene's photos are made before.
"""

import json
import math
import pathlib
import shutil
import subprocess
import sys
import time

import jax
from absl import flags

from bavs_jax.active import round_keys
from bavs_jax.training.fit import fit
from experiments import runtime
from experiments.build import load_config_scene, run_key
from experiments.configs import base
from experiments.evaluate import evaluate_views, evenly_spaced
from experiments.files import write_json
from experiments.reporting import benchmark as results
from experiments.runtime import ConfigError, shown, track
from experiments.schema import given_config
from experiments.stages import SEED, Subject

FLAGS = flags.FLAGS
runtime.define_config_flag("Scene, field and training", base.__file__)
flags.DEFINE_string("workdir", None, "Folder for time_to_quality.json and its page.")
flags.DEFINE_integer("num_views", 20, "Training views.", 1)
flags.DEFINE_integer("num_test_views", 25, "Test views, evenly spaced; 0: all.", 0)
flags.DEFINE_integer("every", 128, "Optimiser steps between two looks at the test views.", 1)
flags.DEFINE_list("targets", ["25", "28", "30"], "PSNR in dB, the smallest first.")
PREPARE, CACHES = "prepare", ("cold", "warm")
flags.DEFINE_enum("part", None, (PREPARE, *CACHES), "Set by the script itself: a part of its work.")
flags.DEFINE_float("started", None, "Set by the script itself: when that part was started.")


def compare_caches(config, folder: pathlib.Path) -> None:
    """Both runs, one after another, and the files.

    This process never touches the device, which a second one might not be able to share. Ctrl-C
    reaches this one only, which ends the other.
    """
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "compiled", ignore_errors=True)
    about, runs = {}, {}
    for part in (PREPARE, *CACHES):
        command = [sys.executable, "-m", "experiments.time_to_quality", *sys.argv[1:]]
        command += [f"--part={part}", f"--started={time.time()!r}"]
        done = subprocess.run(command, check=False, start_new_session=True)
        if done.returncode:
            sys.exit(done.returncode)
        if part != PREPARE:
            path = folder / f"{part}.json"
            about, runs[part] = json.loads(path.read_text(encoding="utf-8"))
            path.unlink()
    result = {
        "schema_version": 1,
        **about,
        "runs": runs,
        "num_views": FLAGS.num_views,
        "config": config.to_dict(),
        "command": runtime.command_line(),
        "versions": runtime.versions(),
    }
    results.write_result(folder / results.QUALITY, result, "Time to quality")


def run_part(config, folder: pathlib.Path, targets: list[str]) -> None:
    """What a process that `compare_caches` has started does.

    It trains as a run does, to the end of its round, and looks at test views on the way.
    """
    if FLAGS.part != PREPARE:
        print(f"{FLAGS.part} compilation cache:", flush=True)
        runtime.use_compilation_cache(folder / "compiled")
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    if FLAGS.part == PREPARE:
        return
    subject = Subject(config, scene, FLAGS.num_views)
    trainer, steps = subject.problem.trainer, config.train.steps_per_call
    view_ids = evenly_spaced(scene.test, FLAGS.num_test_views)
    *_, train_key = round_keys(run_key(SEED), 0)
    start = (subject.state, subject.problem.table, subject.is_training)
    started, curve = FLAGS.started, []
    with track(trainer.num_calls * steps, f"train on {FLAGS.num_views} views", "steps") as bar:
        for fitted in fit(train_key, trainer, *start, label="train"):
            bar.advance(steps)
            if fitted.calls % -(-FLAGS.every // steps) and fitted.calls != trainer.num_calls:
                continue
            jax.block_until_ready(fitted.train)
            stopped = time.time()
            psnr = evaluate_views(
                subject.problem.render(fitted.train),
                scene,
                view_ids,
                rays_per_pixel=config.rays_per_pixel,
            )["psnr"]
            seconds = stopped - started
            curve.append({"step": fitted.calls * steps, "seconds": seconds, "psnr": psnr})
            started += time.time() - stopped
            bar.advance(0, psnr=psnr)
    about = {"device": runtime.device_name(), "scene": scene.name, "num_test_views": len(view_ids)}
    found = {
        "seconds_to_db": results.first_seconds(curve, targets),
        "plateau": results.plateau(curve),
        "curve": curve,
    }
    write_json(folder / f"{FLAGS.part}.json", [about, found])


def given_targets() -> list[str]:
    """PSNRs in dB as they were given, the smallest first.

    Raises:
      ConfigError: there is none, or one of them is not a finite number.
    """
    try:
        numbers = [*map(float, FLAGS.targets)]
    except ValueError:
        numbers = []
    if not numbers or not all(map(math.isfinite, numbers)):
        given = shown(FLAGS.targets)
        raise ConfigError(f"--targets: {given} are not all numbers; give some like 25,28")
    return sorted(FLAGS.targets, key=float)


def main() -> None:
    config, folder = given_config(), runtime.given_folder("workdir", "a folder for the results")
    if (FLAGS.part is None) != (FLAGS.started is None):
        raise ConfigError("--part and --started: are set by the script itself; leave them out")
    config.lpips_net = ""
    targets = given_targets()
    if FLAGS.part is None:
        compare_caches(config, folder)
    else:
        run_part(config, folder, targets)


if __name__ == "__main__":
    runtime.run_script(main)
