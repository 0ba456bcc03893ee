"""The result file of `experiments.predicted_gain`, and its tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from experiments.predicted import analysis
from experiments.predicted.cases import PREDICTORS, Case, known
from experiments.report.headline import signed
from experiments.report.tables import Cell, Table, dash

RESULT_FILE = "predicted_gain.json"
THRESHOLDS = (0.25, 0.5, 1.0)  # dB
GROUPS: dict[str, Callable[[Case], object]] = {
    "pooled": lambda case: "all",
    "within_rounds": lambda case: case.within_round,
    "within_seeds": lambda case: case.within_seed,
}
# What a calibration may not have seen of a case, by name.
HELD_OUT: dict[str, Callable[[Case], object]] = {
    "seed": lambda case: case.seed,
    "scene": lambda case: case.scene,
}


def measure(cases: Sequence[Case]) -> dict:
    """Every number of the result file, of all predictors.

    Returns:
      {predictor: {"correlation": {grouping: ...}, "calibration": {held out: {"rmse", "constant_
      rmse", "stop": [...]}}, "line": [a, b] of all cases}}; a calibration is None where there is
      one seed, or scene, only.
    """
    found = {}
    for name in PREDICTORS:
        rest, predicted, realised = known(cases, name)
        if not rest:
            continue
        found[name] = {
            "correlation": {
                grouping: analysis.rank_correlation(
                    predicted, realised, [group(case) for case in rest]
                )._asdict()
                for grouping, group in GROUPS.items()
            },
            "calibration": {
                held: _calibration(predicted, realised, [group(case) for case in rest])
                for held, group in HELD_OUT.items()
            },
            "line": list(analysis.fit_line(predicted, realised)),
        }
    return found


def _calibration(predicted, realised, groups) -> dict | None:
    mapped, constant = analysis.calibrate_on_others(predicted, realised, groups)
    if np.isnan(mapped).any():
        return None
    return {
        "rmse": analysis.root_mean_square(mapped - realised),
        "constant_rmse": analysis.root_mean_square(constant - realised),
        "stop": [analysis.stop_rule(mapped, realised, x)._asdict() for x in THRESHOLDS],
    }


def case_row(case: Case) -> dict:
    """A case for the result file; four decimals are more than a PSNR is good for."""
    row = dataclasses.asdict(case)
    row["predicted"] = {k: None if v is None else round(v, 4) for k, v in row["predicted"].items()}
    return row | {"realised": round(case.realised, 4)}


# --- tables ----------------------------------------------------------------------------------


def correlation_table(result: dict) -> Table:
    """Rank correlation of each predictor, and how far it is off when calibrated."""
    head = ("predictor", "pooled", "within rounds", "within rounds and seeds")
    head += tuple(f"RMS error, {held} left out (dB)" for held in HELD_OUT)
    rows = []
    for name, found in result["predictors"].items():
        cells = [Cell(PREDICTORS[name][0])]
        cells += [_correlation_cell(name, found["correlation"][key]) for key in GROUPS]
        cells += [_error_cell(found["calibration"][held], held, "rmse") for held in HELD_OUT]
        rows.append(tuple(cells))
    first = next(iter(result["predictors"].values()))
    constant = [_error_cell(first["calibration"][held], held, "constant_rmse") for held in HELD_OUT]
    rows.append((Cell("a constant"), *[dash("a constant ranks nothing")] * len(GROUPS), *constant))
    return Table(head, tuple(rows))


def _correlation_cell(name: str, found: dict) -> Cell:
    if found["value"] is None:
        return dash(f"{PREDICTORS[name][0]}: the same for all of a group")
    return Cell(f"{signed(found['value'])} ± {found['standard_error']:.2f}")


def _error_cell(calibration: dict | None, held: str, key: str) -> Cell:
    if calibration is None:
        return dash(f"one {held} only")
    return Cell(f"{calibration[key]:.2f}")


def stop_table(result: dict, held: str) -> Table:
    """The stop rule of each predictor, calibrated without the seed, or scene, that it is tried on.

    Args:
      result: the result file.
      held: a key of `HELD_OUT`.
    """
    head = ("predictor", "stop below", "cases", "hit rate", "base rate", "stops")
    head += ("false stops", "missed stops")
    rows = []
    for place, threshold in enumerate(THRESHOLDS):
        for name, found in result["predictors"].items():
            cells = [Cell(PREDICTORS[name][0]), Cell(f"{threshold:g} dB")]
            if found["calibration"][held] is None:
                rows.append((*cells, *[dash(f"one {held} only")] * (len(head) - 2)))
                continue
            rule = found["calibration"][held]["stop"][place]
            cells += [Cell(str(rule["num_cases"]))]
            cells += [Cell(f"{rule[key]:.0%}") for key in ("hit_rate", "base_rate")]
            cells += [Cell(str(rule[k])) for k in ("num_stops", "false_stops", "missed_stops")]
            rows.append(tuple(cells))
    return Table(head, tuple(rows))
