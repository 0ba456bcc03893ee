"""Trains a field on few views, chooses the next ones by several policies, and compares them.

    python -m experiments.active_selection \\
        --config=experiments/configs/quickstart.py --workdir=runs/quickstart

Any option of the config can be given as a flag, such as --config.seeds='(0,1,2)'. A run that was
stopped goes on when it is started again with the same --workdir.
"""

from __future__ import annotations

import pathlib
import sys
import time

from absl import flags
from jax.sharding import Mesh
from ml_collections import config_flags

from bavs_jax.selection.policies import POLICIES
from experiments import compilation, job, runtime, workdir
from experiments.build import build_problem
from experiments.build_scene import check_views, load_config_scene
from experiments.errors import USER_ERRORS, one_line
from experiments.files import exclusive
from experiments.parts import all_parts, find_part
from experiments.processes import is_first_process
from experiments.report import write_report
from experiments.runner import Run
from experiments.schema import given_config

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(compilation)
flags.adopt_module_key_flags(job)
config_flags.DEFINE_config_file(
    "config",
    None,
    "What to run, such as experiments/configs/quickstart.py; every option is explained in "
    "experiments/configs/base.py and can be set as --config.name=value.",
    lock_config=True,
)
flags.DEFINE_string("workdir", None, "Folder for results, checkpoints and report.html.")
flags.DEFINE_string(
    "part", None, "Make just this sub-folder, such as bavs/seed_0, without summary and report."
)
flags.DEFINE_bool("end_with_stdin", False, "Stop when standard input is closed.")
flags.DEFINE_bool("list_policies", False, "Print the known acquisition policies and stop.")


def make_parts(
    config, folder: pathlib.Path, command: str, only: str | None = None, mesh: Mesh | None = None
) -> None:
    """Every policy with every seed, each from the round 0 it shares; or only one part of that."""
    parts = all_parts(config.policies, config.seeds)
    if only is not None:
        parts = [find_part(only, parts)]
    workdir.check_claim(folder, config)
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    check_views(config, scene)
    print(f"{scene.name}: {len(scene.pool)} views to choose from, {len(scene.test)} test views")
    problems = {kind: build_problem(config, scene, kind, mesh) for kind in {p.kind for p in parts}}
    workdir.claim(folder, config)

    def make(part, shared=None) -> Run:
        # Other processes may make other parts of the same folder, and need the same round 0.
        with exclusive(folder / part.name):
            run = Run(config, problems[part.kind], folder, part.policy, part.seed, command)
            run.finish(shared)
            return run

    first_rounds = {}
    for part in parts:
        if part.initial not in first_rounds:
            first_rounds[part.initial] = make(part.initial)
        if part.policy is not None:
            make(part, first_rounds[part.initial])
            if only is None and is_first_process():
                workdir.collect(folder)


def run_all(config, folder: pathlib.Path, command: str, mesh: Mesh | None) -> None:
    """All parts of a config, then the exported views and the report."""
    start = time.monotonic()
    make_parts(config, folder, command, mesh=mesh)
    if not is_first_process():
        return
    next_views = workdir.export_next_views(folder, config.policies[0], config.seeds[0])
    report = write_report(folder)
    print(f"chosen poses: {next_views}")
    print(f"report:       {report}  ({time.monotonic() - start:.0f} s in all)")


def main() -> None:
    if FLAGS.list_policies:
        for name, policy in POLICIES.items():
            print(f"{name:16} {policy.summary}")
        return
    config = given_config("experiments/configs/quickstart.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    compilation.start_cache()
    if FLAGS.end_with_stdin:
        runtime.end_with_parent()
    try:
        mesh = job.start_job()
        if FLAGS.part is not None:
            make_parts(config, folder, runtime.command_line(), only=FLAGS.part, mesh=mesh)
        else:
            run_all(config, folder, runtime.command_line(), mesh)
    except OSError as error:
        sys.exit(f"error: {one_line(error)}")
    except USER_ERRORS as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
