"""The page that shows where to stand next, and why."""

from __future__ import annotations

import pathlib

import numpy as np
from markupsafe import Markup

from experiments.reporting.page import write_template
from experiments.reporting.pictures import (
    UNCERTAINTY_MAP,
    colourise,
    png_uri,
    shrink,
    uncertainty_limits,
)

MAX_SIDE = 300  # pixels of a preview


def write_page(path: pathlib.Path, **content) -> None:
    """Fills the template; every name that it uses must be in `content`."""
    for name in ("place", "worth_curve"):
        content[name] = Markup(content[name])
    write_template(path, pathlib.Path(__file__).parent, **content)


def preview_cards(images: list[dict], rows: list[dict], sentences: list[str]) -> tuple:
    """One card per pose with its render and uncertainty, and the scale of the latter."""
    limits = uncertainty_limits([{"uncertainty": image["uncertainty"][None]} for image in images])
    cards = []
    for image, row, sentence in zip(images, rows, sentences):
        rgb = np.round(255.0 * np.clip(image["rgb"], 0.0, 1.0)).astype(np.uint8)
        uncertainty = colourise(shrink(image["uncertainty"], MAX_SIDE), *limits, UNCERTAINTY_MAP)
        cards.append(
            {
                "row": row,
                "sentence": sentence,
                "render": png_uri(shrink(rgb, MAX_SIDE)),
                "uncertainty": png_uri(uncertainty),
                "mean": f"{image['uncertainty'].mean():.3f}",
            }
        )
    ramp = colourise(np.linspace(*limits, 256)[None], *limits, UNCERTAINTY_MAP)
    bar = {"uri": png_uri(ramp), "low": f"≤ {limits[0]:.2f}", "high": f"≥ {limits[1]:.2f}"}
    return cards, bar
