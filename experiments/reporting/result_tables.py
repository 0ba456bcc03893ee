"""All that the result files of a folder say, whichever script wrote them, as named tables."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from functools import partial

from experiments.bench import results as bench
from experiments.bench.same_numbers import DEVICE_FILE, differences_table
from experiments.reporting import stats, uncertainty_tables
from experiments.reporting.results import Run, load_runs, policies_of, read_result
from experiments.reporting.run_tables import (
    Setting,
    baseline_table,
    final_table,
    paper_table,
    rounds_table,
    settings_table,
    timing_table,
)
from experiments.reporting.tables import Cell, Collected, Table, interval_cell
from experiments.runtime import ReportError
from experiments.sweeps.plan import FILE as SWEEP_FILE
from experiments.sweeps.plan import Record, read_record

INTERVALS = "means over seeds ± half of the 95 % interval"


def collect_all(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> list[Collected]:
    """The tables of every result file that a folder holds.

    Args:
      folder: of an experiment, a sweep, or any other script.
      paper, only: see `experiment_tables`.

    Raises:
      ReportError: it holds none, or one that cannot be used.
    """
    found = [make(folder / name) for name, make in FILES.items() if (folder / name).exists()]
    if not found or any((folder / name).exists() for name in ("summary.json", SWEEP_FILE)):
        found.insert(0, collect_tables(folder, paper, only))
    return found


# --- of experiments and sweeps ---


def collect_tables(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """The tables of a sweep over options, or of one experiment."""
    record = read_record(folder)
    if record is not None and any(row["values"] for row in record.settings):
        return sweep_tables(folder, record, paper, only)
    return experiment_tables(folder, record, paper, only)


def experiment_tables(
    folder: pathlib.Path,
    record: Record | None = None,
    paper: str | None = None,
    only: Sequence[str] = (),
) -> Collected:
    """Quality at the last shared number of views, round by round, and where the time went.

    Args:
      folder: of one experiment, with its `summary.json`.
      record: what was planned, if it was a sweep over seeds.
      paper: a table of the paper whose rows are put beside ours; see `run_tables.PAPER`.
      only: policies to show, in this order; by default all.

    Raises:
      ReportError: a file that cannot be used, or one of `only` without a run.
    """
    runs = load_runs(folder, only)
    policies, notes = policies_of(runs), ()
    if record is not None:
        planned = next(row["policies"] for row in record.settings if row["folder"] == ".")
        policies += [p for p in planned if p not in policies and (not only or p in only)]
        notes = _missing_notes(record, {".": runs}, only)
    if not runs:
        raise ReportError(f"{folder / 'summary.json'}: holds no run; wait for the first to end")
    return Collected(_made_words(record, runs), _quality(runs, policies, paper), notes)


def sweep_tables(
    folder: pathlib.Path, record: Record, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """The settings of a sweep against each other; of a sweep over scenes also their mean.

    Args:
      folder: of the sweep.
      record: of the sweep.
      paper, only: see `experiment_tables`; the paper's rows stand beside means over scenes.

    Raises:
      ReportError: a file that cannot be used, no result so far, or no scenes for `paper`.
    """
    settings = []
    for row in record.settings:
        path = folder / row["folder"]
        policies = [p for p in only or row["policies"] if p in row["policies"]]
        runs = load_runs(path) if (path / "summary.json").exists() else []
        runs = [run for run in runs if run.policy in policies]
        settings.append(Setting(row["folder"], row["values"], policies, runs))
    runs = {setting.name: setting.runs for setting in settings}
    done = [run for some in runs.values() for run in some]
    if not done:
        raise ReportError(f"{folder / SWEEP_FILE}: no trial has a result so far")
    over_scenes = all(setting.values.keys() == {"scene"} for setting in settings)
    tables = {"settings": settings_table(settings, compared=not over_scenes)}
    notes = _missing_notes(record, runs, only)
    if over_scenes:
        policies = list(dict.fromkeys(p for setting in settings for p in setting.policies))
        means = stats.mean_runs([*runs.values()])
        tables |= _quality(means, policies, paper) if means else {}
        notes = (f"Tables after the first are of means over these {len(settings)} scenes.", *notes)
    elif paper is not None:
        raise ReportError(f"{folder}: {paper} is over scenes; give the folder of one setting")
    return Collected(_made_words(record, done), tables, notes)


def _quality(runs: list[Run], policies: list[str], paper: str | None) -> dict[str, Table]:
    tables = {
        "quality": final_table(runs, policies),
        "rounds": rounds_table(runs, policies),
        "baselines": baseline_table(runs, policies),
        "time": timing_table(runs, policies),
        "paper": paper_table(runs, policies, paper) if paper is not None else None,
    }
    return {name: table for name, table in tables.items() if table is not None}


def _made_words(record: Record | None, runs: list[Run]) -> str:
    """Commands and devices; runs that were made in parts have what all their commands share."""
    first, *others = dict.fromkeys(run.result["command"] for run in runs)
    command = " ".join(word for word in first.split() if all(word in o.split() for o in others))
    command = command if record is None else record.command
    later = dict.fromkeys(run.result.get("remeasured_by") for run in runs)
    command = "`, then `".join([command, *filter(None, later)])
    devices = ", ".join(dict.fromkeys(run.result["device"] for run in runs))
    return f"`{command}` ({devices}; {INTERVALS})"


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


# --- of other scripts ---


def _uncertainty(path: pathlib.Path) -> Collected:
    """How well uncertainty tells error, and how well calibrated intervals hold."""
    result = uncertainty_tables.load_result(path.parent)
    rows = result["rows"]
    tables = {"ause": uncertainty_tables.summary_table(rows)}
    for quantity in uncertainty_tables.known_quantities(rows):
        tables[f"{quantity}_intervals"] = uncertainty_tables.coverage_table(rows, quantity)
    split = uncertainty_tables.split_words(result)
    note = f"Intervals: {split}. Coverage ± its standard error over the test views."
    return Collected(f"`{result['command']}` ({result['device']}; {INTERVALS})", tables, (note,))


def _device(path: pathlib.Path) -> Collected:
    """How far an accelerator's numbers are from the CPU's."""
    result = read_result(path)
    how = f"{result['device']}; matrix products at {result['matmul_precision']} precision"
    tables = {"differences": differences_table(result["differences"])}
    return Collected(f"`{result['command']}` ({how})", tables)


def _trained(make_table: Callable[[list[dict]], Table], path: pathlib.Path) -> Collected:
    """What a script on a trained run has measured, over its seeds."""
    result = read_result(path)
    num = len({row["seed"] for row in result["rows"]})
    over = "1 seed" if num == 1 else INTERVALS.replace("over", f"over {num}")
    made = f"`{result['command']}` ({result['device']}; {over})"
    return Collected(made, {path.stem: make_table(result["rows"])})


def cleanup_table(rows: list[dict]) -> Table:
    """Test views before and after the clean-up, and the change, seed by seed."""
    head = ("", "PSNR over pixels still covered (dB)", "PSNR over all pixels (dB)")
    head += ("matter covered (%)", "empty pixels covered (%)", "content of training views kept (%)")

    def numbers(when: str, row: dict) -> list[float | None]:
        test, train = row[when]["test"], row[when]["training"]
        # Before and after are held against each other over the same pixels.
        after = row["after"]["test"]
        covered = after["psnr_covered_before" if when == "before" else "psnr_covered"]
        shares = (test["share_covered"], test["share_floating"], train["content_kept"])
        return [covered, test["psnr"], *(None if x is None else 100.0 * x for x in shares)]

    before, after = ([numbers(when, row) for row in rows] for when in ("before", "after"))
    change = [
        [None if None in pair else pair[0] - pair[1] for pair in zip(*numbers)]
        for numbers in zip(after, before)
    ]
    lines = (_line("before", before, 2), _line("after", after, 2))
    return Table(head, (*lines, _line("change", change, 2, gap=True)))


SPLITS = {  # of `draws.json`
    "training": "training views",
    "test": "test views",
    "farthest": "the test view farthest from all training views",
}


def draws_table(rows: list[dict]) -> Table:
    """How far pixels move over draws, in training views and in test views."""
    head = ("", "colours move by, pixels with matter", "all pixels", "rank correlation")
    names = ("spread", "spread_all", "rank_correlation")
    lines = [
        _line(words, [[row[split][name] for name in names] for row in rows], 4)
        for split, words in SPLITS.items()
    ]
    return Table(head, tuple(lines))


def geometry_table(rows: list[dict]) -> Table:
    """Distances of a mesh from the true surface, and the floor that the number of points sets."""
    names = ("chamfer", "accuracy", "completeness", "f_score")
    parts = {
        "seen": "what views see",
        "whole": "whole surface",
        "floor": "floor: two draws of the true surface",
    }
    head = ("", "Chamfer (scene units)", "mesh to truth", "truth to mesh")
    lines = [
        _line(words, [[row[part][name] for name in names] for row in rows], 4)
        for part, words in parts.items()
        if all(row[part] is not None for row in rows)
    ]
    return Table((*head, f"F-score at {rows[0]['whole']['distance']:.3g}"), tuple(lines))


def _line(name: str, by_seed: list[list], digits: int, *, gap: bool = False) -> tuple[Cell, ...]:
    cells = [Cell(name)]
    for values in zip(*by_seed):
        known = stats.mean_interval(value for value in values if value is not None)
        cells.append(interval_cell(known, digits, "no pixel counts", gap=gap))
    return tuple(cells)


FILES: dict[str, Callable[[pathlib.Path], Collected]] = {
    uncertainty_tables.NAME: _uncertainty,
    DEVICE_FILE: _device,
    bench.BENCHMARK: bench.benchmark_tables,
    bench.QUALITY: bench.quality_tables,
    "cleanup.json": partial(_trained, cleanup_table),
    "draws.json": partial(_trained, draws_table),
    "geometry.json": partial(_trained, geometry_table),
}
