"""All that the result files of a folder say, as named tables."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence

from experiments.report.formats import FORMATS, latex_text
from experiments.report.paper_table import paper_table
from experiments.report.results import ReportError, Run, load_runs, load_runs_of
from experiments.report.settings_table import Setting, settings_table
from experiments.report.stats import mean_runs
from experiments.report.tables import (
    Table,
    baseline_table,
    final_table,
    rounds_table,
    timing_table,
)
from experiments.sweeps.plan import FILE as SWEEP_FILE
from experiments.sweeps.plan import Record, read_record

RUN_TABLES = {
    "quality": final_table,
    "rounds": rounds_table,
    "baselines": baseline_table,
    "time": timing_table,
}


@dataclasses.dataclass(frozen=True)
class Collected:
    """What stands above the tables, the tables by name, and what stands below."""

    made: str  # by which command, on what
    tables: dict[str, Table]
    notes: tuple[str, ...] = ()  # what is missing, and why


# What is no table, as a line of each format.
AS_TEXT = {"markdown": str, "csv": lambda text: f"# {text}", "latex": lambda text: f"% {text}"}


def collected_text(
    found: Collected, *, form: str = "markdown", names: list[str] | None = None
) -> str:
    """What was made, the tables and the notes.

    Args:
      found: what to show.
      form: a key of `FORMATS`.
      names: of the tables, those that there are; None: all.
    """
    as_text = AS_TEXT[form]
    blocks = [as_text(found.made)]
    for name in [name for name in names or found.tables if name in found.tables]:
        title = [] if form == "markdown" else [as_text(name)]
        blocks.append("\n".join([*title, FORMATS[form](found.tables[name])]))
    blocks += [latex_text(n) if form == "latex" else as_text(n) for n in found.notes]
    return "\n\n".join(blocks) + "\n"


def run_tables(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """Quality at the last shared number of views, round by round, and where the time went.

    Args:
      folder: of one experiment, with its `summary.json`.
      paper: a table of the paper whose rows are put beside ours; see `printed.TABLES`.
      only: policies to show, in this order; by default all.

    Raises:
      ReportError: a file that cannot be used, or one of `only` without a run.
    """
    runs, record = load_runs_of(folder, only), read_record(folder)
    policies = list(dict.fromkeys(run.policy for run in runs))
    notes: tuple[str, ...] = ()
    if record is not None:
        planned = _setting_row(record, ".")["policies"]
        policies = list(dict.fromkeys([*policies, *(p for p in planned if not only or p in only)]))
        notes = _missing_notes(record, {".": runs}, only)
    if not runs:
        raise ReportError(f"{folder / 'summary.json'}: holds no run; wait for the first to end")
    tables = _made_tables(runs, policies, paper)
    return Collected(_made_words(record, runs), tables, notes)


def sweep_tables(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """The settings of a sweep against each other; of a sweep over scenes also their mean.

    Args:
      folder: of the sweep.
      paper, only: see `run_tables`; the paper's rows stand beside means over scenes.

    Raises:
      ReportError: a file that cannot be used, no result so far, or no scenes for `paper`.
    """
    record = read_record(folder)
    settings = [_setting(folder, row, only) for row in record.settings]
    runs = {setting.name: setting.runs for setting in settings}
    done = [run for some in runs.values() for run in some]
    if not done:
        raise ReportError(f"{folder / SWEEP_FILE}: no trial has a result so far")
    over_scenes = all(setting.values.keys() == {"scene"} for setting in settings)
    tables = {"settings": settings_table(settings, compared=not over_scenes)}
    notes = _missing_notes(record, runs, only)
    if over_scenes:
        policies = list(dict.fromkeys(p for setting in settings for p in setting.policies))
        means = mean_runs([*runs.values()])
        tables |= _made_tables(means, policies, paper) if means else {}
        notes = (f"Tables after the first are of means over these {len(settings)} scenes.", *notes)
    elif paper is not None:
        raise ReportError(f"{folder}: {paper} is over scenes; give the folder of one setting")
    return Collected(_made_words(record, done), tables, notes)


def collect_tables(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """The tables of whatever a folder holds: of a sweep over options, or of one experiment."""
    record = read_record(folder)
    if record is not None and any(row["values"] for row in record.settings):
        return sweep_tables(folder, paper, only)
    return run_tables(folder, paper, only)


def _made_tables(runs: list[Run], policies: list[str], paper: str | None) -> dict[str, Table]:
    made = {name: make(runs, policies) for name, make in RUN_TABLES.items()}
    if paper is not None:
        made["paper"] = paper_table(runs, policies, paper)
    return {name: table for name, table in made.items() if table is not None}


def _setting(folder: pathlib.Path, row: dict, only: Sequence[str]) -> Setting:
    """What there is so far of a setting, of the policies that are shown."""
    path = folder / row["folder"]
    runs = load_runs(path) if (path / "summary.json").exists() else []
    policies = [p for p in only or row["policies"] if p in row["policies"]]
    shown = [run for run in runs if run.policy in policies]
    return Setting(row["folder"], row["values"], policies, shown)


def _setting_row(record: Record, folder: str) -> dict:
    return next(row for row in record.settings if row["folder"] == folder)


def _made_words(record: Record | None, runs: list[Run]) -> str:
    commands = list(dict.fromkeys(run.result["command"] for run in runs))
    command = common_command(commands) if record is None else record.command
    later = dict.fromkeys(run.result.get("remeasured_by") for run in runs)
    command = "`, then `".join([command, *filter(None, later)])
    devices = ", ".join(dict.fromkeys(run.result["device"] for run in runs))
    return f"`{command}` ({devices}; means over seeds ± half of the 95 % interval)"


def common_command(commands: list[str]) -> str:
    """What all commands share: runs that were made in parts are those of one command."""
    words = [command.split() for command in commands]
    return " ".join(word for word in words[0] if all(word in others for others in words))


def _missing_notes(
    record: Record, runs: dict[str, list[Run]], only: Sequence[str] = ()
) -> tuple[str, ...]:
    """Every run that was planned, of a policy that is shown, and has no result."""
    notes = []
    for folder, some in runs.items():
        done = {(run.policy, run.seed) for run in some if run.completed}
        where = "" if folder == "." else f"{folder}, "
        notes += [
            f"Missing: {where}{policy}, seed {seed}: {why}."
            for (policy, seed), why in record.missing(folder, done).items()
            if policy in (only or (policy,))
        ]
    return tuple(notes)
