"""`uncertainty.json`, and its tables: how well uncertainty tells error, how well intervals hold."""

from __future__ import annotations

import json
import pathlib

import numpy as np

from bavs_jax.metrics.ause import variant_name
from experiments.files import write_atomic
from experiments.reporting import stats
from experiments.reporting.results import read_result
from experiments.reporting.tables import Cell, Table, dash, interval_cell
from experiments.runtime import ReportError

SCHEMA_VERSION = 2  # of uncertainty.json
NAME = "uncertainty.json"
FIELDS = {"own": "the model's own field", "common": "one common field"}
QUANTITIES = {"depth": "scene units", "colour": "of 0 to 1"}  # that have intervals, and the unit
CONSTANT = "constant width"  # the intervals that need no uncertainty


def load_result(folder: pathlib.Path) -> dict:
    """`uncertainty.json` of a folder.

    Raises:
      ReportError: the file is missing or broken, or of another version.
    """
    result = read_result(folder / NAME, SCHEMA_VERSION, made_by="evaluation")
    if not result.get("rows"):
        raise ReportError(f"{folder / NAME}: rows: there are none; run the evaluation again")
    return result


def save_result(folder: pathlib.Path, result: dict) -> None:
    """Writes `uncertainty.json`: six digits, one line for each row, so that it stays small."""
    parts = {name: json.dumps(_rounded(value), allow_nan=False) for name, value in result.items()}
    rows = [json.dumps(_rounded(row), allow_nan=False) for row in result["rows"]]
    parts["rows"] = "[\n" + ",\n".join(rows) + "\n]"
    text = ",\n".join(f"{json.dumps(name)}: {part}" for name, part in parts.items())
    write_atomic(folder / NAME, lambda file: file.write(f"{{\n{text}\n}}\n".encode()))


