"""Curves of runs; how every figure looks, and how it becomes an element of a page."""

import io
import os
import pathlib
import re
from collections.abc import Iterable

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib import style as matplotlib_style
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.files import write_atomic
from experiments.reporting import stats
from experiments.reporting.results import Run
from experiments.reporting.stats import REFERENCES, Measure

matplotlib_style.use(pathlib.Path(__file__).parent / "reporting.mplstyle")

# Okabe and Ito 2008: told apart by colour-blind readers. Yellow is left out, too pale on white.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
POLICY_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MANY = len(POLICY_COLOURS)  # more policies than these crowd, and have no colour of their own
POLICY_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
MIN_BAND = 3  # seeds; an interval over two is 13 standard errors wide
GREY, PALE = "#6b7280", "#c3c8d0"
DOT = {"markeredgecolor": "white"}


def to_svg(figure: Figure, *, salt: str, label: str) -> Markup:
    """A figure as an `<svg>` element that may stand in a page beside others, as it is.

    The `salt` makes its ids differ from those of others; the `label` is for readers who do not see.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Groups have the same names in every figure, but ids must be unique on a page.
    svg = re.sub(r'(<g|<image [^>]*) id="[^"]*"', r"\1", svg)
    # Glyphs are defined per figure; a viewer that looks one up by id may find another figure's.
    svg = re.sub(r"(id=\"|href=\"#|url\(#)", rf"\g<1>{salt}-", svg)
    return Markup(svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1))


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Writes a figure whole or not at all; the end of its name, such as `.pdf`, is the format."""
    form = pathlib.Path(path).suffix.removeprefix(".")
    write_atomic(path, lambda file: figure.savefig(file, format=form))


def policy_style(policies: list[str]) -> dict[str, tuple[str, str]]:
    """Policy -> (colour, marker), the same in every figure of a page, a pair once in 49."""
    return {
        policy: (POLICY_COLOURS[i % MANY], POLICY_MARKERS[(i + i // MANY) % MANY])
        for i, policy in enumerate(policies)
    }


def by_interest(policies: Iterable[str]) -> list[str]:
    """Ours first, which a report is about; then what it must beat; then the others as they are."""
    first = ("bavs", "bavs_spread", "bavs_topk", *REFERENCES)
    return sorted(policies, key=lambda p: first.index(p) if p in first else len(first))


def quality_figure(runs: list[Run], policies: list[str], measure: Measure) -> Figure | None:
    """One measure against the number of training views, or None if no run has it.

    Of policies after the first seven there are the single runs alone, grey and without names.
    """
    style = policy_style(policies[:MANY])
    figure = Figure(figsize=(5.4, 3.7))
    axes = figure.add_subplot()
    numbers = sorted({r["num_views"] for run in runs for r in run.rounds})
    for run in runs:
        points = [(n, value) for n in numbers if (value := run.value(measure.key, n)) is not None]
        colour, _ = style.get(run.policy, (PALE, None))
        look = {"linewidth": 0.8, "linestyle": "-" if run.completed else ":", "alpha": 0.6}
        if points:
            axes.plot(*zip(*points), color=colour, **look)
    if not axes.lines:
        return None
    axes.set_ylim(axes.get_ylim())  # bands over few seeds are so wide that nothing else would show
    for policy, (colour, marker) in style.items():
        means = [
            stats.mean_interval(stats.by_seed(runs, policy, measure.key, [n])) for n in numbers
        ]
        curve = [(n, *mean) for n, mean in zip(numbers, means) if mean is not None]
        x, mean, half, num = np.array(curve, float).reshape(-1, 4).T
        axes.plot(x, mean, color=colour, marker=marker, linewidth=2.0, label=policy, **DOT)
        half[num < MIN_BAND] = np.nan
        axes.fill_between(x, mean - half, mean + half, color=colour, alpha=0.14, linewidth=0)
    scene = runs[0].result["scene"]["name"]
    label = f"training views of {scene} (thin: each seed; band: 95 % interval)"
    axes.set_xlabel(label, fontsize=9)
    axes.set_title(f"{measure.heading}, {measure.better} is better")
    axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.grid(axis="y")
    axes.legend()
    return figure
