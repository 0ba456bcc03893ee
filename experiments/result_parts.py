"""What stands on a page about each kind of result file: words and tables, in order."""

from __future__ import annotations

import json
import pathlib
from functools import partial

from experiments.bench import results as bench
from experiments.posthoc.tables import TABLES as POSTHOC_TABLES
from experiments.predicted.results import RESULT_FILE as GAIN_FILE
from experiments.predicted.results import correlation_table, stop_table
from experiments.report import ReportError
from experiments.report import tables as run_tables
from experiments.report.results import load_runs
from experiments.report.tables import Table
from experiments.uncertain import results as uncertain
from experiments.uncertain.tables import coverage_table, summary_table

Part = str | Table


def made_by(result: dict, over: str = "means over seeds ± half of the 95 % interval") -> str:
    """The command of a result, the machine, and what its numbers are."""
    return f"`{result['command']}` ({result['device']}; {over})"


def run_parts(path: pathlib.Path) -> list[Part]:
    """Quality at the last shared number of views, and where the time went."""
    runs = load_runs(path.parent)
    policies = list(dict.fromkeys(run.policy for run in runs))
    makers = (
        run_tables.final_table,
        run_tables.rounds_table,
        run_tables.baseline_table,
        run_tables.timing_table,
    )
    tables = [table for make in makers if (table := make(runs, policies)) is not None]
    commands = list(dict.fromkeys(run.result["command"] for run in runs))
    return [made_by(runs[0].result | {"command": common_command(commands)}), *tables]


def common_command(commands: list[str]) -> str:
    """What all commands share: runs that were made in parts are those of one command."""
    words = [command.split() for command in commands]
    return " ".join(word for word in words[0] if all(word in others for others in words))


def uncertainty_parts(path: pathlib.Path) -> list[Part]:
    """How well uncertainty tells error, and how well calibrated intervals hold."""
    result = uncertain.load_result(path.parent)
    rows = result["rows"]
    quantities = uncertain.known_quantities(rows)
    return [
        made_by(result),
        summary_table(rows),
        f"Intervals: {uncertain.split_words(result)}. Coverage ± its standard error over the test "
        "views.",
        *(coverage_table(rows, quantity) for quantity in quantities),
    ]


def posthoc_parts(make_table, path: pathlib.Path) -> list[Part]:
    """What a script on a trained run has measured, over its seeds."""
    result = json.loads(path.read_text(encoding="utf-8"))
    num = len({row["seed"] for row in result["rows"]})
    over = "1 seed" if num == 1 else f"means over {num} seeds ± half of the 95 % interval"
    return [made_by(result, over), make_table(result["rows"])]


def gain_parts(path: pathlib.Path) -> list[Part]:
    """How well predicted gains tell realised ones, and the stop rule tried on left-out seeds."""
    result = json.loads(path.read_text(encoding="utf-8"))
    made = "; ".join(f"`{command}`" for command in result["commands"])
    tables = [correlation_table(result), stop_table(result, "seed")]
    return [f"{made}: {len(result['cases'])} batches", *tables]


PARTS = {
    "summary.json": run_parts,
    uncertain.NAME: uncertainty_parts,
    GAIN_FILE: gain_parts,
    bench.BENCHMARK: bench.benchmark_parts,
    bench.QUALITY: bench.quality_parts,
    **{name: partial(posthoc_parts, make) for name, make in POSTHOC_TABLES.items()},
}


def result_parts(folder: pathlib.Path) -> list[Part]:
    """Words and tables about the result files that a folder holds.

    Raises:
      ReportError: it holds none, or one that cannot be used.
    """
    found = [make(folder / name) for name, make in PARTS.items() if (folder / name).exists()]
    if found:
        return [part for parts in found for part in parts]
    raise ReportError(
        f"{folder}: holds none of {', '.join(PARTS)}; give the --workdir of an experiment"
    )
