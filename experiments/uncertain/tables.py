"""Tables of how well uncertainty tells error, and of how well calibrated intervals hold."""

from __future__ import annotations

import numpy as np

from bavs_jax.metrics.ause import variant_name
from experiments.report import stats
from experiments.report.tables import Cell, Table, dash, interval_cell
from experiments.uncertain.results import FIELDS, QUANTITIES, interval_values, models_of, values

CONSTANT = "constant width"  # the intervals that need no uncertainty
SUMMARY = {of: variant_name(of=of, error="mae", pooled=False) for of in ("depth", "colour")}


def ause_table(rows: list[dict], variant: str, *, first: str | None = None) -> Table:
    """AUSE of each model on its own field and on the common one, both normalisations.

    Args:
      rows: of the result file.
      variant: which AUSE.
      first: the model that others are compared with, seed by seed; the first one by default.
    """
    models = models_of(rows)
    first = first or models[0]
    head = ["model", "seeds", "PSNR of its field (dB)"]
    head += [f"AUSE, {words}" for words in FIELDS.values()]
    head += ["unnormalised, common field", f"minus {first}, common field"]
    table = []
    for model in models:
        mine = [row for row in rows if row["model"] == model]
        psnr = stats.mean_interval(row["psnr"] for row in mine)
        cells = [Cell(model), Cell(str(len(mine))), interval_cell(psnr, 2, "")]
        cells += [_ause_cell(rows, model, field, variant, "ause") for field in FIELDS]
        cells.append(_ause_cell(rows, model, "common", variant, "unnormalised"))
        cells.append(_gap_cell(rows, model, first, "common", variant))
        table.append(tuple(cells))
    return Table(tuple(head), tuple(table))


def summary_table(rows: list[dict], *, first: str = "laplace") -> Table:
    """Each model on its own field and on the common one: PSNR, AUSE of depth and of colour.

    Args:
      rows: of the result file.
      first: the model that others are compared with, seed by seed; the first one if it is missing.
    """
    models = models_of(rows)
    first = first if first in models else models[0]
    head = ["model", "measured on", "seeds", "PSNR of the field (dB)"]
    for of in SUMMARY:
        head += [f"AUSE {of} MAE", f"{of}: minus {first}", f"AUSE {of} MAE, unnorm."]
    table = []
    for field, words in (("own", "its own field"), ("common", "common field")):
        for model in models:
            mine = [row for row in rows if row["model"] == model]
            psnr = stats.mean_interval(
                row["psnr" if field == "own" else "psnr_common"] for row in mine
            )
            cells = [Cell(model), Cell(words), Cell(str(len(mine))), interval_cell(psnr, 2, "")]
            for variant in SUMMARY.values():
                cells.append(_ause_cell(rows, model, field, variant, "ause"))
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
            interval_values(rows, model, quantity, key)
            for key in ("coverage", "coverage_stderr", "mean_width", "width_ratio", "score_ratio")
        )
        cells = [Cell(model), *map(_share_cell, shares.mean(0), errors.mean(0))]
        cells.append(_number_cell(0.5 * widths.mean(0)[-2], 4))
        cells += [_list_cell(ratio.mean(0)) for ratio in ratios]
        table.append(tuple(cells))
    shares, widths = (
        interval_values(rows, models_of(rows)[0], quantity, f"constant_{key}").mean(0)
        for key in ("coverage", "width")
    )
    cells = [Cell(CONSTANT), *(Cell(f"{100.0 * share:.1f}") for share in shares)]
    cells += [_number_cell(0.5 * widths[-2], 4), *[_list_cell(np.ones(len(levels)))] * 2]
    return Table(tuple(head), (*table, tuple(cells)))


def _ause_cell(rows, model: str, field: str, variant: str, key: str) -> Cell:
    found = stats.mean_interval(values(rows, model, field, variant, key).values())
    digits = 3 if key == "ause" else 4
    return interval_cell(found, digits, f"{variant.split('_')[0]}: this scene has no true one")


def _gap_cell(rows, model: str, first: str, field: str, variant: str) -> Cell:
    if model == first:
        return dash("a model does not differ from itself")
    ours, theirs = (values(rows, name, field, variant) for name in (first, model))
    if not theirs:
        return _ause_cell(rows, model, field, variant, "ause")
    seeds = sorted(ours.keys() & theirs.keys())
    gap = stats.mean_interval(theirs[s] - ours[s] for s in seeds)
    return interval_cell(gap, 3, f"{model} and {first} share no seed", gap=True)


def _share_cell(share: float, stderr: float) -> Cell:
    """Per cent, with the standard error over test views."""
    more = "" if np.isnan(stderr) else f" ± {100.0 * stderr:.1f}"
    return Cell(f"{100.0 * share:.1f}{more}")


def _number_cell(value: float, digits: int) -> Cell:
    why = "too few calibration views for this level"
    return Cell(f"{value:.{digits}f}") if np.isfinite(value) else dash(why)


def _list_cell(numbers) -> Cell:
    cells = [_number_cell(number, 2) for number in numbers]
    return Cell(" / ".join(c.text for c in cells), next((c.why for c in cells if c.why), None))
