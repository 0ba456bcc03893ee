"""A sweep over options as one table: each setting against random choice and against another."""

from __future__ import annotations

import dataclasses
from typing import Any

from experiments.report import stats
from experiments.report.results import Run
from experiments.report.tables import Cell, Table, dash, interval_cell, missing_measure

REFERENCE = "random"
SCENE_OPTIONS = ("loader", "data_dir", "scene")  # PSNRs of two scenes are no gap


@dataclasses.dataclass(frozen=True)
class Setting:
    """The runs of one combination of options."""

    name: str
    values: dict[str, Any]
    policies: list[str]
    runs: list[Run]  # empty where there is no result yet


def settings_table(settings: list[Setting], *, compared: bool = True) -> Table:
    """Means over seeds at the end of each setting, with gaps paired by seed.

    Options that every setting sets have a column each; where settings differ in what they set, as
    with one change at a time, their names are the first column.

    Args:
      settings: at least one.
      compared: whether there is a column of gaps between settings, see `_references`.
    """
    options = [*settings[0].values] if len({(*s.values,) for s in settings}) == 1 else []
    references = _references(settings, options)
    compared = compared and any(first is not None for first, _ in references.values())
    measures = [m for m in stats.MEASURES if any(_has(s.runs, m.key) for s in settings)]
    to_random = any(REFERENCE in s.policies and len(s.policies) > 1 for s in settings)
    head = [*(options or ["setting"]), "policy", "seeds", "views"]
    head += [f"{m.label} ({m.unit})" if m.unit else m.label for m in measures]
    head += [f"PSNR gap to {REFERENCE} (dB)"] * to_random
    words = {words for first, words in references.values() if first is not None}
    other = words.pop() if len(words) == 1 else "the first of its kind"
    head += [f"PSNR gap to {other} (dB)"] * compared
    rows = []
    for setting in settings:
        fixed = [Cell(str(setting.values[o])) for o in options] or [Cell(setting.name)]
        for policy in setting.policies:
            cells = _row(setting, policy, measures)
            if to_random:
                cells.append(_reference_gap(setting, policy))
            if compared:
                cells.append(_setting_gap(setting, references[setting.name][0], policy))
            rows.append((*fixed, Cell(policy), *cells))
    return Table(tuple(head), tuple(rows))


def _references(
    settings: list[Setting], options: list[str]
) -> dict[str, tuple[Setting | None, str]]:
    """What each setting is compared with, by name, and in which options that one differs.

    The first setting that has the most of the leading options in common with it: in a sweep over
    views and steps, that of as many views. None where there is no other of the same scene. Where
    settings differ in what they set, all are compared with the very first.
    """
    if not options:
        return {s.name: (settings[0], settings[0].name) for s in settings}
    found = {}
    for setting in settings:
        for depth in range(len(options) - 1, -1, -1):
            shared = (*options[:depth], *(o for o in SCENE_OPTIONS if o in options))
            alike = [s for s in settings if all(s.values[o] == setting.values[o] for o in shared)]
            if len(alike) > 1:
                first = alike[0]
                words = ",".join(f"{o}={first.values[o]}" for o in options if o not in shared)
                found[setting.name] = first, words
                break
        else:
            found[setting.name] = None, ""
    return found


def _row(setting: Setting, policy: str, measures) -> list[Cell]:
    mine = stats.completed(setting.runs, policy)
    num_views = stats.common_num_views(setting.runs)
    seeds = Cell(str(len(mine)))
    if not mine:
        return [seeds, *[dash(_no_run(setting, policy))] * (len(measures) + 1)]
    cells = [seeds, Cell(str(num_views)) if num_views is not None else dash("no shared number")]
    for measure in measures:
        interval = stats.over_seeds(setting.runs, policy, measure.key, num_views)
        cells.append(interval_cell(interval, measure.digits, missing_measure(measure, mine)))
    return cells


def _no_run(setting: Setting, policy: str) -> str:
    return f"{setting.name}, {policy}: no completed run"


def _reference_gap(setting: Setting, policy: str) -> Cell:
    if not stats.completed(setting.runs, policy):
        return dash(_no_run(setting, policy))
    if policy == REFERENCE:
        return dash("a policy has no gap to itself")
    num_views = stats.common_num_views(setting.runs)
    pair = stats.compare(setting.runs, policy, REFERENCE, "psnr", num_views)
    why = f"{setting.name}: {policy} and {REFERENCE} share no seed"
    return interval_cell(pair.gap if pair else None, 2, why, gap=True)


def _setting_gap(setting: Setting, first: Setting | None, policy: str) -> Cell:
    """Each at its own last number of views: an option may change how many there are."""
    if not stats.completed(setting.runs, policy):
        return dash(_no_run(setting, policy))
    if first is None:
        return dash(f"{setting.name}: no other setting of this scene")
    if setting is first:
        return dash("a setting has no gap to itself")
    ours, theirs = (
        _by_seed(one.runs, policy, stats.common_num_views(one.runs)) for one in (setting, first)
    )
    gaps = [value - theirs[seed] for seed, value in ours.items() if seed in theirs]
    why = f"{policy}: {setting.name} and {first.name} share no seed"
    return interval_cell(stats.mean_interval(gaps), 2, why, gap=True)


def _by_seed(runs: list[Run], policy: str, num_views) -> dict[int, float]:
    values = {r.seed: r.value("psnr", num_views) for r in stats.completed(runs, policy)}
    return {seed: value for seed, value in values.items() if value is not None}


def _has(runs: list[Run], measure: str) -> bool:
    return any(r.get(measure) is not None for run in runs for r in run.rounds)
