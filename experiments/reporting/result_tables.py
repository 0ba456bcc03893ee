"""All that the result files of a folder say, whichever script wrote them, as named tables."""

import pathlib
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from experiments.reporting import benchmark, run_tables, stats, uncertainty, view_sets
from experiments.reporting.results import Run, load_runs, policies_of, read_result
from experiments.reporting.tables import Cell, Collected, Table, dash, interval_cell
from experiments.runtime import ReportError
from experiments.sweep_plan import FILE as SWEEP_FILE
from experiments.sweep_plan import Record, read_record

DEVICE_FILE = "check_device.json"
INTERVALS = "means over seeds ± half of the 95 % interval"


def collect_all(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> list[Collected]:
    """The tables of every result file that a folder of some script holds; see `collect_tables`."""
    found = [make(folder / name) for name, make in FILES.items() if (folder / name).exists()]
    if not found or any((folder / name).exists() for name in ("summary.json", SWEEP_FILE)):
        found.insert(0, collect_tables(folder, paper, only))
    return found


# --- of experiments and sweeps ---


def collect_tables(
    folder: pathlib.Path, paper: str | None = None, only: Sequence[str] = ()
) -> Collected:
    """The tables of one experiment, or of a sweep over options.

    Of an experiment: quality at the last shared number of views, round by round, and where the
    time went. Of a sweep: its settings against each other; of one over scenes also their mean.
    Rows of `paper`, a table of `run_tables.PAPER`, are put beside ours; `only` names policies to
    show, in this order. Raises ReportError for a file of no use, or where there is no result.
    """
    record = read_record(folder)
    if record is not None and any(row["values"] for row in record.settings):
        return _sweep_tables(folder, record, paper, only)
    runs = load_runs(folder, only)
    if not runs:
        raise ReportError(f"{folder / 'summary.json'}: holds no run; wait for the first to end")
    planned = record.settings[0]["policies"] if record and not only else []
    policies = list(dict.fromkeys([*policies_of(runs), *planned]))
    return _collected(record, {".": runs}, _quality(runs, policies, paper), only)


def _sweep_tables(
    folder: pathlib.Path, record: Record, paper: str | None, only: Sequence[str]
) -> Collected:
    settings = []
    for row in record.settings:
        path = folder / row["folder"]
        policies = [p for p in only or row["policies"] if p in row["policies"]]
        runs = load_runs(path) if (path / "summary.json").exists() else []
        runs = [run for run in runs if run.policy in policies]
        settings.append(run_tables.Setting(row["folder"], row["values"], policies, runs))
    runs = {setting.name: setting.runs for setting in settings}
    if not any(runs.values()):
        raise ReportError(f"{folder / SWEEP_FILE}: no trial has a result so far")
    over_scenes = all(setting.values.keys() == {"scene"} for setting in settings)
    tables = {"settings": run_tables.settings_table(settings)}
    notes = []
    if over_scenes:
        notes = [f"Tables after the first are of means over these {len(settings)} scenes."]
        policies = list(dict.fromkeys(p for setting in settings for p in setting.policies))
        shared = stats.in_all_scenes(runs.values())
        tables |= _quality(shared, policies, paper) if shared else {}
    elif paper is not None:
        raise ReportError(f"{folder}: {paper} is over scenes; give the folder of one setting")
    return _collected(record, runs, tables, only, notes)


def _quality(runs: list[Run], policies: list[str], paper: str | None) -> dict[str, Table]:
    tables = {
        "quality": run_tables.final_table(runs, policies),
        "rounds": run_tables.rounds_table(runs, policies),
        "baselines": run_tables.baseline_table(runs),
        "time": run_tables.timing_table(runs, policies),
        "paper": run_tables.paper_table(runs, policies, paper) if paper is not None else None,
    }
    return {name: table for name, table in tables.items() if table is not None}


def _collected(
    record: Record | None, by_folder: dict[str, list[Run]], tables: dict, only, notes=()
) -> Collected:
    """Tables with the commands and devices that made them, and every run that has no result."""
    runs = [run for some in by_folder.values() for run in some]
    # Runs that were made in parts have what all their commands share.
    first, *others = dict.fromkeys(run.result["command"] for run in runs)
    shared = " ".join(word for word in first.split() if all(word in o.split() for o in others))
    later = filter(None, dict.fromkeys(run.result.get("remeasured_by") for run in runs))
    command = "`, then `".join([record.command if record else shared, *later])
    devices = ", ".join(dict.fromkeys(run.result["device"] for run in runs))
    notes = [*notes]
    for folder, some in by_folder.items() if record else ():
        done = {(run.policy, run.seed) for run in some if run.completed}
        where = "" if folder == "." else f"{folder}, "
        for (policy, seed), why in record.missing(folder, done).items():
            if not only or policy in only:
                notes.append(f"Missing: {where}{policy}, seed {seed}: {why}.")
    return Collected(f"`{command}` ({devices}; {INTERVALS})", tables, notes)


# --- of other scripts ---


def _uncertainty(path: pathlib.Path) -> Collected:
    """How well uncertainty tells error, and how well calibrated intervals hold."""
    result = uncertainty.load_result(path.parent)
    rows = result["rows"]
    tables = {"ause": uncertainty.summary_table(rows)}
    for quantity in uncertainty.known_quantities(rows):
        tables[f"{quantity}_intervals"] = uncertainty.coverage_table(rows, quantity)
    split = uncertainty.split_words(result)
    note = f"Intervals: {split}. Coverage ± its standard error over the test views."
    return Collected(f"`{result['command']}` ({result['device']}; {INTERVALS})", tables, (note,))


def _device(path: pathlib.Path) -> Collected:
    """How far an accelerator's numbers are from the CPU's."""
    result = read_result(path)
    how = f"{result['device']}; matrix products at {result['matmul_precision']} precision"
    tables = {"differences": differences_table(result["differences"])}
    return Collected(f"`{result['command']}` ({how})", tables)


def differences_table(differences: dict[str, dict[str, float]]) -> Table:
    """A row for each field, a column for each thing that was compared."""
    names = list(dict.fromkeys(what for row in differences.values() for what in row))
    rows = []
    for name, row in differences.items():
        missing = dash(f"not compared for {name}")
        cells = [Cell(f"{row[what]:.1e}") if what in row else missing for what in names]
        rows.append((Cell(name), *cells))
    return Table(("field", *names), tuple(rows))


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
    found = {}
    # Before and after are held against each other over the same pixels.
    for when, covered in (("before", "psnr_covered_before"), ("after", "psnr_covered")):
        numbers = []
        for row in rows:
            test = [row[when]["test"][key] for key in ("psnr", "share_covered", "share_floating")]
            kept = row[when]["training"]["content_kept"]
            numbers.append([row["after"]["test"][covered], *test, kept])
        found[when] = np.array(numbers, float) * (1.0, 1.0, 100.0, 100.0, 100.0)
    change = _line("change", found["after"] - found["before"], 2, gap=True)
    return Table(head, [*(_line(when, numbers, 2) for when, numbers in found.items()), change])


SPLITS = {  # of `draws.json`
    "training": "training views",
    "test": "test views",
    "farthest": "the test view farthest from all training views",
}
SURFACES = {  # of `geometry.json`
    "seen": "what views see",
    "whole": "whole surface",
    "floor": "floor: two draws of the true surface",
}


def draws_table(rows: list[dict]) -> Table:
    """How far pixels move over draws, in training views and in test views."""
    head = ("", "colours move by, pixels with matter", "all pixels", "rank correlation")
    return Table(head, _part_lines(rows, SPLITS, "spread", "spread_all", "rank_correlation"))


def geometry_table(rows: list[dict]) -> Table:
    """Distances of a mesh from the true surface, and the floor that the number of points sets."""
    head = ("", "Chamfer (scene units)", "mesh to truth", "truth to mesh")
    head += (f"F-score at {rows[0]['whole']['distance']:.3g}",)
    names = ("chamfer", "accuracy", "completeness", "f_score")
    return Table(head, _part_lines(rows, SURFACES, *names))


def _part_lines(rows: list[dict], parts: dict[str, str], *names: str) -> list[list]:
    """A line for each part that all rows have, over seeds."""
    return [
        _line(words, [[row[part][name] for name in names] for row in rows], 4)
        for part, words in parts.items()
        if all(row[part] is not None for row in rows)
    ]


def _line(name: str, by_seed, digits: int, *, gap: bool = False) -> list:
    """Each column's mean over the seeds [n, columns] that have a number there."""
    columns = np.array(by_seed, float).T  # None is NaN
    means = [stats.mean_interval(column[np.isfinite(column)]) for column in columns]
    return [name, *(interval_cell(mean, digits, "no pixel counts", gap=gap) for mean in means)]


FILES: dict[str, Callable[[pathlib.Path], Collected]] = {
    uncertainty.NAME: _uncertainty,
    DEVICE_FILE: _device,
    **benchmark.FILES,
    "cleanup.json": partial(_trained, cleanup_table),
    "draws.json": partial(_trained, draws_table),
    "geometry.json": partial(_trained, geometry_table),
    view_sets.FILE: view_sets.view_set_tables,
}
