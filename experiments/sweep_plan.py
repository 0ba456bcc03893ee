"""What a sweep is made of: axes, a folder for each setting, a job for each part, `sweep.json`."""

import ast
import copy
import dataclasses
import functools
import itertools
import math
import operator
import pathlib
import re
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from experiments.files import Part, all_parts, is_finished, leaves, read_versioned, write_json
from experiments.jobs import Job
from experiments.runtime import ConfigError, WorkdirError, shown

MAX_TRIALS = 10_000  # policies x seeds x settings of a sweep
MAX_TEXT = 100_000  # characters of an axis
UNCHANGED = "unchanged"  # folder of the config as it is, beside those of changes
SCRIPT = ("-m", "experiments.active_selection")
SCHEMA_VERSION = 1
FILE = "sweep.json"

# --- axes ------------------------------------------------------------------------------------


class Axes(NamedTuple):
    """What a sweep varies: each policy with each seed in each setting of options."""

    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: list[dict[str, Any]]  # values by the option's name


def parse_axes(texts: Sequence[str], config, changes: Sequence[str] = ()) -> Axes:
    """Reads `name=value,value` of each axis; policies and seeds not named are the config's.

    Args:
      texts: one for each axis. Values of type int may be a range, `first:end` or
        `first:end:step` without the end. Commas inside brackets belong to a value. Options that
        change together are one axis: `config.num_rounds+config.batch_size=4+4,1+16`.
      config: tells which options there are, and of what type.
      changes: options in the same form, of which each value is tried alone, not in every
        combination with the others.

    Raises:
      ConfigError: an axis that is unknown, given twice or empty, a value of another type, or more
        than `MAX_TRIALS` in all.
    """
    known = {f"config.{name}": _example(config, name) for name in leaves(config)}
    own: dict[str, tuple] = {"policy": tuple(config.policies), "seed": tuple(config.seeds)}
    options, alone, seen = [], [], []
    for flag, text in [("axis", t) for t in texts] + [("change", t) for t in changes]:
        try:
            names, rows = _parse(text, known)
            seen += names
            if len({*seen}) < len(seen):
                raise ConfigError(f"{'+'.join(names)} is given twice")
            if names[0] in own and flag == "change":
                raise ConfigError(f"{names[0]} is an axis: --axis={text}")
        except ConfigError as error:
            given = text if len(text) <= 200 else shown(text)
            raise ConfigError(f"--{flag}={given}: {error}") from None
        if names[0] in own:
            own[names[0]] = tuple(row[0] for row in rows)
        else:
            fields = [name.removeprefix("config.") for name in names]
            values = [dict(zip(fields, row)) for row in rows]
            if flag == "axis":
                options.append(values)
            else:
                alone += values
    policies, seeds = own["policy"], own["seed"]
    counts = [len(policies), len(seeds), 1 + len(alone), *map(len, options)]
    if math.prod(counts) > MAX_TRIALS:
        raise ConfigError(
            f"--axis: {' x '.join(map(str, counts))} are {math.prod(counts):,} trials; "
            f"give axes of at most {MAX_TRIALS:,} in all"
        )
    # Every combination, as it is and then with one change at a time.
    rows = itertools.product(*options, [{}, *alone])
    settings = [{name: v for part in row for name, v in part.items()} for row in rows]
    return Axes(policies, seeds, settings)


def _example(config, name: str):
    """The value of an option, or where that is None another of its type."""
    *groups, last = name.split(".")
    group = functools.reduce(operator.getitem, groups, config)
    return group.get_type(last)() if group[last] is None else group[last]


def _parse(text: str, known: dict[str, Any]) -> tuple[list[str], list[tuple]]:
    """Names of an axis, and rows with a value of each; `known` are the options and their values."""
    if len(text) > MAX_TEXT:
        raise ConfigError(f"has {len(text):,} characters; give at most {MAX_TEXT:,}")
    name, _, values = text.partition("=")
    if not values:
        raise ConfigError("give name=value,value, such as seed=0:5")
    names = name.split("+")
    if len(names) == 1:  # a value's type is that of the example
        known = known | {"policy": "", "seed": 0}
    for name in names:
        if name in ("config.policies", "config.seeds"):
            raise ConfigError("sweep over policy=... or seed=... instead")
        if name not in known:
            raise ConfigError(
                f"no axis {name}; use policy, seed or config.NAME with an option of "
                "experiments/configs/base.py that is no group of options"
            )
    rows: list[tuple] = []
    for item in _items(values):
        parts = item.split("+") if len(names) > 1 else [item]
        if len(parts) != len(names):
            raise ConfigError(f"{item!r} is not {len(names)} values")
        if type(known[names[0]]) is int and re.fullmatch(r"-?\d{1,18}(:-?\d{1,18}){1,2}", item):
            first, end, *step = map(int, item.split(":"))
            if step == [0]:
                raise ConfigError(f"{item!r} has a step of 0")
            rows += [(i,) for i in range(first, end, *step)[: MAX_TRIALS + 1]]
        else:
            rows.append(tuple(_value(part, known[n]) for part, n in zip(parts, names)))
        if len(rows) > MAX_TRIALS:
            raise ConfigError(f"has more than {MAX_TRIALS:,} values; give fewer")
    if not rows or len({*rows}) < len(rows):
        raise ConfigError("has no value, or one of them twice")
    return names, rows


