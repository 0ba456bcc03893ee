"""Test views side by side: truth, render, error and uncertainty, as embedded PNG."""

from __future__ import annotations

import base64
import dataclasses
import io

import numpy as np
from matplotlib import colormaps
from PIL import Image

MAX_VIEWS = 4
ERROR_LIMIT = 0.25  # the same in every report, so that pages can be laid side by side
ERROR_MAP, UNCERTAINTY_MAP = "magma", "cividis"


@dataclasses.dataclass(frozen=True)
class Picture:
    """One image of a strip."""

    uri: str
    alt: str
    caption: str


@dataclasses.dataclass(frozen=True)
class Strip:
    """One test view: truth, render, error and uncertainty."""

    name: str
    pictures: tuple[Picture, ...]


@dataclasses.dataclass(frozen=True)
class ColourBar:
    """A scale with the values at its ends."""

    uri: str
    label: str
    low: str
    high: str


def png_uri(image: np.ndarray) -> str:
    """[H, W, 3] uint8 as a `data:` address that stands in the page itself."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png", optimize=True)
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def colourise(values: np.ndarray, low: float, high: float, name: str) -> np.ndarray:
    """[H, W] values as [H, W, 3] uint8 colours; grey where a value is not finite."""
    scaled = (values - low) / max(high - low, 1e-12)
    rgb = colormaps[name](np.clip(np.nan_to_num(scaled, nan=0.0), 0.0, 1.0))[..., :3]
    rgb[~np.isfinite(values)] = 0.6
    return np.round(255.0 * rgb).astype(np.uint8)


def shrink(image: np.ndarray, max_side: int) -> np.ndarray:
    """Area average down to at most `max_side` pixels; smaller images stay as they are."""
    height, width = image.shape[:2]
    factor = max_side / max(height, width)
    if factor >= 1.0:
        return image
    size = (max(round(width * factor), 1), max(round(height * factor), 1))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))


def uncertainty_limits(all_pictures: list[dict[str, np.ndarray]]) -> tuple[float, float]:
    """One scale for every uncertainty image of a page, over what is seen, not the empty background.

    From the 2nd percentile of the values above half the top to the top, the 99th percentile of
    all; rounded outwards.
    """
    values = [image.ravel() for p in all_pictures for image in p["uncertainty"][:MAX_VIEWS]]
    values = np.concatenate(values) if values else np.zeros(0)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return 0.0, 1.0
    high = np.percentile(values, 99.0)
    low = np.percentile(values[values >= 0.5 * high], 2.0)
    low, high = np.floor(low * 100) / 100, np.ceil(high * 100) / 100
    return float(low), float(high if high > low else low + 0.01)


def strips(
    pictures: dict[str, np.ndarray], limits: tuple[float, float], *, max_side: int
) -> list[Strip]:
    """One strip per test view, at most four."""
    found = []
    for i in range(min(len(pictures["view_ids"]), MAX_VIEWS)):
        name = str(pictures["names"][i])
        truth, rgb = pictures["truth"][i], pictures["rgb"][i]
        error = colourise(shrink(pictures["error"][i], max_side), 0.0, ERROR_LIMIT, ERROR_MAP)
        uncertainty = shrink(pictures["uncertainty"][i], max_side)
        uncertainty = colourise(uncertainty, *limits, UNCERTAINTY_MAP)
        images = (
            Picture(png_uri(shrink(truth, max_side)), f"true image of {name}", "truth"),
            Picture(
                png_uri(shrink(rgb, max_side)),
                f"render of {name}",
                f"render, {psnr_words(rgb, truth)}",
            ),
            Picture(png_uri(error), f"error of {name}", f"error {_mean(pictures['error'][i])}"),
            Picture(
                png_uri(uncertainty),
                f"uncertainty of {name}",
                f"uncertainty {_mean(pictures['uncertainty'][i])}",
            ),
        )
        found.append(Strip(name, images))
    return found


def colour_bars(limits: tuple[float, float]) -> list[ColourBar]:
    """The scales of the error and uncertainty images."""
    ramp = np.linspace(0.0, 1.0, 256)[None]
    return [
        ColourBar(
            png_uri(colourise(ramp, 0.0, 1.0, ERROR_MAP)),
            "Error: absolute colour difference, mean of the channels (fixed scale)",
            "0",
            f"≥ {ERROR_LIMIT}",
        ),
        ColourBar(
            png_uri(colourise(ramp, 0.0, 1.0, UNCERTAINTY_MAP)),
            "Uncertainty: rendered channel in [0, 1] (one scale for this page)",
            f"≤ {limits[0]:.2f}",
            f"≥ {limits[1]:.2f}",
        ),
    ]


def psnr_words(rgb: np.ndarray, truth: np.ndarray) -> str:
    """PSNR of an image in [0, 255] against another."""
    mse = np.mean((rgb.astype(np.float64) - truth.astype(np.float64)) ** 2) / 255.0**2
    return "identical" if mse == 0.0 else f"{-10.0 * np.log10(mse):.2f} dB"


def _mean(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    return f"{finite.mean():.3f}" if finite.size else "not known"
