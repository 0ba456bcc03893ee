"""Figures as files: curves, test views, and stacks of pictures."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from experiments.report import plots, stats
from experiments.report.headline import focus_policy
from experiments.report.panels import Panel, panel_table, save_figure
from experiments.report.pictures import UNCERTAINTY_MAP, psnr_words, uncertainty_limits
from experiments.report.plots import quality_figure
from experiments.report.results import ReportError, Run, load_pictures, load_runs_of

FORMATS = ("pdf", "png", "svg")


def write_figures(
    workdir: pathlib.Path, *, form: str = "png", policies: Sequence[str] = (), num_views: int = 4
) -> list[pathlib.Path]:
    """Writes every figure that the results of a folder have numbers for.

    Args:
      workdir: with `summary.json` and the arrays of each run.
      form: one of `FORMATS`.
      policies: which, in this order; none: all.
      num_views: most test views.

    Returns:
      The files.

    Raises:
      ReportError: a file that cannot be used, or a policy without a run.
    """
    runs = load_runs_of(workdir, policies)
    shown = list(dict.fromkeys(run.policy for run in runs))
    coloured = plots.in_colour(runs, shown, focus_policy(shown))
    figures = {m.key: quality_figure(runs, shown, m, coloured) for m in stats.MEASURES}
    for figure in filter(None, figures.values()):
        # A page says this beside the figure; a file has to say it itself.
        scene = runs[0].result["scene"]["name"]
        what = f"training views of {scene} (thin: each seed; band: 95 % interval)"
        figure.axes[0].set_xlabel(what, fontsize=9)
    pictures = _pictures(runs, shown)
    figures["views"] = views_figure(pictures, num_views) if pictures else None
    written = []
    for name, figure in figures.items():
        if figure is not None:
            written.append(workdir / "figures" / f"{name}.{form}")
            save_figure(figure, written[-1])
    return written


def _pictures(runs: list[Run], policies: list[str]) -> dict:
    """Of each policy, the pictures of the first seed of which all, or else most, have some."""
    kept: dict[int, dict] = {}
    for run in sorted(runs, key=lambda run: run.seed):
        pictures = load_pictures(run)
        if pictures is not None:
            kept.setdefault(run.seed, {})[run.policy] = pictures
    best = max(kept.values(), key=len, default={})  # the first of the largest
    return {policy: best[policy] for policy in policies if policy in best}


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