def _items(text: str) -> list[str]:
    """What stands between commas that are not in brackets."""
    items, depth = [""], 0
    for letter in text:
        depth += (letter in "([") - (letter in ")]")
        if letter == "," and depth <= 0:
            items.append("")
        else:
            items[-1] += letter
    return items


def _value(text: str, example):
    if isinstance(example, str):
        return text
    try:
        value = ast.literal_eval(text)
        hash(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        value = None  # the last two: too many brackets
    if isinstance(example, float) and type(value) is int:
        value = float(value)
    if type(value) is not type(example):
        raise ConfigError(
            f"{shown(text)} is not of type {type(example).__name__}, as {example!r} is"
        )
    return value


# --- settings and trials ---------------------------------------------------------------------


class Setting(NamedTuple):
    """One combination of options, run as an experiment with a working folder of its own."""

    values: dict[str, Any]  # of the options that the sweep varies
    name: str  # of its folder in the sweep's
    folder: pathlib.Path
    config: Any
    parts: list[Part]


@dataclasses.dataclass(frozen=True)
class Trial(Job):
    """The job that makes one part of one setting."""

    _: dataclasses.KW_ONLY
    setting: Setting
    part: Part


def setting_name(values: dict[str, Any]) -> str:
    """The folder of a setting, such as `uncertainty.log2_cells=5`; `.` where nothing is set."""
    name = ",".join(f"{option}={value}" for option, value in values.items())
    return re.sub(r"[^\w.,=+-]+", "_", name) or "."


def make_settings(config, axes: Axes, workdir: pathlib.Path) -> list[Setting]:
    """The experiments that a sweep is made of; ConfigError if two would share a folder."""
    made: dict[str, Setting] = {}
    parts = all_parts(axes.policies, axes.seeds)
    has_changes = {} in axes.settings and len(axes.settings) > 1
    for values in axes.settings:
        own = copy.deepcopy(config)
        own.policies, own.seeds = axes.policies, axes.seeds
        own.update_from_flattened_dict(values)
        name = UNCHANGED if has_changes and not values else setting_name(values)
        if name in made:
            raise ConfigError(f"--axis: two settings would share the folder {name}; drop one")
        made[name] = Setting(values, name, workdir / name, own, parts)
    return [*made.values()]


def make_trials(setting: Setting, config_flags: list[str], more: Sequence[str] = ()) -> list[Trial]:
    """A trial for each part that is not finished, and for the round 0 that such a part needs.

    `config_flags` are what the user gave of the config, `more` other flags for each trial.
    """
    folder = setting.folder
    left = [part for part in setting.parts if not is_finished(folder, part)]
    wanted = {part.initial for part in left if part.policy}
    own = {"policies": setting.config.policies, "seeds": setting.config.seeds, **setting.values}
    # A tuple that is given twice would be added up.
    kept = [f for f in config_flags if f.partition("=")[0].removeprefix("--config.") not in own]
    shared = (*SCRIPT, *kept, *(option_flag(name, value) for name, value in own.items()))
    return [
        Trial(
            name=f"{folder / part.name}",
            argv=(
                *(*shared, f"--workdir={folder}", f"--part={part.name}"),
                *("--end_with_stdin", *more),
            ),
            log=folder / part.name / "log.txt",
            is_finished=partial(is_finished, folder, part),
            needs=f"{folder / part.initial.name}" if part.policy else None,
            setting=setting,
            part=part,
        )
        for part in left
        if part.policy or part in wanted
    ]


def option_flag(name: str, value) -> str:
    """An option of the config as a flag that means the same."""
    return f"--config.{name}={value if isinstance(value, str) else repr(value)}"


# --- the record ------------------------------------------------------------------------------


@dataclasses.dataclass
class Record:
    """`sweep.json`: what a sweep is made of, and what of it is missing and why."""

    command: str
    settings: list[dict[str, Any]]  # each: folder, values, policies, seeds
    failed: dict[str, str]  # by folder/policy/seed_n: why, and where its log is

    def missing(self, folder: str, results: set[tuple[str, int]]) -> dict[tuple[str, int], str]:
        """Why a setting's runs that have no completed result have none, by policy and seed."""
        setting = next(s for s in self.settings if s["folder"] == folder)
        planned = itertools.product(setting["policies"], setting["seeds"])
        return {
            (policy, seed): self.failed.get(f"{folder}/{policy}/seed_{seed}", "not run yet")
            for policy, seed in planned
            if (policy, seed) not in results
        }


def read_record(workdir: pathlib.Path) -> Record | None:
    """The record of a sweep's folder, None without one; WorkdirError if it cannot be used."""
    path, fix = workdir / FILE, "delete it and run the sweep again"
    if not path.exists():
        return None
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
