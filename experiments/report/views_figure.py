"""Test views of several policies side by side: colour and uncertainty, as in Figure 8."""

from __future__ import annotations

import pathlib

import numpy as np
from matplotlib.figure import Figure

from experiments.report.panels import Panel, panel_table
from experiments.report.pictures import UNCERTAINTY_MAP, psnr_words, uncertainty_limits
from experiments.report.results import ReportError


def views_figure(pictures: dict[str, dict[str, np.ndarray]], num_views: int) -> Figure:
    """A row for each test view: the truth, then each policy's render and rendered uncertainty.

    Args:
      pictures: of each policy, what its run left in `pictures.npz`.
      num_views: most rows, of the views that all of them show.

    Raises:
      ReportError: there is no such view.
    """
    first = next(iter(pictures.values()))
    shared = set.intersection(*(set(arrays["view_ids"].tolist()) for arrays in pictures.values()))
    if not shared:
        raise ReportError(f"{', '.join(pictures)}: show no test view in common; name one policy")
    limits = uncertainty_limits([*pictures.values()])
    rows = []
    for view_id in [v for v in first["view_ids"] if int(v) in shared][:num_views]:
        rows.append(_row(view_id, pictures, first, limits))
    return panel_table(rows, scale_label="uncertainty (in [0, 1])")


def _row(view_id: int, pictures, first, limits) -> tuple[str, list[Panel]]:
    at = _index(first, view_id)
    panels = [Panel("truth", first["truth"][at] / 255.0)]
    for policy, arrays in pictures.items():
        i = _index(arrays, view_id)
        quality = psnr_words(arrays["rgb"][i], arrays["truth"][i])
        panels += [
            Panel(f"{policy}, {quality}", arrays["rgb"][i] / 255.0),
            Panel(f"{policy}, uncertainty", arrays["uncertainty"][i], UNCERTAINTY_MAP, limits),
        ]
    return pathlib.PurePath(str(first["names"][at])).stem, panels


def _index(arrays: dict[str, np.ndarray], view_id: int) -> int:
    return int(np.flatnonzero(arrays["view_ids"] == view_id)[0])
