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

from __future__ import annotations

import json
import pathlib
import shutil
import subprocess
import sys
import time

from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.bench.quality import first_seconds, measure_run, parse_targets, plateau
from experiments.bench.results import QUALITY, quality_tables, write_quality_page
from experiments.build import load_config_scene
from experiments.configs import base
from experiments.files import write_json
from experiments.reporting.tables import collected_text
from experiments.runtime import ConfigError, versions
from experiments.schema import given_config

FLAGS = flags.FLAGS
config_flags.DEFINE_config_file(
    "config",
    base.__file__,
    "The scene, the field and how it is trained; every option is explained in "
    "experiments/configs/base.py and can be set as --config.name=value.",
    lock_config=True,
)
flags.DEFINE_string("workdir", None, "Folder for time_to_quality.json and its page.")
flags.DEFINE_integer("num_views", 20, "Training views.", 1)
flags.DEFINE_integer("num_test_views", 25, "Test views, evenly spaced; 0: all.", 0)
flags.DEFINE_integer("every", 128, "Optimiser steps between two looks at the test views.", 1)
flags.DEFINE_list("targets", ["25", "28", "30"], "PSNR in dB, the smallest first.")
PREPARE, CACHES = "prepare", ("cold", "warm")
flags.DEFINE_enum("part", None, (PREPARE, *CACHES), "Set by the script itself: a part of its work.")
flags.DEFINE_float("started", None, "Set by the script itself: when that part was started.")

SCHEMA_VERSION = 1


def start_process(folder: pathlib.Path, part: str) -> dict | None:
    """One part in a process of its own; what it wrote, if anything.

    This process never touches the device, which a second one might not be able to share. Ctrl-C
    reaches this one only, which ends the other.
    """
    command = [sys.executable, "-m", "experiments.time_to_quality", *sys.argv[1:]]
    path = folder / f"{part}.json"
    path.unlink(missing_ok=True)
    command += [f"--part={part}", f"--started={time.time()!r}"]
    done = subprocess.run(command, check=False, start_new_session=True)
    if done.returncode:
        sys.exit(done.returncode)
    if not path.exists():
        return None
    found = json.loads(path.read_text(encoding="utf-8"))
    path.unlink()
    return found


def run_part(config, folder: pathlib.Path, part: str, targets: list[str]) -> None:
    """What a process that `start_process` has started does."""
    if part == PREPARE:
        load_config_scene(config, cache_dir=runtime.scene_cache())
        return
    print(f"{part} compilation cache:", flush=True)
    runtime.use_compilation_cache(folder / "compiled")
    found = measure_run(
        config,
        num_views=FLAGS.num_views,
        num_test_views=FLAGS.num_test_views,
        every=FLAGS.every,
        started=FLAGS.started,
    )
    seconds = first_seconds(found["curve"], targets)
    ending = plateau(found["curve"])
    write_json(folder / f"{part}.json", {"seconds_to_db": seconds, "plateau": ending, **found})


def compare_caches(config, folder: pathlib.Path, command: str) -> None:
    """Both runs, one after another, and the files."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / "compiled", ignore_errors=True)
    start_process(folder, PREPARE)
    runs = {cache: start_process(folder, cache) for cache in CACHES}
    common = {name: runs["cold"][name] for name in ("device", "scene", "num_test_views")}
    result = {
        "schema_version": SCHEMA_VERSION,
        **common,
        "runs": {
            cache: {name: run[name] for name in ("seconds_to_db", "plateau", "curve")}
            for cache, run in runs.items()
        },
        "num_views": FLAGS.num_views,
        "config": config.to_dict(),
        "command": command,
        "versions": versions(),
    }
    write_json(folder / QUALITY, result)
    page = folder / "time_to_quality.html"
    write_quality_page(page, result)
    print(collected_text(quality_tables(folder / QUALITY)))
    print(f"numbers: {folder / QUALITY}")
    print(f"page:    {page}")


def main() -> None:
    config, folder = given_config(), runtime.given_folder("workdir", "a folder for the results")
    if (FLAGS.part is None) != (FLAGS.started is None):
        raise ConfigError("--part and --started: are set by the script itself; leave them out")
    config.lpips_net = ""
    targets = parse_targets(FLAGS.targets)
    if FLAGS.part is None:
        compare_caches(config, folder, runtime.command_line())
    else:
        run_part(config, folder, FLAGS.part, targets)


if __name__ == "__main__":
    runtime.run_script(main)
