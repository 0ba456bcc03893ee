"""The result file of `evaluate_uncertainty`: where its parts are, and numbers out of it."""

from __future__ import annotations

import json
import pathlib

import numpy as np

from experiments.files import read_versioned, write_atomic
from experiments.report import ReportError

SCHEMA_VERSION = 2  # of uncertainty.json
ROW_VERSION = 2  # of one model and seed; rows of another version are made anew
NAME = "uncertainty.json"
FIELDS = {"own": "the model's own field", "common": "one common field"}
QUANTITIES = {"depth": "scene units", "colour": "of 0 to 1"}  # that have intervals, and the unit


def row_path(folder: pathlib.Path, model: str, seed: int) -> pathlib.Path:
    """Where the numbers of one model and seed are kept as soon as they are known."""
    return folder / "uncertainty" / model / f"seed_{seed}.json"


def load_result(folder: pathlib.Path) -> dict:
    """`uncertainty.json` of a folder.

    Raises:
      ReportError: the file is missing or broken, or of another version.
    """
    path = folder / NAME
    result = read_versioned(
        path,
        SCHEMA_VERSION,
        error=ReportError,
        absent="give the --workdir of an evaluation",
        fix="run the evaluation again",
    )
    if not result.get("rows"):
        raise ReportError(f"{path}: rows: there are none; run the evaluation again")
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


def title(result: dict) -> str:
    """What was measured, in plain words."""
    rows, config = result["rows"], result["config"]
    width, height = result["image_size"]
    # The scene that comes with the project is called like its loader.
    scene = config["scene"] if result["kind"] == result["scene"] else result["scene"]
    kind = {"procedural": "procedural scene", "blender": "NeRF-synthetic scene"}
    kind = kind.get(result["kind"], f"scene of the {result['kind']} layout")
    seeds = sorted({row["seed"] for row in rows})
    views = sorted({row["num_views"] for row in rows})
    views = f"{views[0]}" if len(views) == 1 else f"{views[0]} to {views[-1]}"
    seeds = f"{len(seeds)} seed{'s' * (len(seeds) > 1)} ({', '.join(map(str, seeds))})"
    steps = config["train"]["num_steps"]
    return (
        f"{scene} ({kind}, {width} x {height} pixels), {views} training views, {steps} optimiser "
        f"steps, {seeds}"
    )


def split_words(result: dict) -> str:
    """How many views fit, calibrate and test the intervals, in words."""
    splits = result["interval_views"].values()
    counts = []
    for name in ("fit", "calibration", "test"):
        numbers = sorted({len(split[name]) for split in splits})
        counts.append("/".join(map(str, numbers)))
    return (
        f"{counts[0]} views fit the scale, {counts[1]} calibrate and {counts[2]} test, none of "
        "them trained on, drawn at random for each seed"
    )


def left_out_words(rows: list[dict]) -> str:
    """How many test pixels have no interval, and how wrong they are, of the first model."""
    model, parts = rows[0]["model"], []
    for quantity in known_quantities(rows):
        share, error = (
            [row["intervals"][quantity][key] for row in rows if row["model"] == model]
            for key in ("share_with_band", "error_without_band")
        )
        known = [value for value in error if value is not None]
        mean = f", mean error {np.mean(known):.3g} {QUANTITIES[quantity]}" if known else ""
        parts.append(f"{quantity} {1.0 - np.mean(share):.1%}{mean}")
    return f"Pixels with a known truth but without an interval ({model}): {'; '.join(parts)}."


def models_of(rows: list[dict]) -> list[str]:
    """Each model once, in the order of the rows."""
    return list(dict.fromkeys(row["model"] for row in rows))


def known_variants(rows: list[dict]) -> list[str]:
    """Variants that every row has."""
    sets = [set(row["own"]) for row in rows]
    common = set.intersection(*sets) if sets else set()
    return [name for name in (rows[0]["own"] if rows else ()) if name in common]


def known_quantities(rows: list[dict]) -> list[str]:
    """What every row has intervals of."""
    return [q for q in QUANTITIES if all(q in row["intervals"] for row in rows)]


def values(rows: list[dict], model: str, field: str, variant: str, key: str = "ause") -> dict:
    """By seed, one number of a model."""
    return {
        row["seed"]: row[field][variant][key]
        for row in rows
        if row["model"] == model and variant in row[field]
    }


def interval_values(rows: list[dict], model: str, quantity: str, key: str) -> np.ndarray:
    """One measure of `coverage_report` [seeds, L, ...] of a model; NaN where it is infinite."""
    found = [row["intervals"][quantity][key] for row in rows if row["model"] == model]
    return np.array(found, np.float64)


def mean_curves(arrays: list[dict], field: str, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean over seeds of both curves, each seed divided by its own largest value."""
    pairs = []
    for one in arrays:
        a, b = (one[f"{field}_{variant}_by_{what}"] for what in ("uncertainty", "error"))
        largest = max(a.max(), b.max(), 1e-12)
        pairs.append((a / largest, b / largest))
    return tuple(np.mean(curves, axis=0) for curves in zip(*pairs))
