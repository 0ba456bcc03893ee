"""What a sweep varies: policies, seeds and options, such as `config.uncertainty.log2_cells=5,6`."""

from __future__ import annotations

import ast
import itertools
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from experiments.errors import ConfigError, shown

OWN_AXES = {"policies": "policy", "seeds": "seed"}  # options that are axes of their own
MAX_TRIALS = 10_000  # policies x seeds x settings of a sweep
MAX_TEXT = 100_000  # characters of an axis


class Axes(NamedTuple):
    """The values of every axis."""

    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    options: tuple[tuple[dict[str, Any], ...], ...]  # of each axis, what each of its values sets
    changes: tuple[dict[str, Any], ...] = ()  # made one at a time, beside no change


def parse_axes(texts: list[str], config, changes: Sequence[str] = ()) -> Axes:
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
    own: dict[str, tuple] = {}
    options, alone, seen = [], [], []
    for flag, text in [("axis", t) for t in texts] + [("change", t) for t in changes]:
        try:
            names, rows = _parse(text, config)
            if len({*seen, *names}) < len(seen) + len(names):
                raise ConfigError(f"{'+'.join(names)} is given twice")
            seen += names
            if names[0] not in OWN_AXES.values():
                fields = [name.removeprefix("config.") for name in names]
                values = tuple(dict(zip(fields, row)) for row in rows)
                (options if flag == "axis" else alone).append(values)
            elif flag == "axis":
                own[names[0]] = tuple(value for (value,) in rows)
            else:
                raise ConfigError(f"{names[0]} is an axis: --axis={text}")
        except ConfigError as error:
            given = text if len(text) <= 200 else shown(text)
            raise ConfigError(f"--{flag}={given}: {error}") from None
    axes = Axes(
        policies=own.get("policy", tuple(config.policies)),
        seeds=own.get("seed", tuple(config.seeds)),
        options=tuple(options),
        changes=tuple(itertools.chain(*alone)),
    )
    counts = [len(axes.policies), len(axes.seeds), 1 + len(axes.changes), *map(len, axes.options)]
    if math.prod(counts) > MAX_TRIALS:
        raise ConfigError(
            f"--axis: {' x '.join(map(str, counts))} are {math.prod(counts):,} trials; "
            f"give axes of at most {MAX_TRIALS:,} in all"
        )
    return axes


def settings(axes: Axes) -> list[dict[str, Any]]:
    """Every combination of the axes' values, as it is and then with one change at a time."""
    rows = itertools.product(*axes.options, ({}, *axes.changes))
    return [{name: v for part in row for name, v in part.items()} for row in rows]


def setting_name(values: dict[str, Any]) -> str:
    """The folder of a setting, such as `uncertainty.log2_cells=5`; `.` where nothing is set."""
    name = ",".join(f"{option}={value}" for option, value in values.items())
    return re.sub(r"[^\w.,=+-]+", "_", name) or "."


def _example(name: str, config, *, alone: bool):
    """A value of the axis, for its type."""
    if name in OWN_AXES.values() and alone:
        return "" if name == "policy" else 0
    option = name.removeprefix("config.")
    if option in OWN_AXES:
        raise ConfigError(f"sweep over {OWN_AXES[option]}=... instead")
    known = config.to_dict()
    for key in option.split("."):
        if option == name or not isinstance(known, dict) or key not in known:
            raise ConfigError(
                f"no axis {name}; use policy, seed or config.NAME with an option "
                "of experiments/configs/base.py"
            )
        known = known[key]
    if isinstance(known, dict):
        raise ConfigError(f"{option} is a group of options; name one of {(*known,)}")
    return known


def _parse(text: str, config) -> tuple[list[str], list[tuple]]:
    """Names of an axis, and rows with a value of each."""
    if len(text) > MAX_TEXT:
        raise ConfigError(f"has {len(text):,} characters; give at most {MAX_TEXT:,}")
    name, _, values = text.partition("=")
    if not values:
        raise ConfigError("give name=value,value, such as seed=0:5")
    names = name.split("+")
    examples = [_example(n, config, alone=len(names) == 1) for n in names]
    if len(names) == 1:
        return names, [(value,) for value in _values(values, examples[0])]
    rows = [item.split("+") for item in _items(values)]
    for row in rows:
        if len(row) != len(names):
            raise ConfigError(f"{'+'.join(row)!r} is not {len(names)} values")
    return names, [tuple(map(_value, row, examples)) for row in rows]


def _values(text: str, example) -> tuple:
    values = []
    for item in _items(text):
        is_range = type(example) is int and re.fullmatch(r"-?\d{1,18}(:-?\d{1,18}){1,2}", item)
        values += _range(item) if is_range else [_value(item, example)]
        if len(values) > MAX_TRIALS:
            raise ConfigError(f"has more than {MAX_TRIALS:,} values; give fewer")
    if not values or len(set(values)) < len(values):
        raise ConfigError("has no value, or one of them twice")
    return tuple(values)


def _range(item: str) -> range:
    """`first:end` or `first:end:step`, not yet as values: there may be far too many."""
    numbers = [*map(int, item.split(":"))]
    if numbers[2:] == [0]:
        raise ConfigError(f"{item!r} has a step of 0")
    values = range(*numbers)
    if len(values) > MAX_TRIALS:
        raise ConfigError(f"{item!r} has more than {MAX_TRIALS:,} values; give fewer")
    return values


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
