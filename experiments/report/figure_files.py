"""Figures of an experiment as files of their own."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

from experiments.report import gaps, stats
from experiments.report.headline import focus_policy
from experiments.report.panels import save_figure
from experiments.report.plots import quality_figure
from experiments.report.results import Run, load_pictures, load_runs_of
from experiments.report.views_figure import views_figure

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
    coloured = gaps.in_colour(runs, shown, focus_policy(shown))
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
