"""The page of `evaluate_uncertainty`: sparsification, coverage, and views with their bands."""

from __future__ import annotations

import pathlib

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, PercentFormatter

from bavs_jax.metrics.ause import removal_fractions
from experiments.files import cut_pictures
from experiments.reporting import plots
from experiments.reporting.page import FOLDER, write_template
from experiments.reporting.pictures import (
    ERROR_LIMIT,
    ERROR_MAP,
    UNCERTAINTY_MAP,
    Picture,
    colourise,
    png_uri,
    shrink,
)
from experiments.reporting.uncertainty_tables import (
    FIELDS,
    QUANTITIES,
    ause_table,
    coverage_table,
    interval_values,
    known_quantities,
    known_variants,
    models_of,
    split_words,
    summary_table,
)

MAX_SIDE = 240  # pixels of a picture
LEVEL = 0.9  # of the bands that are shown
SPREAD = 0.62  # of the distance between two levels that the models of one level fill
DEPTH_MAP = "viridis"
# Blue is inside, vermilion outside, grey without a truth or a band.
INSIDE, OUTSIDE, UNKNOWN = (0, 114, 178), (213, 94, 0), (190, 194, 200)


def write_page(path: pathlib.Path, result: dict, *, arrays: dict, variant: str) -> None:
    """Curves, tables of every variant, calibrated intervals, and pictures of some views.

    Args:
      path: where to.
      result: what the result file holds.
      arrays: by model, the arrays of each seed; pictures are those of the first seed.
      variant: the AUSE that is shown first.
    """
    rows = result["rows"]
    variants = known_variants(rows)
    variant = variant if variant in variants else variants[0]
    pictures = {model: cut_pictures(found[0]) for model, found in arrays.items()}
    shown = models_of(rows)[0]
    write_template(
        path,
        FOLDER / "uncertainty.html",
        title=title(result),
        result=result,
        variant=variant,
        summary=summary_table(rows),
        plots=[curve_plot(arrays, field, variant) for field in FIELDS],
        variants=[(name, ause_table(rows, name)) for name in variants],
        split=split_words(result),
        coverage=[coverage_table(rows, quantity) for quantity in known_quantities(rows)],
        coverage_plots=[coverage_plot(rows), width_plot(rows), decile_plot(rows)],
        left_out=_left_out_words(rows),
        shown=shown,
        band=band_strip(pictures[shown]),
        scanline=scanline_plot(pictures[shown], shown),
        strips=[strip for model in pictures for strip in view_strips(model, pictures[model])],
    )


def title(result: dict) -> str:
    """What was measured, in plain words."""
    rows, config = result["rows"], result["config"]
    width, height = result["image_size"]
    # The scene that comes with the project is called like its loader.
    scene = config["scene"] if result["kind"] == result["scene"] else result["scene"]
    kind = {"procedural": "procedural scene", "blender": "NeRF-synthetic scene"}
    kind = kind.get(result["kind"], f"scene of the {result['kind']} layout")
    seeds = sorted({row["seed"] for row in rows})
    views = [row["num_views"] for row in rows]
    fewest, most = min(views), max(views)
    return (
        f"{scene} ({kind}, {width} x {height} pixels), "
        f"{fewest}{f' to {most}' if most > fewest else ''} training views, "
        f"{config['train']['num_steps']} optimiser steps, "
        f"{len(seeds)} seed{'s' * (len(seeds) > 1)} ({', '.join(map(str, seeds))})"
    )


def _left_out_words(rows: list[dict]) -> str:
    """How many test pixels have no interval, and how wrong they are, of the first model."""
    model, parts = rows[0]["model"], []
    for quantity in known_quantities(rows):
        share, error = (
            interval_values(rows, model, quantity, key)
            for key in ("share_with_band", "error_without_band")
        )
        known = error[np.isfinite(error)]
        mean = f", mean error {known.mean():.3g} {QUANTITIES[quantity]}" if known.size else ""
        parts.append(f"{quantity} {1.0 - share.mean():.1%}{mean}")
    return f"Pixels with a known truth but without an interval ({model}): {'; '.join(parts)}."