def _rounded(value):
    if isinstance(value, dict):
        return {name: _rounded(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def split_words(result: dict) -> str:
    """How many views fit, calibrate and test the intervals, in words."""
    splits = result["interval_views"].values()
    fit, calibration, test = (
        "/".join(map(str, sorted({len(split[name]) for split in splits})))
        for name in ("fit", "calibration", "test")
    )
    return (
        f"{fit} views fit the scale, {calibration} calibrate and {test} test, none of them trained "
        "on, drawn at random for each seed"
    )


def models_of(rows: list[dict]) -> list[str]:
    """Each model once, in the order of the rows."""
    return list(dict.fromkeys(row["model"] for row in rows))


def known_variants(rows: list[dict]) -> list[str]:
    """Variants of AUSE that every row has."""
    return [name for name in rows[0]["own"] if all(name in row["own"] for row in rows)]


def known_quantities(rows: list[dict]) -> list[str]:
    """What every row has intervals of."""
    return [q for q in QUANTITIES if all(q in row["intervals"] for row in rows)]


def interval_values(rows: list[dict], model: str, quantity: str, key: str) -> np.ndarray:
    """One measure of `coverage_report` [seeds, L, ...] of a model; NaN where it is infinite."""
    found = [row["intervals"][quantity][key] for row in rows if row["model"] == model]
    return np.array(found, np.float64)


def ause_table(rows: list[dict], variant: str) -> Table:
    """One variant of AUSE of each model on its own field and on the common one.

    Both normalisations; differences to the first model are paired by seed.
    """
    first, *_ = models = models_of(rows)
    head = ("model", "seeds", "PSNR of its field (dB)")
    head += tuple(f"AUSE, {words}" for words in FIELDS.values())
    head += ("unnormalised, common field", f"minus {first}, common field")
    table = []
    for model in models:
        cells = [Cell(model), *_seeds_and_psnr(rows, model, "psnr")]
        cells += [_ause_cell(rows, model, field, variant) for field in FIELDS]
        cells.append(_ause_cell(rows, model, "common", variant, "unnormalised"))
        table.append((*cells, _gap_cell(rows, model, first, "common", variant)))
    return Table(head, tuple(table))


def summary_table(rows: list[dict]) -> Table:
    """Each model on its own field and on the common one: PSNR, AUSE of depth and of colour.

    Models are compared with the Laplace approximation seed by seed, or with the first one.
    """
    models = models_of(rows)
    first = "laplace" if "laplace" in models else models[0]
    head = ["model", "measured on", "seeds", "PSNR of the field (dB)"]
    for of in ("depth", "colour"):
        head += [f"AUSE {of} MAE", f"{of}: minus {first}", f"AUSE {of} MAE, unnorm."]
    table = []
    for field, words, psnr in (
        ("own", "its own field", "psnr"),
        ("common", "common field", "psnr_common"),
    ):
        for model in models:
            cells = [Cell(model), Cell(words), *_seeds_and_psnr(rows, model, psnr)]
            for of in ("depth", "colour"):
                variant = variant_name(of=of, error="mae", pooled=False)
                cells.append(_ause_cell(rows, model, field, variant))
                cells.append(_gap_cell(rows, model, first, field, variant))
                cells.append(_ause_cell(rows, model, field, variant, "unnormalised"))
            table.append(tuple(cells))
    return Table(tuple(head), tuple(table))


def coverage_table(rows: list[dict], quantity: str) -> Table:
    """Share of test pixels inside their interval, and widths against one width for all pixels.

    Args:
      rows: of the result file.
      quantity: "depth" or "colour".
    """
    levels = rows[0]["intervals"][quantity]["levels"]
    names = ", ".join(f"{level:.0%}" for level in levels)
    head = [f"intervals of {quantity}", *(f"covered at {level:.0%} (%)" for level in levels)]
    head += [
        f"mean half-width at {levels[-2]:.0%} ({QUANTITIES[quantity]})",
        f"width / constant's at {names}",
        f"interval score / constant's at {names}",
    ]
    table = []
    for model in models_of(rows):
        shares, errors, widths, *ratios = (
            interval_values(rows, model, quantity, key).mean(0)
            for key in ("coverage", "coverage_stderr", "mean_width", "width_ratio", "score_ratio")
        )
        table.append(_coverage_row(model, shares, errors, widths, ratios))
    shares, widths = (
        interval_values(rows, models_of(rows)[0], quantity, f"constant_{key}").mean(0)
        for key in ("coverage", "width")
    )
    ones = np.ones(len(levels))
    table.append(_coverage_row(CONSTANT, shares, np.nan * ones, widths, [ones, ones]))
    return Table(tuple(head), tuple(table))


def _coverage_row(name: str, shares, errors, widths, ratios) -> tuple[Cell, ...]:
    cells = [Cell(name)]
    for share, error in zip(shares, errors):  # per cent, with the standard error over test views
        more = "" if np.isnan(error) else f" ± {100.0 * error:.1f}"
        cells.append(Cell(f"{100.0 * share:.1f}{more}"))
    cells.append(_number_cell(0.5 * widths[-2], 4))
    for ratio in ratios:
        parts = [_number_cell(number, 2) for number in ratio]
        why = next((part.why for part in parts if part.why), None)
        cells.append(Cell(" / ".join(part.text for part in parts), why))
    return tuple(cells)


def _seeds_and_psnr(rows: list[dict], model: str, psnr: str) -> list[Cell]:
    values = [row[psnr] for row in rows if row["model"] == model]
    return [Cell(str(len(values))), interval_cell(stats.mean_interval(values), 2, "")]


def _values(rows: list[dict], model: str, field: str, variant: str, key: str = "ause") -> dict:
    """By seed, one number of a model."""
    mine = [row for row in rows if row["model"] == model]
    return {row["seed"]: row[field][variant][key] for row in mine if variant in row[field]}


def _ause_cell(rows, model: str, field: str, variant: str, key: str = "ause") -> Cell:
    found = stats.mean_interval(_values(rows, model, field, variant, key).values())
    digits = 3 if key == "ause" else 4
    return interval_cell(found, digits, f"{variant.split('_')[0]}: this scene has no true one")


def _gap_cell(rows, model: str, first: str, field: str, variant: str) -> Cell:
    if model == first:
        return dash("a model does not differ from itself")
    ours, theirs = (_values(rows, name, field, variant) for name in (first, model))
    if not theirs:
        return _ause_cell(rows, model, field, variant)
    gap = stats.mean_interval(theirs[s] - ours[s] for s in sorted(ours.keys() & theirs.keys()))
    return interval_cell(gap, 3, f"{model} and {first} share no seed", gap=True)


def _number_cell(value: float, digits: int) -> Cell:
    why = "too few calibration views for this level"
    return Cell(f"{value:.{digits}f}") if np.isfinite(value) else dash(why)
