"""The page that shows how well each model's uncertainty tells the error."""

from __future__ import annotations

import pathlib

import jinja2
import numpy as np
from markupsafe import Markup

from experiments.files import write_atomic
from experiments.report.pictures import ERROR_MAP, UNCERTAINTY_MAP, colourise, png_uri, shrink
from experiments.uncertain.plots import curve_plot
from experiments.uncertain.results import FIELDS, ause_table, known_variants

MAX_SIDE = 240  # pixels of a picture


def write_page(
    path: pathlib.Path,
    *,
    title: str,
    command: str,
    rows: list[dict],
    curves: dict[str, list[dict]],
    pictures: dict[str, dict[str, np.ndarray]],
    variant: str,
) -> None:
    """Curves, tables of every variant, and pictures of some views.

    Args:
      path: where to.
      title: what was measured.
      command: how it was made.
      rows: of the result file.
      curves: by model, arrays of each seed.
      pictures: by model, arrays [n, H, W, ...] of some views of the first seed.
      variant: the AUSE that is shown first.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    variants = known_variants(rows)
    variant = variant if variant in variants else variants[0]
    titles = {field: f"Error of what is left, {words}" for field, words in FIELDS.items()}
    text = environment.get_template("template.html").render(
        title=title,
        command=command,
        variant=variant,
        plots=[Markup(curve_plot(curves, field, variant, titles[field])) for field in FIELDS],
        first=ause_table(rows, variant),
        others=[(name, ause_table(rows, name)) for name in variants if name != variant],
        strips=_strips(pictures),
    )
    write_atomic(path, lambda file: file.write(text.encode()))


def _strips(pictures: dict[str, dict[str, np.ndarray]]) -> list[dict]:
    """For each model and view: truth, render, error and uncertainty on a scale of its own."""
    strips = []
    for model, arrays in pictures.items():
        top = np.percentile(arrays["uncertainty"], 99.0)
        for i, name in enumerate(arrays["names"]):
            shown = (
                ("truth", arrays["truth"][i]),
                ("render", arrays["rgb"][i]),
                ("colour error", colourise(arrays["error"][i], 0.0, 0.25, ERROR_MAP)),
                ("uncertainty", colourise(arrays["uncertainty"][i], 0.0, top, UNCERTAINTY_MAP)),
            )
            images = [(caption, png_uri(shrink(image, MAX_SIDE))) for caption, image in shown]
            strips.append({"name": f"{model}, {name}", "images": images})
    return strips
