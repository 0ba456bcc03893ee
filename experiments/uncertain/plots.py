"""Sparsification curves as inline SVG."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from bavs_jax.metrics.ause import removal_fractions
from experiments.report import plots
from experiments.uncertain.results import mean_curves


def curve_plot(curves: dict[str, list[dict]], field: str, variant: str, title: str) -> str:
    """Error of the pixels that are left, for each model, against what is taken away.

    Args:
      curves: by model, the arrays of each seed.
      field: "own" or "common".
      variant: which AUSE.
      title: what is drawn, in words.
    """
    style = plots.policy_style(list(curves))
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    best = None
    for model, arrays in curves.items():
        by_uncertainty, best = mean_curves(arrays, field, variant)
        colour, marker = style[model]
        axes.plot(
            *(removal_fractions(len(by_uncertainty)), by_uncertainty),
            color=colour,
            linewidth=2.0,
            marker=marker,
            markevery=(3, 14),
            markersize=5,
            markeredgecolor="white",
            label=model,
        )
        if field == "common":
            continue
        axes.plot(removal_fractions(len(best)), best, color=colour, linewidth=1.0, linestyle=":")
    if field == "common" and best is not None:
        fractions = removal_fractions(len(best))
        axes.plot(
            fractions, best, color=plots.GREY, linestyle="--", label="order of the true error"
        )
    axes.set_xlabel("pixels taken away, the most uncertain first", fontsize=10, color="#374151")
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(0.0, None)
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=9)
    return plots.to_svg(figure, salt=f"curve-{field}", label=title)
