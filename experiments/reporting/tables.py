"""A table: cells that may say why they are empty, as Markdown, CSV or LaTeX; HTML: table.html."""

from __future__ import annotations

import csv
import dataclasses
import io

from experiments.reporting.stats import Interval, paired_p_value


@dataclasses.dataclass(frozen=True)
class Cell:
    """Text of a cell; `why` explains a dash."""

    text: str
    why: str | None = None
    interval: Interval | None = None  # what the text rounds
    p_value: float | None = None  # of a gap


@dataclasses.dataclass(frozen=True)
class Table:
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why there are dashes, each reason once."""
        whys = [cell.why for row in self.rows for cell in row if cell.why]
        return tuple(dict.fromkeys(whys))


def dash(why: str) -> Cell:
    return Cell("—", why)


def signed(value: float, digits: int = 2) -> str:
    """A gap with its sign, and a true minus."""
    return f"{value:+.{digits}f}".replace("-", "−")


def interval_cell(interval: Interval | None, digits: int, why: str, *, gap=False) -> Cell:
    """`mean ± half`, without the half where there is one seed; of a gap also how sure it is."""
    if interval is None:
        return dash(why)
    text = signed(interval.mean, digits) if gap else f"{interval.mean:.{digits}f}"
    if interval.half is not None:
        text += f" ± {interval.half:.{digits}f}"
    p_value = paired_p_value(interval) if gap else None
    if p_value is not None:
        text += " (p < 0.001)" if p_value < 0.001 else f" (p = {p_value:.2g})"
    return Cell(text, interval=interval, p_value=p_value)


def seconds(value: float) -> str:
    """A duration in words: `0.42 s`, `12.3 s`, `3 min 20 s`."""
    if value < 9.995:
        return f"{value:.2f} s"
    if value < 119.95:
        return f"{value:.1f} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{value / 3600:.2f} h"


# --- formats ---

LATEX_SIGNS = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    **{"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    **{"±": r"$\pm$", "−": "$-$", "—": "---", "×": r"$\times$", "<": "$<$", ">": "$>$"},
}


def markdown(table: Table) -> str:
    """A table as Markdown, with the reasons for its dashes below."""
    rows = [table.head, ["---"] * len(table.head)]
    rows += [[cell.text for cell in row] for row in table.rows]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    reasons = [f"\n— {'; '.join(table.reasons)}."] if table.reasons else []
    return "\n".join([*lines, *reasons])


def comma_separated(table: Table) -> str:
    """A table as CSV for programs: numbers in full, and an interval in columns of its own.

    A column of intervals is followed by one of their halves, and one of gaps by their p-values.
    What says nothing is empty, and a last column says why.
    """
    columns = list(zip(table.head, zip(*table.rows)))
    columns = [column for title, cells in columns for column in _csv_columns(title, cells)]
    if table.reasons:
        whys = [dict.fromkeys(cell.why for cell in row if cell.why) for row in table.rows]
        columns.append(("why cells are empty", ["; ".join(why) for why in whys]))
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([title for title, _ in columns])
    writer.writerows(zip(*(cells for _, cells in columns)))
    return file.getvalue().rstrip("\n")


def _csv_columns(title: str, cells: tuple[Cell, ...]) -> list[tuple[str, list]]:
    means = ["" if c.why else c.interval.mean if c.interval else c.text for c in cells]
    columns = [(title, means)]
    if any(cell.interval for cell in cells):
        halves = [cell.interval and cell.interval.half for cell in cells]
        columns.append((f"{title}, half of the 95 % interval", halves))  # None is left empty
    if any(cell.p_value is not None for cell in cells):
        columns.append((f"{title}, p of the paired t-test", [cell.p_value for cell in cells]))
    return columns


def latex(table: Table) -> str:
    """A table for LaTeX with the booktabs package, with the reasons for its dashes below."""
    head, *rows = (
        " & ".join(map(latex_text, texts)) + r" \\"
        for texts in (table.head, *([cell.text for cell in row] for row in table.rows))
    )
    start = rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}"
    lines = [start, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]
    if table.reasons:
        lines += ["", f"--- {latex_text('; '.join(table.reasons))}."]
    return "\n".join(lines)


def latex_text(text: str) -> str:
    """Text in which no sign means anything to LaTeX but itself."""
    return "".join(LATEX_SIGNS.get(sign, sign) for sign in text)


FORMATS = {"markdown": markdown, "csv": comma_separated, "latex": latex}
# What is no table, as a line of each format.
AS_TEXT = {"markdown": str, "csv": lambda text: f"# {text}", "latex": lambda text: f"% {text}"}


@dataclasses.dataclass(frozen=True)
class Collected:
    """What stands above the tables, the tables by name, and what stands below."""

    made: str  # by which command, on what
    tables: dict[str, Table]
    notes: tuple[str, ...] = ()  # what is missing, and why


def collected_text(
    found: Collected, *, form: str = "markdown", names: list[str] | None = None
) -> str:
    """What was made, the tables and the notes.

    Args:
      found: what to show.
      form: a key of `FORMATS`.
      names: of the tables, those that there are; None: all.
    """
    as_text = AS_TEXT[form]
    blocks = [as_text(found.made)]
    for name in [name for name in names or found.tables if name in found.tables]:
        title = [] if form == "markdown" else [as_text(name)]
        blocks.append("\n".join([*title, FORMATS[form](found.tables[name])]))
    blocks += [latex_text(n) if form == "latex" else as_text(n) for n in found.notes]
    return "\n\n".join(blocks) + "\n"
