"""`uncertainty.json`, its tables and its page: how well uncertainty tells error."""

import itertools
import json
import pathlib

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bavs_jax.metrics.ause import removal_fractions, variant_name
from experiments.files import cut_pictures, write_atomic
from experiments.reporting import plots, stats, tables
from experiments.reporting.pictures import (
    ERROR_LIMIT,
    ERROR_MAP,
    UNCERTAINTY_MAP,
    Panel,
    panel_table,
)
from experiments.reporting.results import read_result
from experiments.reporting.tables import Cell, Section, Table, dash, interval_cell
from experiments.runtime import ReportError

RESULT_VERSION = 2
NAME = "uncertainty.json"
FIELDS = {"own": "the model's own field", "common": "one common field"}
QUANTITIES = {"depth": "scene units", "colour": "of 0 to 1"}  # that have intervals, and the unit
CONSTANT = "constant width"  # the intervals that need no uncertainty
LEVEL = 0.9  # of the bands that are shown
SPREAD = 0.62  # of the distance between two levels that the models of one level fill


# --- the file ---


def load_result(folder: pathlib.Path) -> dict:
    """`uncertainty.json` of a folder.

    Raises:
      ReportError: the file is missing or broken, or of another version.
    """
    result = read_result(folder / NAME, RESULT_VERSION, made_by="evaluation")
    if not result.get("rows"):
        raise ReportError(f"{folder / NAME}: rows: there are none; run the evaluation again")
    return result


def save_result(folder: pathlib.Path, result: dict) -> None:
    """Writes `uncertainty.json`: six digits, one line for each row, so that it stays small."""
    text = json.dumps(result, allow_nan=False)
    rounded = json.loads(text, parse_float=lambda digits: float(f"{float(digits):.6g}"))
    parts = {name: json.dumps(value) for name, value in rounded.items()}
    parts["rows"] = "[\n" + ",\n".join(map(json.dumps, rounded["rows"])) + "\n]"
    text = ",\n".join(f"{json.dumps(name)}: {part}" for name, part in parts.items())
    write_atomic(folder / NAME, lambda file: file.write(f"{{\n{text}\n}}\n".encode()))


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


def interval_mean(rows: list[dict], model: str, quantity: str, key: str) -> np.ndarray:
    """Mean over seeds of a measure of `coverage_report` [L, ...]; NaN where it is infinite."""
    found = [row["intervals"][quantity][key] for row in rows if row["model"] == model]
    return np.array(found, np.float64).mean(0)


# --- tables ---


def summary_table(rows: list[dict]) -> Table:
    """Each model on its own field and on the common one: PSNR, AUSE of depth and of colour.

    Models are compared with the Laplace approximation seed by seed, or with the first one.
    """
    models = models_of(rows)
    first = "laplace" if "laplace" in models else models[0]
    head = ["model", "measured on", "seeds", "PSNR of the field (dB)"]
    for of in ("depth", "colour"):
        head += [f"AUSE {of} MAE", f"{of}: minus {first}", f"AUSE {of} MAE, unnorm."]
    fields = {"own": ("its own field", "psnr"), "common": ("common field", "psnr_common")}
    table = []
    for (field, (words, psnr)), model in itertools.product(fields.items(), models):
        psnrs = [row[psnr] for row in rows if row["model"] == model]
        cells = [model, words, len(psnrs), interval_cell(stats.mean_interval(psnrs), 2, "")]
        for of in ("depth", "colour"):
            variant = variant_name(of=of, error="mae", pooled=False)
            cells.append(_ause_cell(rows, model, field, variant))
            cells.append(_gap_cell(rows, model, first, field, variant))
            cells.append(_ause_cell(rows, model, field, variant, "unnormalised"))
        table.append(cells)
    return Table(head, table)


def coverage_table(rows: list[dict], quantity: str) -> Table:
    """Share of test pixels inside their interval, and widths against one width for all pixels."""
    levels = rows[0]["intervals"][quantity]["levels"]
    names = ", ".join(f"{level:.0%}" for level in levels)
    head = [f"intervals of {quantity}", *(f"covered at {level:.0%} (%)" for level in levels)]
    head.append(f"mean half-width at {levels[-2]:.0%} ({QUANTITIES[quantity]})")
    head += [f"{what} / constant's at {names}" for what in ("width", "interval score")]
    table, keys = [], ("coverage", "coverage_stderr", "mean_width", "width_ratio", "score_ratio")
    for model in models_of(rows):
        means = (interval_mean(rows, model, quantity, key) for key in keys)
        table.append(_coverage_row(model, *means))
    first, ones = models_of(rows)[0], np.ones(len(levels))
    shares, widths = (
        interval_mean(rows, first, quantity, f"constant_{key}") for key in ("coverage", "width")
    )
    table.append(_coverage_row(CONSTANT, shares, np.nan * ones, widths, ones, ones))
    return Table(head, table)


def _coverage_row(name: str, shares, errors, widths, *ratios) -> list:
    cells = [name]
    for share, error in zip(shares, errors):  # per cent, with the standard error over test views
        cells.append(f"{100.0 * share:.1f}" + ("" if np.isnan(error) else f" ± {100 * error:.1f}"))
    for values, digits in ((0.5 * widths[-2:-1], 4), *((ratio, 2) for ratio in ratios)):
        texts = [f"{value:.{digits}f}" if np.isfinite(value) else "—" for value in values]
        why = None if np.isfinite(values).all() else "too few calibration views for this level"
        cells.append(Cell(" / ".join(texts), why))
    return cells


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


# --- the page ---


