"""The page that shows tables and plots of a benchmark."""

from __future__ import annotations

import pathlib
from typing import NamedTuple

from markupsafe import Markup

from experiments.bench import plots
from experiments.bench.results import facts, growth_table, quality_table, stage_table
from experiments.report.tables import Table
from experiments.web.page import write_template


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
            plots=[plots.ceiling_plot(result)],
            table=stage_table(result),
        )
    ]
    if (table := growth_table(result)) is not None:
        sections.append(
            Section(
                title="Growth",
                note="Medians of warm runs. An exponent of 1 is linear growth; below 1, a fixed "
                "cost still shows, which the straight line allows for.",
                plots=[plots.growth_plot(name, row) for name, row in result["growth"].items()],
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
            plots=[plots.quality_plot(result)],
            table=quality_table(result),
        )
    ]
