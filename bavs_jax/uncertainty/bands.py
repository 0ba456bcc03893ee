"""Renders with error bars: the lower and the upper end of colour and depth at a level.

`calibrate_renders` learns them from renders of views with a truth, `add_bands` puts them around the
render of any view. What belongs to a field and an uncertainty model is one `RenderCalibration`.

A pixel has a band where its ray meets something. Where nothing is rendered every uncertainty model
says 0, the colour is the background's and there is no depth; counted in, these pixels would fill
half of many images and meet any level without telling anything.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bavs_jax.uncertainty.conformal import LEVELS, Calibrated, calibrate, half_width, interval
from bavs_jax.uncertainty.conformal_report import to_json
from bavs_jax.uncertainty.conformal_scale import Scale, ViewErrors

MIN_OPACITY = 1.0 / 255.0  # what covers less changes no colour of 8 bits
QUANTITIES = {"colour": (0.0, 1.0), "depth": (0.0, np.inf)}  # and what the truth lies in


class RenderCalibration(NamedTuple):
    """Intervals of one field by one uncertainty model."""

    colour: Calibrated  # of the largest error over the channels, colours in 0 .. 1
    depth: Calibrated | None  # scene units; None where no depth is known to learn it from
    depth_factor: float = 1.0  # rendered depth times this has the unit of the true one


def uncertainty_of(quantity: str, image: dict) -> np.ndarray:
    """The uncertainty [...] of "colour" or "depth": a model may have one for depth by itself."""
    own = quantity == "depth" and "depth_uncertainty" in image
    return np.asarray(image["depth_uncertainty" if own else "uncertainty"])


def has_band(quantity: str, image: dict) -> np.ndarray:
    """Whether each pixel [...] has a band: its ray meets something, its uncertainty is finite."""
    return (image["opacity"] >= MIN_OPACITY) & np.isfinite(uncertainty_of(quantity, image))


def render_errors(
    quantity: str, image: dict, truth, known=None, *, depth_factor: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Absolute error [...] of each pixel of a render, and where [...] the truth is known.

    Args:
      quantity: "colour": the largest error over the channels, so that a band holds all three; or
        "depth".
      image: of one view "rgb" [..., 3] and "depth" [...], all its pixels or some.
      truth: as "rgb", in 0 .. 1; or as "depth", scene units, 0 where unknown.
      known: [...] bool, False where the truth does not count; None where all of it does.
      depth_factor: of the rendered depth.
    """
    truth = np.asarray(truth, np.float64)
    if quantity == "depth":
        errors, counts = np.abs(depth_factor * image["depth"] - truth), truth > 0.0
    else:
        errors = np.abs(np.clip(image["rgb"], 0.0, 1.0) - truth).max(-1)
        counts = np.ones(errors.shape, bool)
    return errors, counts if known is None else counts & known


def band_errors(
    quantity: str, image: dict, truth, known=None, *, depth_factor: float = 1.0
) -> ViewErrors | None:
    """What `calibrate_renders` learns from of one view: pixels with a band and a known truth.

    Args:
      quantity, truth, known, depth_factor: see `render_errors`.
      image: further "opacity", "uncertainty" and maybe "depth_uncertainty", see `has_band`.

    Returns:
      errors and uncertainty, or None where no pixel has both.
    """
    errors, counts = render_errors(quantity, image, truth, known, depth_factor=depth_factor)
    counts = counts & has_band(quantity, image)
    if not counts.any():
        return None
    return ViewErrors(errors[counts], uncertainty_of(quantity, image)[counts].astype(np.float64))


def calibrate_renders(
    fit: dict[str, Sequence[ViewErrors]],
    calibration: dict[str, Sequence[ViewErrors]],
    *,
    scale: str = "isotonic",
    levels: Sequence[float] = LEVELS,
    depth_factor: float = 1.0,
) -> RenderCalibration:
    """Intervals of colour, and of depth where both groups have it; see `calibrate`.

    Args:
      fit: "colour" and maybe "depth": of each view, what `band_errors` gave.
      calibration: likewise, of other views.
      scale: see `fit_scale`.
      levels: see `calibrate`.
      depth_factor: the one that the depth errors were made with.

    Raises:
      ValueError: as `calibrate`.
    """

    def of(quantity):
        return calibrate(fit[quantity], calibration[quantity], scale=scale, levels=levels)

    has_depth = bool(fit.get("depth")) and bool(calibration.get("depth"))
    return RenderCalibration(of("colour"), of("depth") if has_depth else None, depth_factor)


def add_bands(calibration: RenderCalibration, image: dict, level: float) -> dict[str, np.ndarray]:
    """A rendered view with the band that holds the truth of a pixel at a level.

    Args:
      calibration: of the same field and uncertainty model.
      image: what the model rendered: "rgb" [..., 3], "depth", "opacity" and "uncertainty" [...],
        and "depth_uncertainty" where it has one.
      level: one of those that were calibrated.

    Returns:
      the image and, beside it, "rgb_lower" and "rgb_upper" [..., 3] within 0 .. 1, "rgb_half"
      [...]; and if depth was calibrated "depth_lower", "depth_upper" and "depth_half" [...], scene
      units, with "depth" in that unit too. NaN where a pixel has no band (see `has_band`).

    Raises:
      ValueError: not a level that was calibrated.

    Numerics: "rgb_half" and "depth_half" are those before the band is cut to what a truth can be.
    """
    found = dict(image)
    if calibration.depth is not None:
        found["depth"] = calibration.depth_factor * image["depth"]
    for quantity, name in (("colour", "rgb"), ("depth", "depth")):
        calibrated = getattr(calibration, quantity)
        if calibrated is None:
            continue
        banded = has_band(quantity, image)
        values = np.asarray(uncertainty_of(quantity, image))[banded]
        ends = interval(calibrated, found[name][banded], values, level, bounds=QUANTITIES[quantity])
        for end, part in zip(("lower", "upper"), ends):
            found[f"{name}_{end}"] = _filled(banded, part)
        found[f"{name}_half"] = _filled(banded, half_width(calibrated, values, level))
    return found


def calibration_to_json(calibration: RenderCalibration) -> dict:
    """As dicts, lists and numbers; infinite factors become None."""
    return to_json(calibration)


def calibration_from_json(values: dict) -> RenderCalibration:
    """The inverse of `calibration_to_json`.

    Raises:
      ValueError: an entry is missing or of the wrong kind.
    """
    try:
        depth = values["depth"] and _calibrated(values["depth"])
        return RenderCalibration(
            _calibrated(values["colour"]), depth, float(values["depth_factor"])
        )
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"calibration: no such entry, or of the wrong kind: {error}; make it anew"
        ) from None


def _calibrated(values: dict) -> Calibrated:
    scale = values["scale"]
    knots, heights = (np.asarray(scale[name], np.float64) for name in ("knots", "values"))
    return Calibrated(
        levels=np.asarray(values["levels"], np.float64),
        factors=_with_infinity(values["factors"]),
        scale=Scale(str(scale["name"]), knots, heights, float(scale["floor"])),
        constant_half_widths=_with_infinity(values["constant_half_widths"]),
        num_views=int(values["num_views"]),
    )


def _with_infinity(values) -> np.ndarray:
    return np.array([np.inf if value is None else value for value in values], np.float64)


def _filled(where, values) -> np.ndarray:
    """Values at the marked pixels, NaN at the others."""
    full = np.full((*where.shape, *values.shape[1:]), np.nan)
    full[where] = values
    return full
