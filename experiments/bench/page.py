"""The page of a benchmark or of time to quality, with its plots."""

from __future__ import annotations

import pathlib
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from experiments.bench.results import (
    STAGES,
    amount,
    facts,
    growth_table,
    quality_table,
    stage_table,
)
from experiments.reporting import plots
from experiments.reporting.page import write_template
from experiments.reporting.tables import Table


def growth_plot(name: str, row: dict) -> str:
    """Seconds against size, both on log scales, with the straight line; linear has a slope of 1."""
    sizes, seconds = np.array(row["sizes"]), np.array(row["median_s"])
    figure = Figure(figsize=(4.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    if row["fit"] is not None:
        fit = row["fit"]
        steps = np.geomspace(sizes[0], sizes[-1], 100)
        line = fit["intercept_s"] + fit["slope_s"] * steps
        axes.plot(
            steps[line > 0],
            line[line > 0],
            color=plots.GREY,
            linewidth=1.2,
            linestyle="--",
            label=f"straight line, off by at most {fit['largest_deviation']:.0%}",
        )
        axes.plot(
            steps,
            seconds[-1] * steps / sizes[-1],
            color=plots.PALE,
            linewidth=1.0,
            label="in proportion",
        )
        title = f"{row['title']}\ntime ~ n^{fit['exponent']:.2f}"
    else:
        title = row["title"]
    axes.plot(
        sizes,
        seconds,
        color=plots.BLUE,
        linestyle="none",
        marker="o",
        markersize=6,
        markeredgecolor="white",
        label="measured",
    )
    axes.set_xscale("log")
    axes.set_yscale("log")
    # Room above and below, so that a time which does not grow looks like one.
    axes.set_ylim(min(seconds.min() / 2, seconds.max() / 8), seconds.max() * 2)
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=30, ha="right")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{1e3 * value:g} ms"))
    axes.set_xlabel(f"n: {row['size']}", fontsize=9.5, color="#374151")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8)
    return plots.to_svg(figure, salt=f"growth-{name}", label=f"Time of {row['title']}")


def ceiling_plot(result: dict) -> str:
    """Each stage's arithmetic per byte and per second, under both ceilings (a roofline)."""
    ceilings, stages = result["ceilings"], result["stages"]
    style = plots.policy_style(list(STAGES))
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    top, slope = ceilings["matmul_flops_per_s"], ceilings["copy_bytes_per_s"]
    # What a device does not let be counted has no place here.
    counted = {n: s for n, s in stages.items() if s["flops_per_run"] > 0.0}
    intensity = {n: s["flops_per_run"] / s["bytes_per_run"] for n, s in counted.items()}
    ends = [*intensity.values(), top / slope]
    steps = np.geomspace(min(ends) / 3, max(ends) * 3, 100)
    axes.plot(
        steps,
        np.minimum(top, slope * steps),
        color=plots.GREY,
        linewidth=1.5,
        label="copy, then matrix product",
    )
    for name in counted:
        title, (colour, marker) = STAGES[name], style[name]
        axes.plot(
            [intensity[name]],
            [stages[name]["flops_per_s"]],
            color=colour,
            marker=marker,
            markersize=8,
            linestyle="none",
            label=title,
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{amount(value)}FLOP/s"))
    axes.set_xlabel("operations for each byte", fontsize=10, color="#374151")
    axes.set_title("Stages under the ceilings of this machine", fontsize=10.5, loc="left")
    axes.grid(color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8.5)
    return plots.to_svg(figure, salt="ceilings", label="Stages under the ceilings of this machine")


def quality_plot(result: dict) -> str:
    """PSNR on test views against seconds since the process was started."""
    runs = result["runs"]
    style = plots.policy_style(list(runs))
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for target in next(iter(runs.values()))["seconds_to_db"]:
        axes.axhline(float(target), color=plots.PALE, linewidth=1.0)
    for cache, run in runs.items():
        colour, marker = style[cache]
        axes.plot(
            [point["seconds"] for point in run["curve"]],
            [point["psnr"] for point in run["curve"]],
            color=colour,
            marker=marker,
            markersize=4.5,
            markeredgecolor="white",
            label=f"{cache} compilation cache",
        )
    axes.set_xlim(0.0, None)
    axes.set_xlabel("seconds since the start, without measuring", fontsize=10, color="#374151")
    axes.set_title("PSNR on test views (dB)", fontsize=10.5, loc="left")
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=9)
    return plots.to_svg(figure, salt="quality", label="PSNR against seconds")


class Section(NamedTuple):
    """One part of the page."""

    title: str
    note: str
    plots: list[str]  # SVG
    table: Table


def write_page(path: pathlib.Path, *, title: str, made: dict, sections: list[Section]) -> None:
    """Fills the template.

    Args:
      path: where to.
      title: of the page.
      made: the result file: how and on what it was made.
      sections: from top to bottom.
    """
    sections = [s._replace(plots=[Markup(svg) for svg in s.plots]) for s in sections]
    write_template(path, pathlib.Path(__file__).parent, title=title, made=made, sections=sections)


def benchmark_sections(result: dict) -> list[Section]:
    """Rates under the ceilings, and growth where it was measured."""
    sections = [
        Section(
            title="Each stage",
            note=" ".join(facts(result))
            + " Rates are medians over uniformly drawn training pixels. Operations and bytes are "
            "XLA's counts for the compiled code; bytes bound the traffic from above, for caches "
            "are not known and a gather counts its whole table, so a share may exceed 100 %.",
            plots=[ceiling_plot(result)],
            table=stage_table(result),
        )
    ]
    if (table := growth_table(result)) is not None:
        sections.append(
            Section(
                title="Growth",
                note="Medians of warm runs. An exponent of 1 is linear growth; below 1, a fixed "
                "cost still shows, which the straight line allows for.",
                plots=[growth_plot(name, row) for name, row in result["growth"].items()],
                table=table,
            )
        )
    return sections


def quality_sections(result: dict) -> list[Section]:
    """Time to quality."""
    return [
        Section(
            title="Seconds to quality",
            note=f"From the start of the process, with all imports and compilation, on "
            f"{result['num_views']} training views; PSNR is the mean over "
            f"{result['num_test_views']} test views, measured while the clock stands. The last "
            "time is that of the first look from which on none is 0.3 dB below the best.",
            plots=[quality_plot(result)],
            table=quality_table(result),
        )
    ]
