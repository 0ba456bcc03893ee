"""Turns result files into Markdown tables, and puts them into a page between markers.

    python -m experiments.tables --workdir=runs/quickstart
    python -m experiments.tables --page=README.md

The first prints the tables of one experiment. The second writes every table of a page anew: each
stands between `<!-- results: FOLDER -->` and `<!-- end of results -->`, where FOLDER holds a result
file of one of the scripts (`result_parts.py`) and is relative to the page.
"""

from __future__ import annotations

import pathlib
import re
import sys

from absl import flags

from experiments import runtime
from experiments.files import write_atomic
from experiments.report import ReportError
from experiments.report.tables import markdown_parts
from experiments.result_parts import result_parts

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of an experiment: print its tables.")
flags.DEFINE_string("page", None, "Markdown file whose tables are written anew.")

MARKED = re.compile(r"(<!-- results: (\S+) -->\n).*?(<!-- end of results -->)", re.DOTALL)


def result_tables(folder: pathlib.Path) -> str:
    """Words and tables about the experiment in a folder, as Markdown; see `result_parts`."""
    return markdown_parts(result_parts(folder))


def fill_page(text: str, root: pathlib.Path) -> str:
    """The page with every marked table made anew from the results it names."""
    return MARKED.sub(lambda m: f"{m[1]}{result_tables(root / m[2])}{m[3]}", text)


def main() -> None:
    if bool(FLAGS.workdir) == bool(FLAGS.page):
        sys.exit("error: give either --workdir or --page")
    try:
        if FLAGS.workdir:
            print(result_tables(pathlib.Path(FLAGS.workdir)))
            return
        page = pathlib.Path(FLAGS.page)
        text = fill_page(page.read_text(encoding="utf-8"), page.parent)
        write_atomic(page, lambda file: file.write(text.encode()))
    except (ReportError, OSError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    runtime.run_script(main)
