"""Plots of the page: sparsification, coverage, and bands of one row of an image."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, PercentFormatter

from bavs_jax.metrics.ause import removal_fractions
from bavs_jax.uncertainty.bands import RenderCalibration, add_bands
from experiments.report import plots
from experiments.report.pictures import UNCERTAINTY_MAP, colourise, png_uri
from experiments.uncertain.results import interval_values, known_quantities, mean_curves, models_of


def curve_plot(curves: dict[str, list[dict]], field: str, variant: str, title: str) -> str:
    """Error of the pixels that are left, for each model, against what is taken away.

    Args:
      curves: by model, the arrays of each seed.
      field: "own" or "common".
      variant: which AUSE.
      title: what is drawn, in words.
    """
    style = plots.policy_style(list(curves))
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    best = None
    for model, arrays in curves.items():
        by_uncertainty, best = mean_curves(arrays, field, variant)
        colour, marker = style[model]
        axes.plot(
            removal_fractions(len(by_uncertainty)),
            by_uncertainty,
            color=colour,
            linewidth=2.0,
            marker=marker,
            markevery=(3, 14),
            markersize=5,
            markeredgecolor="white",
            label=model,
        )
        if field == "common":
            continue
        axes.plot(removal_fractions(len(best)), best, color=colour, linewidth=1.0, linestyle=":")
    if field == "common" and best is not None:
        fractions = removal_fractions(len(best))
        axes.plot(
            fractions, best, color=plots.GREY, linestyle="--", label="order of the true error"
        )
    axes.set_xlabel("pixels taken away, the most uncertain first", fontsize=10, color="#374151")
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, None)
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=9)
    return plots.to_svg(figure, salt=f"curve-{field}", label=title)


SPREAD = 0.62  # of the distance between two levels that the models of one level fill
LABEL = {"fontsize": 10, "color": "#374151"}


def coverage_plot(rows: list[dict]) -> str:
    """Coverage less the nominal level, with two standard errors over test views; a panel each."""
    figure, panels = _panels(rows, 1)
    for (axes,), quantity in zip(panels.T, known_quantities(rows)):
        levels = rows[0]["intervals"][quantity]["levels"]
        num_views = rows[0]["intervals"][quantity]["num_calibration_views"]
        axes.axhline(0.0, color=plots.BLACK, linewidth=1.2, linestyle="--")
        axes.axhspan(-2.0, 2.0, color="#f1f5f9", zorder=0)
        for model, colour, marker, x in _positions(rows, levels):
            shares, errors = (
                interval_values(rows, model, quantity, key)
                for key in ("coverage", "coverage_stderr")
            )
            axes.errorbar(
                x,
                100.0 * (shares.mean(0) - levels),
                yerr=200.0 * np.nan_to_num(errors.mean(0)),
                color=colour,
                marker=marker,
                markersize=5.5,
                linestyle="none",
                elinewidth=1.4,
                capsize=2.5,
                label=model,
            )
        axes.set_title(f"{quantity}: coverage from {num_views} views", fontsize=10.5, loc="left")
        axes.set_xlabel("nominal level", **LABEL)
        _level_axis(axes, levels)
    panels[0, 0].set_ylabel("coverage − nominal (percentage points)", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="coverage", label="Coverage against the nominal level")


def width_plot(rows: list[dict]) -> str:
    """Mean width and interval score as shares of those of one width for all pixels."""
    figure, panels = _panels(rows, 2)
    names = (("width_ratio", "mean width"), ("score_ratio", "interval score"))
    for column, quantity in zip(panels.T, known_quantities(rows)):
        levels = rows[0]["intervals"][quantity]["levels"]
        for axes, (key, words) in zip(column, names):
            axes.axhline(1.0, color=plots.BLACK, linewidth=1.2, linestyle="--")
            top = 1.0
            for model, colour, marker, x in _positions(rows, levels):
                ratios = interval_values(rows, model, quantity, key)
                axes.plot(x, ratios.mean(0), marker, color=colour, markersize=6, label=model)
                axes.vlines(x, ratios.min(0), ratios.max(0), color=colour, linewidth=1.4)
                top = np.nanmax([top, *ratios.ravel()])
            axes.set_title(f"{quantity}: {words}", fontsize=10.5, loc="left")
            axes.set_ylim(0.0, 1.08 * top)
            _level_axis(axes, levels)
        column[-1].set_xlabel("nominal level", **LABEL)
    for axes in panels[:, 0]:
        axes.set_ylabel("share of constant width's", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="width", label="Widths and interval scores")


def decile_plot(rows: list[dict], level: float) -> str:
    """Coverage at one level in each tenth of the pixels, from the least uncertain up."""
    figure, panels = _panels(rows, 1)
    style, tenths = plots.policy_style(models_of(rows)), np.arange(1, 11)
    for (axes,), quantity in zip(panels.T, known_quantities(rows)):
        row = int(np.argmin(np.abs(np.array(rows[0]["intervals"][quantity]["levels"]) - level)))
        axes.axhline(100.0 * level, color=plots.BLACK, linewidth=1.2, linestyle="--")
        first = models_of(rows)[0]
        constant = interval_values(rows, first, quantity, "constant_decile_coverage")
        axes.plot(
            tenths,
            100.0 * constant.mean(0)[row],
            color=plots.GREY,
            linestyle=":",
            linewidth=2.0,
            label=f"constant width, by {first}",
        )
        for model, (colour, marker) in style.items():
            shares = interval_values(rows, model, quantity, "decile_coverage").mean(0)[row]
            axes.plot(
                tenths,
                100.0 * shares,
                color=colour,
                marker=marker,
                markersize=5,
                markeredgecolor="white",
                linewidth=1.6,
                label=model,
            )
        axes.set_title(
            f"{quantity}: coverage at {level:.0%} by uncertainty", fontsize=10.5, loc="left"
        )
        axes.set_xlabel("tenth of the pixels, least uncertain first", **LABEL)
        axes.xaxis.set_major_locator(FixedLocator(tenths))
        axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
        plots.tidy(axes)
    panels[0, 0].set_ylabel("coverage (%)", **LABEL)
    _legend(figure, panels)
    return plots.to_svg(figure, salt="deciles", label="Coverage in each tenth of the pixels")


def _panels(rows: list[dict], num_rows: int):
    num = len(known_quantities(rows))
    figure = Figure(figsize=(5.3 * num, 0.7 + 3.1 * num_rows), layout="constrained")
    return figure, figure.subplots(num_rows, num, squeeze=False)


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
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)


def _legend(figure, panels) -> None:
    handles, labels = panels[0, 0].get_legend_handles_labels()
    options = {"loc": "outside upper left", "ncols": 6, "frameon": False, "fontsize": 9}
    figure.legend(handles, labels, **options)


LEVEL = 0.9
DEPTH_MAP = "viridis"
# Blue is inside, vermilion outside, grey without a truth or a band.
INSIDE, OUTSIDE, UNKNOWN = (0, 114, 178), (213, 94, 0), (190, 194, 200)


def band_arrays(scene, calibration: RenderCalibration, view: int, image: dict) -> dict:
    """What is rendered of a view, the half-width of its band at `LEVEL` and the truth, [H, W] each.

    Of depth if it was calibrated, else of colour: the channel that is farthest off at each pixel.
    NaN where a pixel has no band, or no known truth.
    """
    banded, true_depth = add_bands(calibration, image, LEVEL), scene.depth_image(view)
    if calibration.depth is not None and true_depth is not None and (true_depth > 0.0).any():
        quantity, value, half = "depth", banded["depth"], banded["depth_half"]
        truth = np.where(true_depth > 0.0, true_depth, np.nan)
    else:
        quantity, half = "colour", banded["rgb_half"]
        rgb, true_rgb = np.clip(banded["rgb"], 0.0, 1.0), scene.image(view) / 255.0
        worst = np.abs(rgb - true_rgb).argmax(-1)[..., None]
        value, truth = (np.take_along_axis(x, worst, -1)[..., 0] for x in (rgb, true_rgb))
    mask = scene.mask_image(view)
    if mask is not None:
        truth = np.where(mask, truth, np.nan)
    arrays = {"value": np.where(np.isnan(half), np.nan, value), "half": half, "truth": truth}
    arrays = {f"band_{name}": x.astype(np.float32) for name, x in arrays.items()}
    return arrays | {"band_name": np.array(scene.names[view]), "band_quantity": np.array(quantity)}


def band_strip(arrays: dict[str, np.ndarray]) -> dict:
    """Render, half-width, error on the same scale, and where the truth is outside."""
    value, half, truth = (arrays[f"band_{name}"] for name in ("value", "half", "truth"))
    quantity, error = str(arrays["band_quantity"]), np.abs(value - truth)
    unit = "scene units" if quantity == "depth" else "of 0 to 1"
    low, high = _ends(np.where(np.isfinite(truth), value, np.nan), 1.0)
    top = max(_ends(half, 2.0)[1], 1e-12)
    known = np.isfinite(error)
    verdict = np.where(known, np.where(error <= half, 0, 1), 2)
    share = f"{np.mean(error[known] <= half[known]):.1%}" if known.any() else "no pixel"
    shown = (
        (
            f"rendered {quantity}, {low:.2f} (dark) to {high:.2f} (bright) {unit}",
            colourise(value, low, high, DEPTH_MAP),
        ),
        (
            f"half-width at {LEVEL:.0%}, 0 to {top:.3g} {unit} (bright)",
            colourise(half, 0.0, top, UNCERTAINTY_MAP),
        ),
        ("error, on the scale of the half-width", colourise(error, 0.0, top, UNCERTAINTY_MAP)),
        (
            f"truth inside (blue, {share}) or outside (vermilion)",
            np.array([INSIDE, OUTSIDE, UNKNOWN], np.uint8)[verdict],
        ),
    )
    return {
        "name": str(arrays["band_name"]),
        "quantity": quantity,
        "images": [(caption, png_uri(image)) for caption, image in shown],
    }


def scanline_plot(arrays: dict[str, np.ndarray], model: str) -> str:
    """The image row with the most known pixels: render, band and truth along it."""
    value, half, truth = (arrays[f"band_{name}"] for name in ("value", "half", "truth"))
    known = np.isfinite(value) & np.isfinite(truth)
    row = int(known.sum(-1).argmax())
    quantity = str(arrays["band_quantity"])
    x, value, half, truth = np.arange(value.shape[1]), value[row], half[row], truth[row]
    is_outside = np.abs(value - truth) > half
    figure = Figure(figsize=(10.6, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.fill_between(
        x,
        value - half,
        value + half,
        color=plots.SKY,
        alpha=0.45,
        linewidth=0,
        step="mid",
        label=f"band at {LEVEL:.0%}",
    )
    axes.step(x, value, where="mid", color=plots.BLUE, linewidth=1.6, label=f"rendered {quantity}")
    for chosen, colour, marker, label in (
        (~is_outside, plots.BLACK, ".", "truth, inside"),
        (is_outside, plots.VERMILION, "x", "truth, outside"),
    ):
        axes.plot(x[chosen], truth[chosen], marker, color=colour, markersize=5, label=label)
    ends = _ends(np.stack([value - half, value + half])[:, known[row]], 2.0)
    ends = (np.nanmin([ends[0], *truth[known[row]]]), np.nanmax([ends[1], *truth[known[row]]]))
    if np.isfinite(ends).all() and ends[0] < ends[1]:
        margin = 0.06 * (ends[1] - ends[0])
        axes.set_ylim(ends[0] - margin, ends[1] + margin)
    if known[row].any():
        places = np.flatnonzero(known[row])
        axes.set_xlim(places[0] - 2.5, places[-1] + 2.5)
    unit = "scene units" if quantity == "depth" else "farthest channel, 0 to 1"
    axes.set_xlabel(f"pixel of image row {row}", fontsize=10, color="#374151")
    axes.set_ylabel(f"{quantity} ({unit})", fontsize=10, color="#374151")
    axes.set_title(
        f"{model}: one row of {arrays['band_name']}",
        fontsize=10.5,
        loc="left",
    )
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=9, ncols=4, loc="lower left", bbox_to_anchor=(0.45, 1.0))
    return plots.to_svg(figure, salt="scanline", label="Band and truth along an image row")


def _ends(values, percent: float) -> tuple[float, float]:
    """A low and a high percentile of the finite values; 0 and 1 of none."""
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    return tuple(float(v) for v in np.percentile(values, (percent, 100.0 - percent)))
