"""Curves and bars of runs; how every figure looks, and how it becomes an element of a page."""

from __future__ import annotations

import io
import os
import pathlib
import re

import matplotlib
from markupsafe import Markup
from matplotlib import patheffects
from matplotlib import style as matplotlib_style
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator

from experiments.files import write_atomic
from experiments.reporting import stats
from experiments.reporting.results import Run
from experiments.reporting.stats import REFERENCES
from experiments.reporting.tables import seconds

matplotlib_style.use(pathlib.Path(__file__).parent / "reporting.mplstyle")

MANY = 7  # policies from which curves crowd, and each no longer has a colour of its own
# Okabe and Ito 2008: told apart by colour-blind readers. Yellow is left out, too pale on white.
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
POLICY_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
POLICY_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
PARTS = {
    "train": ("training", BLUE),
    "curvature": ("curvature", ORANGE),
    "fit": ("training other fields", VERMILION),
    "score": ("scoring candidates", GREEN),
    "select": ("selecting", PURPLE),
    "evaluate": ("measuring on test views", SKY),
}
MIN_BAND = 3  # seeds; an interval over two is 13 standard errors wide and hides all else
GREY, PALE = "#6b7280", "#c3c8d0"
DOT = {"markeredgecolor": "white"}


def to_svg(figure: Figure, *, salt: str, label: str) -> Markup:
    """A figure as an `<svg>` element that may stand in a page beside others, as it is.

    Args:
      figure: what to draw.
      salt: makes the ids of this element differ from those of the other ones.
      label: what it shows, for readers who do not see it.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": salt}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # The group names of matplotlib are the same in every figure, but ids must be unique on a page.
    svg = re.sub(r'<g id="[^"]*_\d+">', "<g>", svg)
    # Glyphs are defined per figure; a viewer that looks one up by id may find another figure's.
    svg = re.sub(r"(id=\"|href=\"#|url\(#)", rf"\g<1>{salt}-", svg)
    return Markup(svg.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1))


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Writes a figure whole or not at all; the end of its name, such as `.pdf`, is the format."""
    form = pathlib.Path(path).suffix.removeprefix(".")
    write_atomic(path, lambda file: figure.savefig(file, format=form))


def tidy(axes: Axes, grid: str | None = None) -> None:
    """Takes the frame away but for the axes, and draws lines across one of them, "x" or "y"."""
    axes.spines[["top", "right"]].set_visible(False)
    if grid is not None:
        axes.grid(axis=grid)