# --- sparsification and coverage ---


def curve_plot(curves: dict[str, list[dict]], field: str, variant: str) -> Markup:
    """Error of the pixels that are left, for each model, against what is taken away.

    Args:
      curves: by model, the arrays of each seed.
      field: "own" or "common".
      variant: which AUSE.
    """
    figure = Figure(figsize=(6.2, 4.2))
    axes = figure.add_subplot()
    for model, (colour, marker) in plots.policy_style(list(curves)).items():
        by_uncertainty, best = mean_curves(curves[model], field, variant)
        fractions = removal_fractions(len(best))
        look = {"linewidth": 2.0, "marker": marker, "markevery": (3, 14), "markersize": 5}
        axes.plot(fractions, by_uncertainty, color=colour, label=model, **look, **plots.DOT)
        if field == "own":
            axes.plot(fractions, best, color=colour, linewidth=1.0, linestyle=":")
    if field == "common":
        look = {"color": plots.GREY, "linestyle": "--", "label": "order of the true error"}
        axes.plot(fractions, best, **look)
    axes.set_xlabel("pixels taken away, the most uncertain first")
    words = f"Error of what is left, {FIELDS[field]}"
    axes.set_title(words)
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, None)
    plots.tidy(axes, "y")
    axes.legend()
    return plots.to_svg(figure, salt=f"curve-{field}", label=words)


