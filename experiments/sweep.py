"""Runs an experiment for many policies, seeds and options, on all cores or on a cluster.

    python -m experiments.sweep --config=experiments/configs/quickstart.py \\
        --axis=policy=bavs,random --axis=seed=0:5 --workdir=runs/sweep

An axis is `policy`, `seed` or an option of the config, such as
--axis=config.uncertainty.log2_cells=5,6,7; each setting of options has a folder of its own, as a
single run would make it. With --change in place of --axis, options are changed one at a time, as
ablations do. Started again, a sweep goes on: what is finished is not run again.
"""

from __future__ import annotations

import pathlib
import sys

from absl import flags
from ml_collections import config_flags

from experiments import compilation, runtime, workdir
from experiments.reporting.report import write_report
from experiments.schema import check_config, given_config
from experiments.sweeps import capacity
from experiments.sweeps.axes import parse_axes
from experiments.sweeps.local import LocalEngine
from experiments.sweeps.plan import Setting, make_settings, make_trials, option_flag
from experiments.sweeps.ray_engine import RayEngine
from experiments.sweeps.record import Record, merged, read_record, write_record
from experiments.sweeps.run import run_trials
from experiments.sweeps.schedule import Engine

FLAGS = flags.FLAGS
flags.adopt_module_key_flags(compilation)
config_flags.DEFINE_config_file(
    "config", None, "What to run; see experiments.active_selection.", lock_config=True
)
flags.DEFINE_string("workdir", None, "Folder for all results.")
flags.DEFINE_multi_string(
    "axis", [], "What to vary: name=value,value or seed=0:5; may be repeated."
)
flags.DEFINE_multi_string(
    "change", [], "As --axis, but each value alone, beside the config as it is; may be repeated."
)
flags.DEFINE_enum("engine", "local", ["local", "ray"], "Processes here, or a Ray cluster.")
flags.DEFINE_integer("jobs", 0, "local: most trials at a time; 0: as many as fit.", 0)
flags.DEFINE_integer(
    "cores_per_trial", 1, "Cores of each trial; more trials do more than cores.", 1
)
flags.DEFINE_float("gb_per_trial", 2.0, "local: host memory that a trial needs.", 0.1)
flags.DEFINE_string("ray_address", None, "ray: the cluster; the one this machine is in by default.")
flags.DEFINE_integer("retries", 2, "How often a trial is started again whose worker died.", 0)


def make_engine() -> Engine:
    """The engine that the flags name."""
    if FLAGS.engine == "ray":
        return RayEngine(FLAGS.ray_address, FLAGS.cores_per_trial)
    slots = capacity.make_slots(
        capacity.usable_cores(),
        capacity.free_memory_gb(),
        capacity.visible_gpus(),
        jobs=FLAGS.jobs,
        cores_per_trial=FLAGS.cores_per_trial,
        gb_per_trial=FLAGS.gb_per_trial,
    )
    print(f"{len(slots)} at a time, on cores {', '.join(str([*slot.cores]) for slot in slots)}")
    return LocalEngine(slots)


def claim_folders(settings: list[Setting], folder: pathlib.Path) -> Record:
    """Checks every setting before anything is run, and notes what the sweep is made of."""
    for setting in settings:
        check_config(setting.config)
        workdir.check_claim(setting.folder, setting.config)
    for setting in settings:
        workdir.claim(setting.folder, setting.config)
    rows = [
        {
            "folder": s.name,
            "values": s.values,
            "policies": [*s.config.policies],
            "seeds": [*s.config.seeds],
        }
        for s in settings
    ]
    record = merged(read_record(folder), Record(runtime.command_line(), rows, {}))
    write_record(folder, record)
    return record


def write_outputs(settings: list[Setting]) -> None:
    """The summary, the exported views and the report of every setting that has a result."""
    for setting in settings:
        if not workdir.collect(setting.folder)["runs"]:
            continue
        first = next((p for p in setting.parts if p.policy), None)
        if first and (setting.folder / first.name / "next_views").exists():
            workdir.export_next_views(setting.folder, first.policy, first.seed)
        print(f"report: {write_report(setting.folder)}")


def sweep(config, folder: pathlib.Path, given: list[str]) -> int:
    """The whole sweep; returns how many trials failed."""
    settings = make_settings(config, parse_axes(FLAGS.axis, config, FLAGS.change), folder)
    record = claim_folders(settings, folder)
    trials = [t for s in settings for t in make_trials(s, given, compilation.as_flags())]
    planned = sum(part.policy is not None for s in settings for part in s.parts)
    left = sum(trial.part.policy is not None for trial in trials)
    print(f"trials: {planned}, finished before: {planned - left}", flush=True)
    failed = (
        run_trials(trials, make_engine(), record, folder, retries=FLAGS.retries) if trials else 0
    )
    write_outputs(settings)
    for name, reason in record.failed.items():
        print(f"{name}: {reason}")
    return failed


def main() -> None:
    config = given_config("experiments/configs/quickstart.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    flag = FLAGS["config"]
    given = [f"--config={config_flags.get_config_filename(flag)}"]
    given += [option_flag(*item) for item in config_flags.get_override_values(flag).items()]
    failed = sweep(config, folder, given)
    if failed:
        sys.exit(f"error: {failed} trial{'s' if failed > 1 else ''} failed; reasons are above")


if __name__ == "__main__":
    runtime.run_script(main)
