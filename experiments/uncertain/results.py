"""The result file of `evaluate_uncertainty`, and its table."""

from __future__ import annotations

import pathlib

import numpy as np

from experiments.report import stats
from experiments.report.tables import Cell, Table, dash, interval_cell

FIELDS = {"own": "the model's own field", "common": "one common field"}


def row_path(folder: pathlib.Path, model: str, seed: int) -> pathlib.Path:
    """Where the numbers of one model and seed are kept as soon as they are known."""
    return folder / "uncertainty" / model / f"seed_{seed}.json"


def known_variants(rows: list[dict]) -> list[str]:
    """Variants that every row has."""
    sets = [set(row["own"]) for row in rows]
    common = set.intersection(*sets) if sets else set()
    return [name for name in (rows[0]["own"] if rows else ()) if name in common]


def values(rows: list[dict], model: str, field: str, variant: str, key: str = "ause") -> dict:
    """By seed, one number of a model."""
    return {row["seed"]: row[field][variant][key] for row in rows if row["model"] == model}


def ause_table(rows: list[dict], variant: str, *, first: str | None = None) -> Table:
    """AUSE of each model on its own field and on the common one, both normalisations.

    Args:
      rows: of the result file.
      variant: which AUSE.
      first: the model that others are compared with, seed by seed; the first one by default.
    """
    models = list(dict.fromkeys(row["model"] for row in rows))
    first = first or models[0]
    head = ["model", "seeds", "PSNR of its field (dB)"]
    head += [f"AUSE, {words}" for words in FIELDS.values()]
    head += ["unnormalised, common field", f"minus {first}, common field"]
    table = []
    for model in models:
        mine = [row for row in rows if row["model"] == model]
        psnr = stats.mean_interval(row["psnr"] for row in mine)
        cells = [Cell(model), Cell(str(len(mine))), interval_cell(psnr, 2, "")]
        for field in FIELDS:
            found = stats.mean_interval(values(rows, model, field, variant).values())
            cells.append(interval_cell(found, 3, ""))
        plain = values(rows, model, "common", variant, "unnormalised")
        cells.append(interval_cell(stats.mean_interval(plain.values()), 4, ""))
        cells.append(_difference(rows, model, first, variant))
        table.append(tuple(cells))
    return Table(tuple(head), tuple(table))


def _difference(rows, model: str, first: str, variant: str) -> Cell:
    if model == first:
        return dash("a model does not differ from itself")
    ours, theirs = (values(rows, name, "common", variant) for name in (first, model))
    seeds = sorted(ours.keys() & theirs.keys())
    gap = stats.mean_interval(theirs[s] - ours[s] for s in seeds)
    return interval_cell(gap, 3, f"{model} and {first} share no seed", gap=True)


def mean_curves(arrays: list[dict], field: str, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean over seeds of both curves, each seed divided by its own largest value."""
    pairs = []
    for one in arrays:
        a, b = (one[f"{field}_{variant}_by_{what}"] for what in ("uncertainty", "error"))
        largest = max(a.max(), b.max(), 1e-12)
        pairs.append((a / largest, b / largest))
    return tuple(np.mean(curves, axis=0) for curves in zip(*pairs))
