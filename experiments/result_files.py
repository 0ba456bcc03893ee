"""What stands on a page about each kind of result file: the tables of every script of ours."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from functools import partial

from experiments.bench import results as bench
from experiments.bench.same_numbers import DEVICE_FILE, differences_table
from experiments.posthoc.tables import TABLES as POSTHOC_TABLES
from experiments.report.collected import Collected, collect_tables
from experiments.report.results import read_result
from experiments.report.tables import Table
from experiments.sweeps.plan import FILE as SWEEP_FILE
from experiments.uncertain import results as uncertain
from experiments.uncertain.tables import coverage_table, summary_table


def _made_by(result: dict, over: str = "means over seeds ± half of the 95 % interval") -> str:
    """The command of a result, the machine, and what its numbers are."""
    return f"`{result['command']}` ({result['device']}; {over})"


def _uncertainty(path: pathlib.Path) -> Collected:
    """How well uncertainty tells error, and how well calibrated intervals hold."""
    result = uncertain.load_result(path.parent)
    rows = result["rows"]
    tables = {"ause": summary_table(rows)}
    for quantity in uncertain.known_quantities(rows):
        tables[f"{quantity}_intervals"] = coverage_table(rows, quantity)
    about = f"Intervals: {uncertain.split_words(result)}. Coverage ± its standard error over the "
    return Collected(_made_by(result), tables, (f"{about}test views.",))


def _posthoc(make_table: Callable[[list[dict]], Table], path: pathlib.Path) -> Collected:
    """What a script on a trained run has measured, over its seeds."""
    result = read_result(path)
    num = len({row["seed"] for row in result["rows"]})
    over = "1 seed" if num == 1 else f"means over {num} seeds ± half of the 95 % interval"
    return Collected(_made_by(result, over), {path.stem: make_table(result["rows"])})


def _device(path: pathlib.Path) -> Collected:
    """How far an accelerator's numbers are from the CPU's."""
    result = read_result(path)
    made = f"`{result['command']}` ({result['device']}; matrix products at "
    made += f"{result['matmul_precision']} precision)"
    return Collected(made, {"differences": differences_table(result["differences"])})


FILES: dict[str, Callable[[pathlib.Path], Collected]] = {
    uncertain.NAME: _uncertainty,
    DEVICE_FILE: _device,
    bench.BENCHMARK: bench.benchmark_tables,
    bench.QUALITY: bench.quality_tables,
    **{name: partial(_posthoc, make) for name, make in POSTHOC_TABLES.items()},
}


def collect_all(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> list[Collected]:
    """The tables of every result file that a folder holds.

    Args:
      folder: of an experiment, a sweep, or any other script.
      paper, only: see `run_tables`.

    Raises:
      ReportError: it holds none, or one that cannot be used.
    """
    found = [make(folder / name) for name, make in FILES.items() if (folder / name).exists()]
    if not found or any((folder / name).exists() for name in ("summary.json", SWEEP_FILE)):
        found.insert(0, collect_tables(folder, paper, only))
    return found
