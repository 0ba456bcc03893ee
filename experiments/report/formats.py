"""A table as Markdown, CSV or LaTeX."""

from __future__ import annotations

import csv
import io

from experiments.report.tables import Cell, Table

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
    parts = [column for title, cells in columns for column in _csv_columns(title, cells)]
    if table.reasons:
        whys = [dict.fromkeys(cell.why for cell in row if cell.why) for row in table.rows]
        parts.append(("why cells are empty", ["; ".join(why) for why in whys]))
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow([title for title, _ in parts])
    writer.writerows(zip(*(cells for _, cells in parts)))
    return file.getvalue().rstrip("\n")


def _csv_columns(title: str, cells: tuple[Cell, ...]) -> list[tuple[str, list]]:
    plain = [("" if cell.why else cell.text) for cell in cells]
    if not any(cell.interval for cell in cells):
        return [(title, plain)]
    intervals = [cell.interval for cell in cells]
    means = [text if i is None else i.mean for text, i in zip(plain, intervals)]
    halves = ["" if i is None or i.half is None else i.half for i in intervals]
    columns = [(title, means), (f"{title}, half of the 95 % interval", halves)]
    if any(cell.p_value is not None for cell in cells):
        values = ["" if cell.p_value is None else cell.p_value for cell in cells]
        columns.append((f"{title}, p of the paired t-test", values))
    return columns


def latex(table: Table) -> str:
    """A table for LaTeX with the booktabs package, with the reasons for its dashes below."""
    lines = [
        rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}",
        r"\toprule",
        _latex_row(table.head),
        r"\midrule",
        *(_latex_row(cell.text for cell in row) for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    if table.reasons:
        lines += ["", f"--- {latex_text('; '.join(table.reasons))}."]
    return "\n".join(lines)


def _latex_row(texts) -> str:
    return " & ".join(map(latex_text, texts)) + r" \\"


def latex_text(text: str) -> str:
    """Text in which no sign means anything to LaTeX but itself."""
    return "".join(LATEX_SIGNS.get(sign, sign) for sign in text)


FORMATS = {"markdown": markdown, "csv": comma_separated, "latex": latex}
