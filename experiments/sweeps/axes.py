"""What a sweep varies: policies, seeds and options, such as `config.uncertainty.log2_cells=5,6`."""

from __future__ import annotations

import ast
import itertools
import re
from typing import Any, NamedTuple

from experiments.errors import ConfigError

OWN_AXES = {"policies": "policy", "seeds": "seed"}  # options that are axes of their own


class Axes(NamedTuple):
    """The values of every axis."""

    policies: tuple[str, ...]
    seeds: tuple[int, ...]
    options: tuple[tuple[dict[str, Any], ...], ...]  # of each axis, what each of its values sets


def parse_axes(texts: list[str], config) -> Axes:
    """Reads `name=value,value` of each axis; policies and seeds not named are the config's.

    Args:
      texts: one for each axis. Values of type int may be a range, `first:end` or
        `first:end:step` without the end. Commas inside brackets belong to a value. Options that
        change together are one axis: `config.num_rounds+config.batch_size=4+4,1+16`.
      config: tells which options there are, and of what type.

    Raises:
      ConfigError: an axis that is unknown, given twice or empty, or a value of another type.
    """
    found: dict[str, tuple] = {}
    options = []
    seen: list[str] = []
    for text in texts:
        name, equals, values = text.partition("=")
        if not equals or not values:
            raise ConfigError(f"--axis={text}: give name=value,value, such as seed=0:5")
        names = name.split("+")
        if len({*seen, *names}) < len(seen) + len(names):
            raise ConfigError(f"--axis={text}: {name} is given twice")
        seen += names
        examples = [_example(n, text, config, alone=len(names) == 1) for n in names]
        if name in OWN_AXES.values():
            found[name] = _values(name, values, examples[0])
        else:
            options.append(_option_values(names, values, examples))
    return Axes(
        policies=found.get("policy", tuple(config.policies)),
        seeds=found.get("seed", tuple(config.seeds)),
        options=tuple(options),
    )


def settings(axes: Axes) -> list[dict[str, Any]]:
    """Every combination of the options' values; one that is empty where there are no options."""
    rows = itertools.product(*axes.options)
    return [{name: v for part in row for name, v in part.items()} for row in rows]


def setting_name(values: dict[str, Any]) -> str:
    """The folder of a setting, such as `uncertainty.log2_cells=5`; `.` where nothing is set."""
    name = ",".join(f"{option}={value}" for option, value in values.items())
    return re.sub(r"[^\w.,=+-]+", "_", name) or "."


def _example(name: str, text: str, config, *, alone: bool):
    """A value of the axis, for its type."""
    if name in OWN_AXES.values() and alone:
        return "" if name == "policy" else 0
    option = name.removeprefix("config.")
    if option in OWN_AXES:
        raise ConfigError(f"--axis={text}: sweep over {OWN_AXES[option]}=... instead")
    known = config.to_dict()
    for key in option.split("."):
        if option == name or not isinstance(known, dict) or key not in known:
            raise ConfigError(
                f"--axis={text}: no axis {name}; use policy, seed or config.NAME with an option "
                "of experiments/configs/base.py"
            )
        known = known[key]
    if isinstance(known, dict):
        raise ConfigError(f"--axis={text}: {option} is a group of options; name one of {(*known,)}")
    return known


def _option_values(names: list[str], text: str, examples: list) -> tuple[dict[str, Any], ...]:
    """What each value of an axis sets: one option, or several at once."""
    options = [name.removeprefix("config.") for name in names]
    if len(names) == 1:
        return tuple({options[0]: value} for value in _values(names[0], text, examples[0]))
    rows = [item.split("+") for item in _items(text)]
    for row in rows:
        if len(row) != len(names):
            raise ConfigError(
                f"--axis={'+'.join(names)}: {'+'.join(row)!r} is not {len(names)} values"
            )
    return tuple(
        {o: _value(n, v, e) for o, n, v, e in zip(options, names, row, examples)} for row in rows
    )


def _values(name: str, text: str, example) -> tuple:
    values = []
    for item in _items(text):
        is_range = type(example) is int and re.fullmatch(r"-?\d+(:-?\d+){1,2}", item)
        values += range(*map(int, item.split(":"))) if is_range else [_value(name, item, example)]
    if not values or len(set(values)) < len(values):
        raise ConfigError(f"--axis={name}={text}: has no value, or one of them twice")
    return tuple(values)


def _items(text: str) -> list[str]:
    """What stands between commas that are not in brackets."""
    return re.split(r",(?![^(\[]*[)\]])", text)


def _value(name: str, text: str, example):
    if isinstance(example, str):
        return text
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = None
    if isinstance(example, float) and type(value) is int:
        value = float(value)
    if type(value) is not type(example):
        raise ConfigError(
            f"--axis={name}: {text!r} is not of type {type(example).__name__}, as {example!r} is"
        )
    return value
