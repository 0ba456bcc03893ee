"""The page that shows how well each model's uncertainty tells the error, and its intervals."""

from __future__ import annotations

import pathlib

import numpy as np
from markupsafe import Markup

from experiments.picture_stack import cut_pictures
from experiments.report.pictures import ERROR_MAP, UNCERTAINTY_MAP, colourise, png_uri, shrink
from experiments.uncertain.plots import (
    LEVEL,
    band_strip,
    coverage_plot,
    curve_plot,
    decile_plot,
    scanline_plot,
    width_plot,
)
from experiments.uncertain.results import (
    FIELDS,
    known_quantities,
    known_variants,
    left_out_words,
    models_of,
    split_words,
    title,
)
from experiments.uncertain.tables import ause_table, coverage_table, summary_table
from experiments.web.page import write_template

MAX_SIDE = 240  # pixels of a picture


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
    titles = {field: f"Error of what is left, {words}" for field, words in FIELDS.items()}
    pictures = {model: cut_pictures(found[0]) for model, found in arrays.items()}
    shown = models_of(rows)[0]
    write_template(
        path,
        pathlib.Path(__file__).parent,
        title=title(result),
        result=result,
        variant=variant,
        summary=summary_table(rows),
        plots=[Markup(curve_plot(arrays, field, variant, titles[field])) for field in FIELDS],
        variants=[(name, ause_table(rows, name)) for name in variants],
        split=split_words(result),
        coverage=[coverage_table(rows, quantity) for quantity in known_quantities(rows)],
        coverage_plots=[
            Markup(plot)
            for plot in (coverage_plot(rows), width_plot(rows), decile_plot(rows, LEVEL))
        ],
        left_out=left_out_words(rows),
        shown=shown,
        band=band_strip(pictures[shown]),
        scanline=Markup(scanline_plot(pictures[shown], shown)),
        strips=_strips(pictures),
    )


def _strips(pictures: dict[str, dict[str, np.ndarray]]) -> list[dict]:
    """For each model and view: truth, render, error and uncertainty on a scale of its own."""
    strips = []
    for model, arrays in pictures.items():
        if "names" not in arrays:  # no pictures were asked for
            continue
        top = np.percentile(np.concatenate([u.ravel() for u in arrays["uncertainty"]]), 99.0)
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
