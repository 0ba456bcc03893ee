"""What the scripts on a trained run share: their flags, and the runs that these name.

With --config a run is trained as far as --workdir does not hold it yet; without, the last
checkpoints in --workdir are taken up as they are.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable, Iterator

from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.build import Problem, check_views, load_config_scene
from experiments.files import check_claim, claim, write_json
from experiments.runtime import ConfigError, device_name, versions
from experiments.schema import MAX_SEED, given_config
from experiments.trained import (
    FIRST_ROUND,
    TrainedRun,
    choose_runs,
    field_kind,
    load_run,
    saved_config,
    train_run,
)

SCHEMA_VERSION = 1

FLAGS = flags.FLAGS
runtime.define_cache_flags()
config_flags.DEFINE_config_file(
    "config",
    None,
    "What to train first where --workdir does not hold it yet, such as "
    "experiments/configs/quickstart.py; every option can be set as --config.name=value. Without "
    "it, the runs that --workdir holds are taken up where they are.",
    lock_config=True,
)
flags.DEFINE_string(
    "workdir", None, "Folder of a run of experiments.active_selection, or of a new one."
)
flags.DEFINE_string(
    "policy", "", "Whose field; initial: round 0. By default the config's first policy."
)
flags.DEFINE_integer(
    "seed", None, "Of which seed; by default all seeds of that policy.", 0, MAX_SEED
)
flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the run.")


def check_flags(*rules: tuple[str, bool, str]) -> None:
    """Raises ConfigError for the first flag whose rule `(name, is good, fix)` does not hold."""
    for name, good, fix in rules:
        if not good:
            raise ConfigError(f"--{name}: {FLAGS[name].value!r} cannot be used: {fix}")


def trained_runs() -> Iterator[TrainedRun]:
    """The runs that the flags name, one after another; one scene and one compilation for all.

    Raises:
      ConfigError, WorkdirError, SceneError: flags, folder or scene cannot be used.
    """
    folder, config = runtime.given_folder("workdir", "the folder of a run"), given_config()
    is_new = config is not None
    if is_new:
        if FLAGS.data_dir:
            raise ConfigError("--data_dir: with --config, give --config.data_dir in its place")
        # A config without rounds ends where all policies begin.
        policy = FLAGS.policy or (config.policies[0] if config.num_rounds else FIRST_ROUND)
        field_kind(policy)  # an unknown policy ends here, before anything is written
        check_claim(folder, config)
        seeds = config.seeds if FLAGS.seed is None else (FLAGS.seed,)
        chosen = [(policy, seed) for seed in seeds]
    else:
        config = saved_config(folder)
        chosen = choose_runs(folder, config, FLAGS.policy, FLAGS.seed)
        config.data_dir = FLAGS.data_dir or config.data_dir
    scene = load_config_scene(config, cache_dir=runtime.scene_cache())
    if is_new:
        check_views(config, scene)
    problem = Problem(config, scene, field_kind(chosen[0][0]))
    if is_new:
        claim(folder, config)
    for policy, seed in chosen:
        if is_new:
            run = train_run(config, problem, folder, policy, seed, runtime.command_line())
        else:
            run = load_run(config, problem, folder, policy, seed)
        state = "the end of" if run.completed else "the last checkpoint of"
        print(f"{scene.name}: {state} {run.label}, {len(run.training_views)} training views")
        yield run


def measure_runs(measure: Callable[[TrainedRun], dict], name: str) -> None:
    """Measures the runs one after another; each is a row of the file `name` in --workdir."""
    start, path, rows = time.monotonic(), pathlib.Path(FLAGS.workdir) / name, []
    for run in trained_runs():
        before = time.monotonic()
        measured = measure(run)
        rows.append({**about_run(run), "seconds": time.monotonic() - before, **measured})
        # Written after each run, so that a command that is stopped leaves what it has measured.
        write_json(path, result_file(run, rows))
    print(f"numbers:  {path}")
    print(f"({time.monotonic() - start:.0f} s in all)")


def about_run(run: TrainedRun) -> dict:
    """What a result file says first: of which run it is."""
    return {
        "policy": run.policy,
        "seed": run.seed,
        "completed": run.completed,
        "round": int(run.state.round),
        "num_views": len(run.training_views),
    }


def result_file(run: TrainedRun, rows: list[dict]) -> dict:
    """A result file over the runs of a folder, each a row, with all that made it.

    Args:
      run: any of them.
      rows: each begins with `about_run`.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "scene": run.problem.scene.name,
        "kind": run.config.loader,
        "command": runtime.command_line(),
        "config": run.config.to_dict(),
        "versions": versions(),
        "device": device_name(),
        "rows": rows,
    }


def run_on_trained(work: Callable[[], None]) -> None:
    """Starts `work()` as the main of a script; what is wrong with its flags ends in one line."""

    def main() -> None:
        given_config()
        runtime.given_folder("workdir", "the folder of a run")
        runtime.start_cache()
        work()

    runtime.run_script(main)
