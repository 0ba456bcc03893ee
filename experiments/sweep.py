"""Runs an experiment for many policies, seeds and options, on all cores or on a cluster.

    python -m experiments.sweep --config=experiments/configs/quickstart.py \\
        --axis=policy=bavs,random --axis=seed=0:5 --workdir=runs/sweep

An axis is `policy`, `seed` or an option of the config, such as
--axis=config.uncertainty.log2_cells=5,6,7; each setting of options has a folder of its own, as a
single run would make it. With --change in place of --axis, options are changed one at a time, as
ablations do. Started again, a sweep goes on: what is finished is not run again.
While it runs, no other sweep may start in its folder.
"""

import contextlib
import pathlib
import sys
from collections import Counter

from absl import flags
from ml_collections import config_flags

from experiments import files, jobs, runtime
from experiments import sweep_plan as plan
from experiments.reporting.report import write_report
from experiments.schema import check_config, given_config

FLAGS = flags.FLAGS
runtime.define_cache_flags()
runtime.define_config_flag("What to run")
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


def make_engine() -> jobs.LocalEngine | jobs.RayEngine:
    """The engine that the flags name."""
    if FLAGS.engine == "ray":
        return jobs.RayEngine(FLAGS.ray_address, FLAGS.cores_per_trial)
    slots = jobs.make_slots(
        jobs.usable_cores(),
        jobs.free_memory_gb(),
        jobs.visible_gpus(),
        jobs=FLAGS.jobs,
        cores_per_trial=FLAGS.cores_per_trial,
        gb_per_trial=FLAGS.gb_per_trial,
    )
    print(f"{len(slots)} at a time, on cores {', '.join(str([*slot.cores]) for slot in slots)}")
    return jobs.LocalEngine(slots)


def claim_folders(settings: list[plan.Setting], folder: pathlib.Path) -> plan.Record:
    """Checks every setting before anything is run, and notes what the sweep is made of."""
    for setting in settings:
        files.check_claim(setting.folder, setting.config)
    rows = []
    for s in settings:
        files.claim(s.folder, s.config)
        own = {"policies": [*s.config.policies], "seeds": [*s.config.seeds]}
        rows.append({"folder": s.name, "values": s.values, **own})
    now = plan.Record(runtime.command_line(), rows, {})
    record = plan.merged(plan.read_record(folder), now)
    plan.write_record(folder, record)
    return record


def run_trials(trials: list[plan.Trial], record: plan.Record, folder: pathlib.Path) -> int:
    """Runs all trials and shows how far they are together; returns how many failed.

    Failures are noted in the record, and struck out when they are made good.
    """
    states = dict.fromkeys((trial.name for trial in trials), "waiting")

    def note_end(trial: plan.Trial, reason: str) -> None:
        name = f"{trial.setting.name}/{trial.part.name}"
        record.failed.pop(name, None)
        if reason:
            record.failed[name] = f"failed: {reason} (log: {trial.log})"
        elif trial.part.policy:
            files.collect(trial.setting.folder)
        plan.write_record(folder, record)

    events = jobs.run_jobs(trials, make_engine(), retries=FLAGS.retries)
    bar = runtime.track(len(trials), "sweep", "processes")
    with contextlib.closing(events), bar as task:
        for kind, trial, reason in events:
            if trial is not None:
                states[trial.name] = kind
                if kind != "started":
                    print(f"{trial.name}: {kind}{': ' if reason else ''}{reason}", flush=True)
                if kind in ("finished", "failed"):
                    note_end(trial, reason)
            count = Counter(states.values())
            numbers = {"running": count["started"], "failed": count["failed"]}
            task.advance(kind in ("finished", "failed"), **numbers)
    return count["failed"]


def write_outputs(settings: list[plan.Setting]) -> None:
    """The summary, the exported views and the report of every setting that has a result."""
    for setting in settings:
        if not files.collect(setting.folder)["runs"]:
            continue
        first = next((p for p in setting.parts if p.policy), None)
        if first and (setting.folder / first.name / "next_views").exists():
            files.export_next_views(setting.folder, first.policy, first.seed)
        print(f"report: {write_report(setting.folder)}")


def sweep(settings: list[plan.Setting], folder: pathlib.Path, given: list[str]) -> int:
    """The whole sweep; `given` are the config's flags. Returns how many trials failed."""
    record = claim_folders(settings, folder)
    cache = [FLAGS[name].serialize() for name in ("compilation_cache", "compilation_cache_dir")]
    trials = [trial for s in settings for trial in plan.make_trials(s, given, cache)]
    planned = sum(part.policy is not None for s in settings for part in s.parts)
    left = sum(trial.part.policy is not None for trial in trials)
    print(f"trials: {planned}, finished before: {planned - left}", flush=True)
    failed = run_trials(trials, record, folder) if trials else 0
    write_outputs(settings)
    for name, reason in record.failed.items():
        print(f"{name}: {reason}")
    return failed


def main() -> None:
    config = given_config("experiments/configs/quickstart.py")
    folder = runtime.given_folder("workdir", "a folder for the results")
    axes = plan.parse_axes(FLAGS.axis, config, FLAGS.change)
    settings = plan.make_settings(config, axes, folder)
    for setting in settings:
        check_config(setting.config)
    flag = FLAGS["config"]
    given = [f"--config={config_flags.get_config_filename(flag)}"]
    overrides = config_flags.get_override_values(flag)
    given += [plan.option_flag(*item) for item in overrides.items()]
    with files.exclusive(folder, wait=False):
        failed = sweep(settings, folder, given)
    if failed:
        sys.exit(f"error: {failed} trial{'s' if failed > 1 else ''} failed; reasons are above")


if __name__ == "__main__":
    runtime.run_script(main)