def mean_curves(arrays: list[dict], field: str, variant: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean over seeds of both curves, each seed divided by its own largest value."""
    pairs = []
    for one in arrays:
        a, b = (one[f"{field}_{variant}_by_{what}"] for what in ("uncertainty", "error"))
        largest = max(a.max(), b.max(), 1e-12)
        pairs.append((a / largest, b / largest))
    return tuple(np.mean(curves, axis=0) for curves in zip(*pairs))


def coverage_plot(rows: list[dict]) -> Markup:
    """Coverage less the nominal level, with two standard errors over test views; a panel each."""
    figure, panels = _panels(rows, 1, 0.0)
    for axes, quantity in zip(panels[0], known_quantities(rows)):
        levels = rows[0]["intervals"][quantity]["levels"]
        num_views = rows[0]["intervals"][quantity]["num_calibration_views"]
        axes.axhspan(-2.0, 2.0, color="#f1f5f9", zorder=0)
        for model, colour, marker, x in _positions(rows, levels):
            shares, errors = (
                interval_values(rows, model, quantity, key).mean(0)
                for key in ("coverage", "coverage_stderr")
            )
            look = {"color": colour, "marker": marker, "markersize": 5.5, "linestyle": "none"}
            bars = {"yerr": 200.0 * np.nan_to_num(errors), "elinewidth": 1.4, "capsize": 2.5}
            axes.errorbar(x, 100.0 * (shares - levels), label=model, **look, **bars)
        axes.set_title(f"{quantity}: coverage from {num_views} views")
        _level_axis(axes, levels)
    panels[0, 0].set_ylabel("coverage − nominal (percentage points)")
    return _finish(
        figure, panels, "nominal level", "coverage", "Coverage against the nominal level"
    )


def width_plot(rows: list[dict]) -> Markup:
    """Mean width and interval score as shares of those of one width for all pixels."""
    figure, panels = _panels(rows, 2, 1.0)
    names = (("width_ratio", "mean width"), ("score_ratio", "interval score"))
    for row, (key, words) in zip(panels, names):
        for axes, quantity in zip(row, known_quantities(rows)):
            levels, top = rows[0]["intervals"][quantity]["levels"], 1.0
            for model, colour, marker, x in _positions(rows, levels):
                ratios = interval_values(rows, model, quantity, key)
                axes.plot(x, ratios.mean(0), marker, color=colour, markersize=6, label=model)
                axes.vlines(x, ratios.min(0), ratios.max(0), color=colour, linewidth=1.4)
                top = np.nanmax([top, *ratios.ravel()])
            axes.set_title(f"{quantity}: {words}")
            axes.set_ylim(0.0, 1.08 * top)
            _level_axis(axes, levels)
        row[0].set_ylabel("share of constant width's")
    return _finish(figure, panels, "nominal level", "width", "Widths and interval scores")


def decile_plot(rows: list[dict]) -> Markup:
    """Coverage at `LEVEL` in each tenth of the pixels, from the least uncertain up."""
    figure, panels = _panels(rows, 1, 100.0 * LEVEL)
    style, tenths = plots.policy_style(models_of(rows)), np.arange(1, 11)
    for axes, quantity in zip(panels[0], known_quantities(rows)):
        levels = np.array(rows[0]["intervals"][quantity]["levels"])
        row = int(np.argmin(np.abs(levels - LEVEL)))
        first = next(iter(style))
        constant = interval_values(rows, first, quantity, "constant_decile_coverage").mean(0)[row]
        look = {"color": plots.GREY, "linestyle": ":", "linewidth": 2.0}
        axes.plot(tenths, 100.0 * constant, label=f"constant width, by {first}", **look)
        for model, (colour, marker) in style.items():
            shares = interval_values(rows, model, quantity, "decile_coverage").mean(0)[row]
            look = {"color": colour, "marker": marker, "markersize": 5, "linewidth": 1.6}
            axes.plot(tenths, 100.0 * shares, label=model, **look, **plots.DOT)
        axes.set_title(f"{quantity}: coverage at {LEVEL:.0%} by uncertainty")
        axes.xaxis.set_major_locator(FixedLocator(tenths))
    panels[0, 0].set_ylabel("coverage (%)")
    words = "tenth of the pixels, least uncertain first"
    return _finish(figure, panels, words, "deciles", "Coverage in each tenth of the pixels")


def _panels(rows: list[dict], num_rows: int, line: float):
    """A column of panels for each quantity, with a dashed line across."""
    num = len(known_quantities(rows))
    figure = Figure(figsize=(5.3 * num, 0.7 + 3.1 * num_rows))
    panels = figure.subplots(num_rows, num, squeeze=False)
    for axes in panels.flat:
        axes.axhline(line, color=plots.BLACK, linewidth=1.2, linestyle="--")
        plots.tidy(axes, "y")
    return figure, panels


def _positions(rows: list[dict], levels):
    """Each model with colour, marker and where it stands beside the others at each level."""
    style = plots.policy_style(models_of(rows))
    for number, (model, (colour, marker)) in enumerate(style.items()):
        offset = SPREAD * ((number + 0.5) / len(style) - 0.5)
        yield model, colour, marker, np.arange(len(levels)) + offset


def _level_axis(axes, levels) -> None:
    axes.xaxis.set_major_locator(FixedLocator(range(len(levels))))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{level:.0%}" for level in levels]))
    axes.set_xlim(-0.5, len(levels) - 0.5)


def _finish(figure: Figure, panels, xlabel: str, salt: str, label: str) -> Markup:
    """One legend for all panels, and what is below the last of them."""
    for axes in panels[-1]:
        axes.set_xlabel(xlabel)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=6)
    return plots.to_svg(figure, salt=salt, label=label)


# --- one test view with its band, and pictures ---


def band_strip(arrays: dict[str, np.ndarray]) -> dict:
    """Render, half-width, error on the same scale, and where the truth is outside.

    Args:
      arrays: with those of `band_arrays`.
    """
    value, half, truth = (arrays[f"band_{name}"] for name in ("value", "half", "truth"))
    quantity, error = str(arrays["band_quantity"]), np.abs(value - truth)
    unit = QUANTITIES[quantity]
    low, high = _ends(np.where(np.isfinite(truth), value, np.nan), 1.0)
    top = max(_ends(half, 2.0)[1], 1e-12)
    known = np.isfinite(error)
    verdict = np.where(known, np.where(error <= half, 0, 1), 2)
    share = f"{np.mean(error[known] <= half[known]):.1%}" if known.any() else "no pixel"
    shown = {
        f"rendered {quantity}, {low:.2f} (dark) to {high:.2f} (bright) {unit}": colourise(
            value, low, high, DEPTH_MAP
        ),
        f"half-width at {LEVEL:.0%}, 0 to {top:.3g} {unit} (bright)": colourise(
            half, 0.0, top, UNCERTAINTY_MAP
        ),
        "error, on the scale of the half-width": colourise(error, 0.0, top, UNCERTAINTY_MAP),
        f"truth inside (blue, {share}) or outside (vermilion)": np.array(
            [INSIDE, OUTSIDE, UNKNOWN], np.uint8
        )[verdict],
    }
    images = [Picture(png_uri(image), caption) for caption, image in shown.items()]
    return {"name": str(arrays["band_name"]), "quantity": quantity, "images": images}


def scanline_plot(arrays: dict[str, np.ndarray], model: str) -> Markup:
    """The image row with the most known pixels: render, band and truth along it."""
    value, half, truth = (arrays[f"band_{name}"] for name in ("value", "half", "truth"))
    known = np.isfinite(value) & np.isfinite(truth)
    row = int(known.sum(-1).argmax())
    quantity = str(arrays["band_quantity"])
    x, known, value, half, truth = (
        np.arange(value.shape[1]),
        *(array[row] for array in (known, value, half, truth)),
    )
    is_outside = np.abs(value - truth) > half
    figure = Figure(figsize=(10.6, 3.3))
    axes = figure.add_subplot()
    look = {"color": plots.SKY, "alpha": 0.45, "linewidth": 0, "step": "mid"}
    axes.fill_between(x, value - half, value + half, label=f"band at {LEVEL:.0%}", **look)
    look = {"color": plots.BLUE, "linewidth": 1.6, "where": "mid"}
    axes.step(x, value, label=f"rendered {quantity}", **look)
    for chosen, colour, marker, label in (
        (~is_outside, plots.BLACK, ".", "truth, inside"),
        (is_outside, plots.VERMILION, "x", "truth, outside"),
    ):
        axes.plot(x[chosen], truth[chosen], marker, color=colour, markersize=5, label=label)
    ends = _ends(np.stack([value - half, value + half])[:, known], 2.0)
    ends = (np.nanmin([ends[0], *truth[known]]), np.nanmax([ends[1], *truth[known]]))
    if np.isfinite(ends).all() and ends[0] < ends[1]:
        margin = 0.06 * (ends[1] - ends[0])
        axes.set_ylim(ends[0] - margin, ends[1] + margin)
    if known.any():
        axes.set_xlim(x[known][0] - 2.5, x[known][-1] + 2.5)
    unit = "scene units" if quantity == "depth" else "farthest channel, 0 to 1"
    axes.set_xlabel(f"pixel of image row {row}")
    axes.set_ylabel(f"{quantity} ({unit})")
    axes.set_title(f"{model}: one row of {arrays['band_name']}")
    plots.tidy(axes, "y")
    axes.legend(ncols=4, loc="lower left", bbox_to_anchor=(0.45, 1.0))
    return plots.to_svg(figure, salt="scanline", label="Band and truth along an image row")


def _ends(values, percent: float) -> tuple[float, float]:
    """A low and a high percentile of the finite values; 0 and 1 of none."""
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    return tuple(float(v) for v in np.percentile(values, (percent, 100.0 - percent)))


def view_strips(model: str, arrays: dict[str, np.ndarray]) -> list[dict]:
    """For each view: truth, render, error and uncertainty on the model's own scale.

    Args:
      model: its name.
      arrays: of one seed; without pictures if none were asked for.
    """
    strips = []
    for i, name in enumerate(arrays.get("names", ())):
        top = np.percentile(np.concatenate([u.ravel() for u in arrays["uncertainty"]]), 99.0)
        error, uncertainty = arrays["error"][i], arrays["uncertainty"][i]
        shown = {
            "truth": arrays["truth"][i],
            "render": arrays["rgb"][i],
            "colour error": colourise(error, 0.0, ERROR_LIMIT, ERROR_MAP),
            "uncertainty": colourise(uncertainty, 0.0, top, UNCERTAINTY_MAP),
        }
        images = [Picture(png_uri(shrink(image, MAX_SIDE)), c) for c, image in shown.items()]
        strips.append({"name": f"{model}, {name}", "images": images})
    return strips
