"""From axes to jobs: a folder for each setting, a job for each of its parts."""

from __future__ import annotations

import copy
import pathlib
from functools import partial
from typing import Any, NamedTuple

from experiments.errors import ConfigError
from experiments.parts import Part, all_parts, is_finished
from experiments.sweeps.axes import Axes, setting_name, settings
from experiments.sweeps.schedule import Job

UNCHANGED = "unchanged"  # folder of the config as it is, beside those of changes
SCRIPT = ("-m", "experiments.active_selection")


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


def num_steps(trial: Trial) -> int:
    """Optimiser steps of a trial from its beginning, round 0 not counted where it is shared."""
    config = trial.setting.config
    return config.train.num_steps * (config.num_rounds if trial.part.policy else 1)
