"""One test view with its band: numbers for the result file, and what the page shows of them."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bavs_jax.uncertainty.bands import RenderCalibration, add_bands
from experiments.report import plots
from experiments.report.pictures import UNCERTAINTY_MAP, colourise, png_uri

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
        *(x, value - half, value + half),
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
