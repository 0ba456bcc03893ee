"""Tables, whose cells may say why they are empty, as Markdown, CSV or LaTeX; and pages of them."""

import csv
import dataclasses
import io
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import jinja2
from markupsafe import Markup

from experiments.files import write_atomic
from experiments.reporting.stats import Interval, paired_p_value


@dataclasses.dataclass(frozen=True)
class Cell:
    """Text of a cell; `why` explains a dash."""

    text: str
    why: str | None = None
    interval: Interval | None = None  # what the text rounds
    p_value: float | None = None  # of a gap


@dataclasses.dataclass
class Table:
    """A heading and rows of cells; texts and numbers in place of a cell are made one."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def __post_init__(self):
        self.head = tuple(self.head)
        self.rows = [[c if isinstance(c, Cell) else Cell(str(c)) for c in r] for r in self.rows]

    @property
    def texts(self) -> list[Sequence[str]]:
        """What is printed, the heading first."""
        return [self.head, *([cell.text for cell in row] for row in self.rows)]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why there are dashes, each reason once."""
        return tuple(dict.fromkeys(cell.why for row in self.rows for cell in row if cell.why))


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

LATEX_SIGNS = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"±": r"$\pm$", "−": "$-$", "—": "---", "×": r"$\times$", "<": "$<$", ">": "$>$"}
)


def markdown(table: Table) -> str:
    """A table as Markdown, with the reasons for its dashes below."""
    head, *rows = table.texts
    lines = ["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)]
    reasons = [f"\n— {'; '.join(table.reasons)}."] if table.reasons else []
    return "\n".join([*lines, *reasons])


def comma_separated(table: Table) -> str:
    """A table as CSV for programs: numbers in full, and an interval in columns of its own.

    A column of intervals is followed by one of their halves, and one of gaps by their p-values.
    What says nothing is empty, and a last column says why.
    """
    columns = []
    for title, *cells in zip(table.head, *table.rows):
        intervals = [cell.interval for cell in cells]
        means = ["" if c.why else c.interval.mean if c.interval else c.text for c in cells]
        columns.append([title, *means])
        if any(intervals):
            halves = [interval and interval.half for interval in intervals]
            columns.append([f"{title}, half of the 95 % interval", *halves])
        if any(cell.p_value is not None for cell in cells):
            p_values = [cell.p_value for cell in cells]
            columns.append([f"{title}, p of the paired t-test", *p_values])
    if table.reasons:
        whys = [dict.fromkeys(cell.why for cell in row if cell.why) for row in table.rows]
        columns.append(["why cells are empty", *map("; ".join, whys)])
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(zip(*columns))  # None is left empty
    return file.getvalue().rstrip("\n")


def latex(table: Table) -> str:
    """A table for LaTeX with the booktabs package, with the reasons for its dashes below."""
    head, *rows = (" & ".join(map(latex_text, texts)) + r" \\" for texts in table.texts)
    start = rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}"
    lines = [start, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]
    if table.reasons:
        lines += ["", f"--- {latex_text('; '.join(table.reasons))}."]
    return "\n".join(lines)


def latex_text(text: str) -> str:
    """Text in which no sign means anything to LaTeX but itself."""
    return text.translate(LATEX_SIGNS)


FORMATS = {"markdown": markdown, "csv": comma_separated, "latex": latex}
COMMENT = {"markdown": "", "csv": "# ", "latex": "% "}  # before what is no table


@dataclasses.dataclass(frozen=True)
class Collected:
    """What stands above the tables, the tables by name, and what stands below."""

    made: str  # by which command, on what
    tables: dict[str, Table]
    notes: Sequence[str] = ()  # what is missing, and why


def collected_text(
    found: Collected, *, form: str = "markdown", names: Sequence[str] | None = None
) -> str:
    """What was made, the tables and the notes.

    Args:
      found: what to show.
      form: a key of `FORMATS`.
      names: of the tables, those that there are; None: all.
    """
    sign = COMMENT[form]
    blocks = [sign + found.made]
    for name in [name for name in names or found.tables if name in found.tables]:
        title = f"{sign}{name}\n" if sign else ""
        blocks.append(title + FORMATS[form](found.tables[name]))
    blocks += [sign + note for note in found.notes]
    return "\n\n".join(blocks) + "\n"


# --- pages: one template, filled and written whole; they need no other file and no network -----

FOLDER = pathlib.Path(__file__).parent  # of the templates that pages share


class Section(NamedTuple):
    """One part of a page, shown in this order."""

    title: str
    table: Table | None = None
    note: str = ""
    plots: Sequence[Markup] = ()  # from `plots.to_svg`


def write_page(path: str | os.PathLike, *, title: str, made: dict, sections: list[Section]) -> None:
    """Writes a page of sections about a result file, whose making it shows too."""
    write_template(path, "sections.html", title=title, made=made, sections=sections)


def write_template(path: str | os.PathLike, name: str, **content) -> None:
    """Writes a template, filled with all that it names; texts are escaped, `Markup` is not."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template(name).render(**content)
    write_atomic(path, lambda file: file.write(text.encode()))
