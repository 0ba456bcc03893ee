"""Runs trials, shows how far all of them are together, and keeps the sweep's files up to date."""

from __future__ import annotations

import contextlib
import pathlib

from experiments import workdir
from experiments.progress import track
from experiments.sweeps.local import StepCounter
from experiments.sweeps.plan import Trial, num_steps
from experiments.sweeps.record import Record, write_record
from experiments.sweeps.schedule import Engine, run_jobs


def run_trials(
    trials: list[Trial], engine: Engine, record: Record, folder: pathlib.Path, *, retries: int
) -> int:
    """Runs all trials; returns how many failed.

    Args:
      trials: what to run.
      engine: where.
      record: of the sweep; failures are noted there, and struck out when they are made good.
      folder: of the sweep.
      retries: see `run_jobs`.
    """
    by_name = {trial.job.name: trial for trial in trials}
    counters = {
        t.setting.name: StepCounter(t.setting.folder, t.setting.config.train.num_steps)
        for t in trials
    }
    before = shown = _steps_done(trials, counters, set())
    total = sum(map(num_steps, trials)) - before
    running, finished, failed = set(), set(), set()
    with (
        contextlib.closing(run_jobs([t.job for t in trials], engine, retries=retries)) as events,
        track(total, f"{len(trials)} processes", "steps") as bar,
    ):
        for kind, job, reason in events:
            if kind == "started":
                running.add(job.name)
            elif kind != "tick":
                running.discard(job.name)
                print(f"{job.name}: {kind}{': ' if reason else ''}{reason}", flush=True)
            if kind in ("finished", "failed"):
                {"finished": finished, "failed": failed}[kind].add(job.name)
                note_end(by_name[job.name], record, folder, reason)
            done = _steps_done(trials, counters, finished | failed)
            counts = {"running": len(running), "finished": len(finished), "failed": len(failed)}
            bar.advance(done - shown, **counts)
            shown = done
    return len(failed)


def note_end(trial: Trial, record: Record, folder: pathlib.Path, reason: str) -> None:
    """Writes down how a trial ended; a `reason` is that of its failure."""
    name = f"{trial.setting.name}/{trial.part.name}"
    record.failed.pop(name, None)
    if reason:
        record.failed[name] = f"failed: {reason} (log: {trial.job.log})"
    elif trial.part.policy:
        workdir.collect(trial.setting.folder)
    write_record(folder, record)


def _steps_done(trials: list[Trial], counters: dict[str, StepCounter], ended: set[str]) -> int:
    """Optimiser steps behind all trials; one that has ended has none left."""
    steps = {name: counter.read() for name, counter in counters.items()}
    done = 0
    for trial in trials:
        own = steps[trial.setting.name].get(trial.part.name, 0)
        if trial.part.policy:
            own -= trial.setting.config.train.num_steps  # round 0 is another trial's
        most = num_steps(trial)
        done += most if trial.job.name in ended else min(max(own, 0), most)
    return done