def policy_style(policies: list[str]) -> dict[str, tuple[str, str]]:
    """Policy -> (colour, marker), the same in every figure of the page."""
    return {
        policy: (
            POLICY_COLOURS[i % len(POLICY_COLOURS)],
            # Shifted by one per lap, so that no pair comes twice for 49 policies.
            POLICY_MARKERS[(i + i // len(POLICY_COLOURS)) % len(POLICY_MARKERS)],
        )
        for i, policy in enumerate(policies)
    }


def in_colour(runs: list[Run], policies: list[str], focus: str | None) -> list[str]:
    """The policies whose curves are told apart: all, or of many the few that matter most.

    Those are ours, the references, and the best of the others at the end.
    """
    if len(policies) <= MANY:
        return policies
    num_views = stats.common_num_views(runs)
    finals = {p: stats.over_seeds(runs, p, "psnr", num_views) for p in policies}
    ranked = sorted((p for p in policies if finals[p]), key=lambda p: -finals[p].mean)
    return list(dict.fromkeys(p for p in (focus, *REFERENCES, *ranked[:2]) if p in policies))


def quality_figure(
    runs: list[Run], policies: list[str], measure: stats.Measure, coloured: list[str]
) -> Figure | None:
    """One measure against the number of training views, or None if no run has it.

    Policies that are not in `coloured` are thin grey means without names.
    """
    style = policy_style(coloured)
    figure = Figure(figsize=(5.4, 3.7))
    axes = figure.add_subplot()
    ends = []  # (last number of views, last value, name, colour) for the labels
    numbers = set()
    for policy in policies:
        curve = stats.mean_curve(runs, policy, measure.key)
        x, means = [n for n, _ in curve], [i.mean for _, i in curve]
        if policy not in style:
            axes.plot(x, means, color=PALE, zorder=0.5)
            continue
        colour, marker = style[policy]
        single = []
        for run in runs:
            if run.policy != policy or not (points := _points(run, measure.key)):
                continue
            numbers.update(n for n, _ in points)
            look = {"linewidth": 0.8, "alpha": 0.45}
            if not run.completed:
                look = {"linewidth": 1.6, "linestyle": ":", "marker": marker, "markersize": 3.5}
            axes.plot(*zip(*points), color=colour, zorder=2, **look)
            single = single or points
        if curve:
            halves = [i.half if i.num >= MIN_BAND else 0.0 for _, i in curve]
            if any(halves):
                low, high = ([m + s * h for m, h in zip(means, halves)] for s in (-1, 1))
                axes.fill_between(x, low, high, color=colour, alpha=0.14, linewidth=0, zorder=1)
            look = {"marker": marker, "markersize": 5.5, "markeredgewidth": 0.7, **DOT}
            axes.plot(x, means, color=colour, linewidth=2.0, zorder=3, **look)
            ends.append((x[-1], means[-1], policy, colour))
        elif single:
            ends.append((*single[-1], f"{policy} (incomplete)", colour))
    if not numbers:
        return None
    axes.set_xlabel("training views")
    axes.set_title(measure.title)
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.xaxis.set_major_locator(
        FixedLocator(sorted(numbers)) if len(numbers) <= 10 else MaxNLocator(8, integer=True)
    )
    # By the runs themselves: bands over two or three seeds are so wide that nothing else shows.
    axes.set_ylim(*_padded([v for run in runs for _, v in _points(run, measure.key)]))
    tidy(axes, "y")
    _label_ends(axes, ends)
    return figure


def _padded(values: list[float]) -> tuple[float, float]:
    """Limits a little wider than all values."""
    margin = 0.08 * (max(values) - min(values)) or 0.05 * abs(max(values)) or 1.0
    return min(values) - margin, max(values) + margin


def _points(run: Run, measure: str) -> list[tuple[int, float]]:
    pairs = [(r["num_views"], run.value(measure, r["num_views"])) for r in run.rounds]
    return [(n, value) for n, value in pairs if value is not None]


def _label_ends(axes: Axes, ends: list) -> None:
    """Writes each policy's name beside the end of its line, moved apart where they would touch."""
    low, high = axes.get_ylim()
    gap = 0.065 * (high - low)
    lowest = {}  # by number of views, where there is room for the next name
    for x, y, name, colour in sorted(ends, key=lambda end: end[1]):
        y_text = max(y, lowest.get(x, y))
        lowest[x] = y_text + gap
        place = (9, (y_text - y) / (high - low) * 200)  # 200 points: about the axes' height
        look = {"color": colour, "fontsize": 9.5, "fontweight": "bold", "va": "center", "zorder": 5}
        options = {"textcoords": "offset points", "annotation_clip": False}
        text = axes.annotate(name, xy=(x, y), xytext=place, **options, **look)
        text.set_path_effects([patheffects.withStroke(linewidth=3, foreground="white")])
    axes.set_ylim(low, high)


def timing_plot(runs: list[Run], policies: list[str]) -> Markup | None:
    """Where the time went, a stacked bar per policy, or None if nothing has been completed."""
    rows = [p for p in policies if stats.completed(runs, p)]
    if not rows:
        return None
    figure = Figure(figsize=(10.6, 1.15 + 0.42 * len(rows)))
    axes = figure.add_subplot()
    left = [0.0] * len(rows)
    look = {"height": 0.62, "edgecolor": "white", "linewidth": 0.8}
    for part, (label, colour) in PARTS.items():
        widths = [stats.mean_seconds(runs, policy, part) for policy in rows]
        axes.barh(range(len(rows)), widths, left=left, color=colour, label=label, **look)
        left = [a + b for a, b in zip(left, widths)]
    for row, total in enumerate(left):
        axes.annotate(f" {seconds(total)}", xy=(total, row), va="center", fontsize=9.5)
    axes.set_yticks(range(len(rows)), rows)
    axes.invert_yaxis()
    axes.set_xlim(0.0, max(1.12 * max(left), 1e-3))
    axes.set_xlabel("seconds for all rounds of one run, mean over seeds")
    tidy(axes, "x")
    figure.legend(loc="outside upper left", ncols=len(PARTS), handlelength=1.2)
    return to_svg(figure, salt="timings", label="Seconds spent per policy and part of the work")


def gap_plot(runs: list[Run], policies: list[str], coloured: list[str]) -> Markup | None:
    """PSNR of each policy minus that of random choice, seed by seed; None without random.

    Large dots are means with their 95 % intervals, small ones single seeds. The scale follows the
    seeds: intervals over two or three seeds may reach beyond it. Policies in `coloured` have the
    colours of their curves.
    """
    reference = REFERENCES[0]
    num_views = stats.common_num_views(runs)
    if num_views is None or len(policies) < 3:
        return None
    others = [policy for policy in policies if policy != reference]
    pairs = {policy: stats.compare(runs, policy, reference, "psnr", num_views) for policy in others}
    rows = [(pair.gap, pair.gaps, policy) for policy, pair in pairs.items() if pair is not None]
    if not rows:
        return None
    rows.sort(key=lambda row: row[0].mean)
    style = policy_style(coloured)
    figure = Figure(figsize=(10.6, 1.0 + 0.28 * len(rows)))
    axes = figure.add_subplot()
    axes.axvline(0.0, color=GREY, linewidth=1.2, zorder=1)
    for place, (gap, seeds, policy) in enumerate(rows):
        look = {"color": style.get(policy, (GREY, None))[0], "edgecolors": "white"}
        if gap.half is not None:
            axes.hlines(place, gap.low, gap.high, color=look["color"], linewidth=1.6, zorder=2)
        axes.scatter(seeds, [place] * len(seeds), s=20, linewidths=0.6, zorder=2.5, **look)
        axes.scatter([gap.mean], [place], s=70, zorder=3, **look)
    values = [0.0] + [g for _, seeds, _ in rows for g in seeds]
    margin = 0.15 * (max(values) - min(values)) + 0.05
    axes.set_xlim(min(values) - margin, max(values) + margin)
    axes.set_yticks(range(len(rows)), [policy for _, _, policy in rows])
    axes.set_xlabel(f"PSNR minus that of {reference} with {num_views} views (dB)")
    tidy(axes, "x")
    return to_svg(figure, salt="gaps", label=f"PSNR gap of each policy to {reference}")
