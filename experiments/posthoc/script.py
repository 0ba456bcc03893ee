"""What the scripts on a trained run share: their flags, and the runs that these name.

With --config a run is trained as far as --workdir does not hold it yet; without, the last
checkpoints in --workdir are taken up as they are.
"""

import pathlib
import time
from collections.abc import Callable, Iterator

from absl import flags
from ml_collections import config_flags

from experiments import runtime
from experiments.build import Problem, check_views, load_config_scene
from experiments.files import check_claim, claim, write_json
from experiments.reporting.result_tables import FILES
from experiments.reporting.tables import collected_text
from experiments.runtime import ConfigError
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

FLAGS = flags.FLAGS
runtime.define_cache_flags()
CONFIG = (
    "What to train first where --workdir does not hold it yet, such as "
    "experiments/configs/quickstart.py; every option can be set as --config.name=value. Without "
    "it, the runs that --workdir holds are taken up where they are."
)
config_flags.DEFINE_config_file("config", None, CONFIG, lock_config=True)
flags.DEFINE_string("workdir", None, "Folder of runs of active_selection, or of new ones.")
flags.DEFINE_string("policy", "", "Whose field; initial: round 0. By default the config's first.")
flags.DEFINE_integer("seed", None, "Of which seed; by default all of that policy.", 0, MAX_SEED)
flags.DEFINE_string("data_dir", "", "Folder of scenes, if it has moved since the run.")


def trained_runs() -> Iterator[TrainedRun]:
    """The runs that the flags name, one after another; one scene and one compilation for all.

    Raises:
      ConfigError, WorkdirError, SceneError: flags, folder or scene cannot be used.
    """
    folder, config = runtime.given_folder("workdir", "the folder of a run"), given_config()
    runtime.start_cache()
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
            run = load_run(problem, folder, policy, seed)
        state = "the end of" if run.completed else "the last checkpoint of"
        print(f"{scene.name}: {state} {run.label}, {len(run.training_views)} training views")
        yield run


def measure_runs(measure: Callable[[TrainedRun], dict], name: str) -> None:
    """Measures the runs one after another; each is a row of the file `name` in --workdir."""
    path, rows = pathlib.Path(FLAGS.workdir or "") / name, []
    for run in trained_runs():
        start = time.monotonic()
        measured = measure(run)
        rows.append({"seconds": time.monotonic() - start, **measured})
        # Written after each run, so that a command that is stopped leaves what it has measured.
        write_rows(path, run, rows)
    print(f"numbers: {path}\n{collected_text(FILES[name](path))}")


def write_rows(path: pathlib.Path, run: TrainedRun, rows: list[dict]) -> None:
    """A result file: a row for each run of a folder, with all that made it; `run` is the last."""
    about = {
        "policy": run.policy,
        "seed": run.seed,
        "completed": run.completed,
        "round": int(run.state.round),
        "num_views": len(run.training_views),
    }
    rows[-1] = {**about, **rows[-1]}
    result = {
        "schema_version": 1,
        "scene": run.problem.scene.name,
        "kind": run.problem.config.loader,
        "command": runtime.command_line(),
        "config": run.problem.config.to_dict(),
        "versions": runtime.versions(),
        "device": runtime.device_name(),
        "rows": rows,
    }
    write_json(path, result)