def write_page(path: pathlib.Path, result: dict, *, arrays: dict, variant: str) -> None:
    """Curves of a variant of AUSE, tables of all, calibrated intervals, and pictures of some views.

    `arrays` are by model those of each seed; pictures are of the first seed.
    """
    rows = result["rows"]
    variant = variant if variant in known_variants(rows) else known_variants(rows)[0]
    pictures = {model: cut_pictures(found[0]) for model, found in arrays.items()}
    sections = [
        Section(
            "Does uncertainty tell where the field is wrong?",
            summary_table(rows),
            "Pixels of test views are taken away, the most uncertain first. AUSE is the area "
            "between the error of what is left and the same in the order of the true error "
            f"(dotted), 0 at best; as a share of the larger maximum, or not (unnorm.). Means over "
            f"seeds ± half of the 95 % interval. Curves: {variant}, as a share of the largest.",
            [curve_plot(arrays, field, variant) for field in FIELDS],
        ),
        *(_interval_section(result, quantity) for quantity in known_quantities(rows)),
        Section(
            "Some test views",
            note=f"Colour error and half-width at {LEVEL:.0%}: 0 (dark) to {ERROR_LIMIT}; blank: "
            "no band. Uncertainty: up to the 99th percentile of the model's pixels.",
            plots=view_plots(pictures),
        ),
    ]
    title = f"Uncertainty against error: {result['scene']}"
    tables.write_page(path, title=title, made=result, sections=sections)


def _interval_section(result: dict, quantity: str) -> Section:
    rows, scale = result["rows"], result["config"]["evaluation"]["interval_scale"]
    note = (
        f"Prediction ± factor x scale(uncertainty), {scale} scale, by split-conformal calibration: "
        f"{split_words(result)}. Pixels: {result['pixel_rule']}. ±: standard error over test "
        "views. Widths and scores relative to one constant width beat it below 1."
    )
    chart = coverage_plot(rows, quantity)
    return Section(f"Intervals of {quantity}", coverage_table(rows, quantity), note, [chart])


def _axes() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.6, 4.0))
    axes = figure.add_subplot()
    axes.grid(axis="y")
    return figure, axes


def curve_plot(curves: dict[str, list[dict]], field: str, variant: str) -> Markup:
    """Error of the pixels that are left, for each model, against what is taken away.

    `curves` are by model the arrays of each seed; `field` is one of `FIELDS`.
    """
    figure, axes = _axes()
    for model, (colour, marker) in plots.policy_style(list(curves)).items():
        by_uncertainty, best = mean_curves(curves[model], field, variant)
        fractions = removal_fractions(len(best))
        look = {"linewidth": 2.0, "marker": marker, "markevery": (3, 14), "markersize": 5}
        axes.plot(fractions, by_uncertainty, color=colour, label=model, **look, **plots.DOT)
        axes.plot(fractions, best, color=colour, linewidth=1.0, linestyle=":")
    words = f"Error of what is left, {FIELDS[field]}"
    axes.set(title=words, xlabel="pixels taken away", xlim=(0.0, 1.0), ylim=(0.0, None))
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend()
    return plots.to_svg(figure, salt=f"curve-{field}", label=words)


def mean_curves(arrays: list[dict], field: str, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean over seeds of both curves, each seed divided by its own largest value."""
    pairs = []
    for one in arrays:
        pair = np.stack([one[f"{field}_{variant}_by_{by}"] for by in ("uncertainty", "error")])
        pairs.append(pair / max(pair.max(), 1e-12))
    return tuple(np.mean(pairs, axis=0))


def coverage_plot(rows: list[dict], quantity: str) -> Markup:
    """Coverage less the nominal level, with two standard errors over test views."""
    levels = np.array(rows[0]["intervals"][quantity]["levels"])
    figure, axes = _axes()
    axes.axhline(0.0, color=plots.BLACK, linewidth=1.2, linestyle="--")
    style = plots.policy_style(models_of(rows))
    for number, (model, (colour, marker)) in enumerate(style.items()):
        x = np.arange(len(levels)) + SPREAD * ((number + 0.5) / len(style) - 0.5)
        shares, errors = (
            interval_mean(rows, model, quantity, key) for key in ("coverage", "coverage_stderr")
        )
        bars = {"yerr": 200.0 * np.nan_to_num(errors), "elinewidth": 1.4, "capsize": 2.5}
        look = {"color": colour, "marker": marker, "markersize": 5.5, "linestyle": "none"}
        axes.errorbar(x, 100.0 * (shares - levels), label=model, **look, **bars)
    axes.set(title="Coverage minus level (percentage points)", xlabel="level")
    axes.set_xticks(range(len(levels)), [f"{level:.0%}" for level in levels])
    axes.legend()
    return plots.to_svg(figure, salt=f"coverage-{quantity}", label=f"Coverage of {quantity}")


# --- pictures ---


def view_plots(pictures: dict[str, dict]) -> list[Markup]:
    """Of each test view with pictures: truth, render, error and uncertainty of every model."""
    drawn, first = [], next(iter(pictures.values()))
    for i, name in enumerate(first.get("names", ())):
        rows = []
        for model, arrays in pictures.items():
            top = np.percentile(np.concatenate([u.ravel() for u in arrays["uncertainty"]]), 99.0)
            panels = [
                Panel("truth", arrays["truth"][i] / 255.0),
                Panel("render", arrays["rgb"][i] / 255.0),
                Panel("colour error", arrays["error"][i], ERROR_MAP, (0.0, ERROR_LIMIT)),
                Panel("half-width", arrays["half"][i], ERROR_MAP, (0.0, ERROR_LIMIT)),
                Panel("uncertainty", arrays["uncertainty"][i], UNCERTAINTY_MAP, (0.0, top)),
            ]
            rows.append((model, panels))
        drawn.append(plots.to_svg(panel_table(rows), salt=f"view-{i}", label=f"Test view {name}"))
    return drawn
