"""From folders of finished runs to numbers and page."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

from experiments.files import write_json
from experiments.predicted.cases import Case, run_cases
from experiments.predicted.page import write_page
from experiments.predicted.planned import plan_ahead
from experiments.predicted.results import RESULT_FILE, case_row, measure
from experiments.report import ReportError
from experiments.report.results import load_runs

SCHEMA_VERSION = 1
PAGE_FILE = "predicted_gain.html"


def read_cases(
    folders: Sequence[pathlib.Path], *, policies: Sequence[str] = (), planned: bool = False
) -> tuple[list[Case], int, list[str]]:
    """All cases of the finished runs, how many rounds were left out, and the runs' commands.

    Args:
      folders: of experiments.
      policies: whose runs to read; all if there are none.
      planned: whether to predict anew, from the first field (see `plan_ahead`).

    Raises:
      ReportError: a folder that cannot be read, or no case in any of them.
    """
    cases, left_out, commands = [], 0, []
    for folder in folders:
        runs = [run for run in load_runs(folder) if run.completed]
        runs = [run for run in runs if not policies or run.policy in policies]
        for run in plan_ahead(folder, runs) if planned else runs:
            found, missing = run_cases(run)
            cases, left_out = cases + found, left_out + missing
            commands.append(run.result["command"])
    if not cases:
        raise ReportError(
            f"{', '.join(map(str, folders))}: no finished run with predictions; make one by "
            "python -m experiments.active_selection with --config.predict_gain=True, or give "
            "--planned"
        )
    return cases, left_out, list(dict.fromkeys(commands))


def compare(
    folders: Sequence[pathlib.Path],
    out: pathlib.Path,
    *,
    command: str,
    policies: Sequence[str] = (),
    planned: bool = False,
) -> dict:
    """Reads runs, writes numbers and page, and returns the numbers.

    Args:
      folders, policies, planned: as for `read_cases`.
      out: folder for the results.
      command: by which this is made.
    """
    cases, left_out, commands = read_cases(folders, policies=policies, planned=planned)
    result = {
        "schema_version": SCHEMA_VERSION,
        "commands": [*commands, command],
        "planned": planned,
        "left_out": left_out,
        "predictors": measure(cases),
        "cases": [case_row(case) for case in cases],
    }
    write_json(out / RESULT_FILE, result)
    write_page(out / PAGE_FILE, cases=cases, result=result)
    return result
