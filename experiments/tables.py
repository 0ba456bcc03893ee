"""Turns result files into tables, and puts them into a page between markers.

    python -m experiments.tables --workdir=runs/quickstart [--format=csv] [--paper=table_1]
    python -m experiments.tables --page=README.md

The first prints the tables of one experiment or sweep. The second writes every table of a page
anew: each stands between `<!-- results: FOLDER -->` and `<!-- end of results -->`, where FOLDER
holds a `summary.json` and is relative to the page. `<!-- results: FOLDER tables=quality,paper
paper=table_1 -->`, on one line, names which tables, and the paper's whose rows are put beside ours.
"""

from __future__ import annotations

import pathlib
import re
import sys

from absl import flags

from experiments import runtime
from experiments.errors import WorkdirError
from experiments.files import write_atomic
from experiments.report import ReportError
from experiments.report.collected import collect_tables
from experiments.report.formats import FORMATS, latex_text

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of an experiment or of a sweep: print its tables.")
flags.DEFINE_string("page", None, "Markdown file whose tables are written anew.")
flags.DEFINE_enum("format", "markdown", [*FORMATS], "Of what --workdir prints.")
flags.DEFINE_list("tables", None, "Which tables, such as quality,rounds; all by default.")
flags.DEFINE_string("paper", None, "Table of the paper to put beside ours, such as table_1.")

MARKED = re.compile(
    r"(<!-- results: (\S+)((?: \w+=\S+)*) -->\n).*?(<!-- end of results -->)", re.DOTALL
)
# What is no table, as a line of each format.
AS_TEXT = {"markdown": str, "csv": lambda text: f"# {text}", "latex": lambda text: f"% {text}"}


def result_tables(
    folder: pathlib.Path,
    *,
    form: str = "markdown",
    names: list[str] | None = None,
    paper: str | None = None,
) -> str:
    """The tables of an experiment or a sweep, with the command that made them.

    Args:
      folder: where its result files are.
      form: a key of `FORMATS`.
      names: of the tables; None: all.
      paper: a table of the paper; see `run_tables`.

    Raises:
      ReportError: a file that cannot be used, or no such table.
    """
    found = collect_tables(folder, paper)
    unknown = [name for name in names or () if name not in found.tables]
    if unknown:
        raise ReportError(f"{folder}: no table {unknown[0]}; there are {', '.join(found.tables)}")
    as_text, chosen = AS_TEXT[form], names or list(found.tables)
    blocks = [as_text(found.made)]
    for name in chosen:
        title = [] if form == "markdown" else [as_text(name)]
        blocks.append("\n".join([*title, FORMATS[form](found.tables[name])]))
    blocks += [latex_text(n) if form == "latex" else as_text(n) for n in found.notes]
    return "\n\n".join(blocks) + "\n"


def fill_page(text: str, root: pathlib.Path) -> str:
    """The page with every marked table made anew from the results it names."""

    def filled(match: re.Match) -> str:
        head, folder, options, end = match.groups()
        given = dict(option.split("=", 1) for option in options.split())
        names = given.pop("tables", None)
        paper = given.pop("paper", None)
        if given:
            raise ReportError(f"results: {folder}: {next(iter(given))}= is not tables= or paper=")
        names = names.split(",") if names else None
        return f"{head}{result_tables(root / folder, names=names, paper=paper)}{end}"

    return MARKED.sub(filled, text)


def main() -> None:
    if bool(FLAGS.workdir) == bool(FLAGS.page):
        sys.exit("error: give either --workdir or --page")
    try:
        if FLAGS.workdir:
            folder, names = pathlib.Path(FLAGS.workdir), FLAGS.tables
            print(result_tables(folder, form=FLAGS.format, names=names, paper=FLAGS.paper))
            return
        page = pathlib.Path(FLAGS.page)
        text = fill_page(page.read_text(encoding="utf-8"), page.parent)
        write_atomic(page, lambda file: file.write(text.encode()))
    except (ReportError, WorkdirError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
