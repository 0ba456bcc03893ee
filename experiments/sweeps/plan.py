"""What a sweep is made of: a folder for each setting, a job for each part, and `sweep.json`."""

from __future__ import annotations

import collections
import copy
import dataclasses
import json
import pathlib
from functools import partial
from typing import Any, NamedTuple

from experiments.errors import ConfigError, WorkdirError
from experiments.files import read_versioned, write_json
from experiments.sweeps.axes import Axes, setting_name, settings
from experiments.sweeps.jobs import Job
from experiments.workdir import Part, all_parts, is_finished

UNCHANGED = "unchanged"  # folder of the config as it is, beside those of changes
SCRIPT = ("-m", "experiments.active_selection")
SCHEMA_VERSION = 1
FILE = "sweep.json"


class Setting(NamedTuple):
    """One combination of options, run as an experiment with a working folder of its own."""

    values: dict[str, Any]  # of the options that the sweep varies
    name: str  # of its folder in the sweep's
    folder: pathlib.Path
    config: Any
    parts: list[Part]


class Trial(NamedTuple):
    """One part of one setting, and the job that makes it."""

    setting: Setting
    part: Part
    job: Job

    @property
    def num_steps(self) -> int:
        """Optimiser steps from its beginning, round 0 not counted where it is shared."""
        config = self.setting.config
        return config.train.num_steps * (config.num_rounds if self.part.policy else 1)


def make_settings(config, axes: Axes, workdir: pathlib.Path) -> list[Setting]:
    """The experiments that a sweep is made of.

    Raises:
      SelectionError: a policy that does not exist.
      ConfigError: two settings whose folders would have the same name.
    """
    made: dict[str, Setting] = {}
    for values in settings(axes):
        own = copy.deepcopy(config)
        own.policies, own.seeds = axes.policies, axes.seeds
        own.update_from_flattened_dict(values)
        name = setting_name(values) if values or not axes.changes else UNCHANGED
        parts = all_parts(axes.policies, axes.seeds)
        if name in made:
            raise ConfigError(f"--axis: two settings would share the folder {name}; drop one")
        made[name] = Setting(values, name, workdir / name, own, parts)
    return [*made.values()]


def make_trials(
    setting: Setting, config_flags: list[str], cache_flags: list[str] | None = None
) -> list[Trial]:
    """A trial for each part that is not finished, and for the round 0 that such a part needs.

    Args:
      setting: the experiment.
      config_flags: what the user gave of the config, as flags.
      cache_flags: where compiled programs are kept, as flags; by default where a script would.
    """
    left = [p for p in setting.parts if p.policy and not is_finished(setting.folder, p)]
    wanted = {part for p in left for part in (p, p.initial)}
    todo = [p for p in setting.parts if p in wanted and not is_finished(setting.folder, p)]
    own = {"policies": setting.config.policies, "seeds": setting.config.seeds, **setting.values}
    # A tuple that is given twice would be added up.
    replaced = {option_flag(name, "") for name in own}
    kept = [flag for flag in config_flags if f"{flag.partition('=')[0]}=" not in replaced]
    shared = (*kept, *(option_flag(name, value) for name, value in own.items()))
    trials = []
    for part in todo:
        argv = (*SCRIPT, *shared, f"--workdir={setting.folder}", f"--part={part.name}")
        job = Job(
            name=f"{setting.folder / part.name}",
            argv=(*argv, "--end_with_stdin", *(cache_flags or ())),
            log=setting.folder / part.name / "log.txt",
            is_finished=partial(is_finished, setting.folder, part),
            needs=f"{setting.folder / part.initial.name}" if part.policy else None,
        )
        trials.append(Trial(setting, part, job))
    return trials


def option_flag(name: str, value) -> str:
    """An option of the config as a flag that means the same."""
    return f"--config.{name}={value if isinstance(value, str) else repr(value)}"


class StepCounter:
    """Optimiser steps that each part of a working folder has behind it."""

    def __init__(self, workdir: pathlib.Path, steps_per_round: int):
        self._path, self._steps_per_round = workdir / "metrics.jsonl", steps_per_round
        self._offset = 0
        self._steps = collections.Counter()

    def read(self) -> dict[str, int]:
        """Steps by name of the part, round 0 included; reads only what is new since last time."""
        if not self._path.exists():
            return self._steps
        with open(self._path, "rb") as file:
            file.seek(self._offset)
            text = file.read()
        end = text.rfind(b"\n") + 1
        self._offset += end
        for line in text[:end].splitlines():
            try:
                event = json.loads(line)
            except ValueError:  # what was being written when a process was killed
                continue
            rounds = event["round"] + (event["event"] == "round")
            steps = rounds * self._steps_per_round + event.get("step", 0)
            part = f"{event['policy']}/seed_{event['seed']}"
            # A part that was killed goes back to its checkpoint, which is no progress.
            self._steps[part] = max(self._steps[part], steps)
        return self._steps


@dataclasses.dataclass
class Record:
    """`sweep.json`: what a sweep is made of, and what of it is missing and why."""

    command: str
    settings: list[dict[str, Any]]  # each: folder, values, policies, seeds
    failed: dict[str, str]  # by folder/policy/seed_n: why, and where its log is

    def missing(self, folder: str, results: set[tuple[str, int]]) -> dict[tuple[str, int], str]:
        """Why a setting's runs that have no completed result have none, by policy and seed."""
        setting = next(s for s in self.settings if s["folder"] == folder)
        planned = [(p, s) for p in setting["policies"] for s in setting["seeds"]]
        return {
            (policy, seed): self.failed.get(f"{folder}/{policy}/seed_{seed}", "not run yet")
            for policy, seed in planned
            if (policy, seed) not in results
        }


def read_record(workdir: pathlib.Path) -> Record | None:
    """The record of a sweep's folder; None where there is none.

    Raises:
      WorkdirError: the file is broken or of another version.
    """
    path = workdir / FILE
    if not path.exists():
        return None
    fix = "delete it and run the sweep again"
    content = read_versioned(path, SCHEMA_VERSION, error=WorkdirError, absent=fix, fix=fix)
    return Record(content["command"], content["settings"], content["failed"])


def write_record(workdir: pathlib.Path, record: Record) -> None:
    """Writes the file."""
    write_json(workdir / FILE, {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(record))


def merged(before: Record | None, now: Record) -> Record:
    """A sweep taken up again: what it had before stays, with more settings, policies or seeds."""
    if before is None:
        return now
    old = {setting["folder"]: setting for setting in before.settings}
    rows = []
    for setting in now.settings:
        other = old.pop(setting["folder"], setting)
        both = {key: [*setting[key], *other[key]] for key in ("policies", "seeds")}
        rows.append(setting | {key: [*dict.fromkeys(values)] for key, values in both.items()})
    return Record(now.command, rows + list(old.values()), now.failed | before.failed)
