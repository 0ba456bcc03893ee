"""Compares what batches of views were predicted to be worth with what they were worth.

    python -m experiments.predicted_gain --workdir=runs/gain_lego --workdir=runs/gain_sculpture

Reads the result files of finished runs of `experiments.active_selection` that recorded predictions
(--config.predict_gain=True); several folders are taken together, such as one for each scene.
Writes `predicted_gain.json` and `predicted_gain.html` into --out. Definitions: the predicted gain
in bavs_jax/selection/predicted_gain.py, everything else in experiments/predicted/__init__.py.

--planned predicts the batches of any finished runs anew, all from the field of the initial views,
whose checkpoint is still in the folder: as if they had been planned at once.
"""

from __future__ import annotations

import pathlib
import sys

from absl import flags

from experiments import runtime
from experiments.errors import USER_ERRORS
from experiments.files import write_json
from experiments.predicted.cases import Case, run_cases
from experiments.predicted.page import write_page
from experiments.predicted.planned import plan_ahead
from experiments.predicted.results import RESULT_FILE, case_row, measure
from experiments.report import ReportError
from experiments.report.results import load_runs

FLAGS = flags.FLAGS
flags.DEFINE_multi_string("workdir", [], "Folder of an experiment; may be given several times.")
flags.DEFINE_bool("planned", False, "Predict all batches from the field of the initial views.")
flags.DEFINE_string("out", None, "Folder for the results; by default the first --workdir.")

SCHEMA_VERSION = 1


def read_cases(
    folders: list[pathlib.Path], *, planned: bool = False
) -> tuple[list[Case], int, list[str]]:
    """All cases of the finished runs, how many rounds were left out, and the runs' commands.

    Args:
      folders: of experiments.
      planned: whether to predict anew, from the first field (see `plan_ahead`).

    Raises:
      ReportError: a folder that cannot be read, or no case in any of them.
    """
    cases, left_out, commands = [], 0, []
    for folder in folders:
        runs = [run for run in load_runs(folder) if run.completed]
        for run in plan_ahead(folder, runs) if planned else runs:
            found, missing = run_cases(run)
            cases, left_out = cases + found, left_out + missing
            commands.append(run.result["command"])
    if not cases:
        raise ReportError(
            f"{', '.join(map(str, folders))}: no finished run with predictions; make one by "
            "python -m experiments.active_selection with --config.predict_gain=True"
        )
    return cases, left_out, list(dict.fromkeys(commands))


def compare(folders: list[pathlib.Path], out: pathlib.Path, *, planned: bool = False) -> dict:
    """Reads runs, writes numbers and page, and returns the numbers."""
    cases, left_out, commands = read_cases(folders, planned=planned)
    result = {
        "schema_version": SCHEMA_VERSION,
        "commands": [*commands, runtime.command_line()],
        "planned": planned,
        "left_out": left_out,
        "predictors": measure(cases),
        "cases": [case_row(case) for case in cases],
    }
    write_json(out / RESULT_FILE, result)
    write_page(out / "predicted_gain.html", cases=cases, result=result)
    return result


def main() -> None:
    if not FLAGS.workdir:
        sys.exit("error: --workdir: is missing; name the folder of a finished experiment")
    folders = [pathlib.Path(folder) for folder in FLAGS.workdir]
    out = pathlib.Path(FLAGS.out) if FLAGS.out else folders[0]
    try:
        result = compare(folders, out, planned=FLAGS.planned)
    except (ReportError, *USER_ERRORS) as error:
        sys.exit(f"error: {error}")
    print(f"{len(result['cases'])} batches")
    print(f"numbers: {out / RESULT_FILE}")
    print(f"page:    {out / 'predicted_gain.html'}")


if __name__ == "__main__":
    runtime.run_script(main)
