"""The page that shows where to stand next, and why."""

from __future__ import annotations

import math
import pathlib

import numpy as np
from markupsafe import Markup

from bavs_jax.selection.worth import Worth
from experiments.report.pictures import (
    UNCERTAINTY_MAP,
    colourise,
    png_uri,
    shrink,
    uncertainty_limits,
)
from experiments.web.page import write_template

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


def worth_sentence(worth: Worth, photo_gain: float) -> str:
    """How much is left to gain, so that the user can judge when to stop.

    Args:
      worth: along the picks, nats.
      photo_gain: of one more photo from where there is one already, nats.
    """
    num, first, left = len(worth.picked), worth.best_left[0], worth.best_left[-1]
    if math.isnan(left):
        return f"No candidate is left after these {num}: draw more to see what else there is."
    words = (
        f"After {'this pose' if num == 1 else f'these {num}'}, the best candidate left would tell "
        f"{left / first:.0%} of what the best would have told before ({first:.3g} nats)"
    )
    if first <= photo_gain:
        return words + (
            f"; but even that is no more than another photo from where there is one already would "
            f"tell ({photo_gain:.3g} nats): the candidates hardly show anything new."
        )
    words += f"; another photo from where there is one already would tell {photo_gain / first:.0%}."
    excess = max(left - photo_gain, 0.0) / (first - photo_gain)
    if excess >= 0.5:
        return words + " Further views are still worth taking."
    if excess >= 0.2:
        return words + " Further views gain less and less."
    return words + " There is little left to gain: this is a good place to stop."
