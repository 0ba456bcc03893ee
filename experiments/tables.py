"""Turns result files into tables, and puts them into a page between markers.

    python -m experiments.tables --workdir=runs/quickstart [--format=csv] [--paper=table_1]
    python -m experiments.tables --page=README.md

The first prints the tables of one experiment or sweep. The second writes every table of a page
anew: each stands between `<!-- results: FOLDER -->` and `<!-- end of results -->`, where FOLDER
holds a result file of any script and is relative to the page. On the same line, `tables=quality`
names which tables, `policies=bavs,random` which rows, and `paper=table_1` the paper's table whose
rows are put beside ours.
"""

import pathlib
import re
import sys

from absl import flags

from experiments import runtime
from experiments.files import write_atomic
from experiments.reporting.result_tables import collect_all
from experiments.reporting.tables import FORMATS, collected_text
from experiments.runtime import ReportError

FLAGS = flags.FLAGS
flags.DEFINE_string("workdir", None, "Folder of an experiment or of a sweep: print its tables.")
flags.DEFINE_string("page", None, "Markdown file whose tables are written anew.")
flags.DEFINE_enum("format", "markdown", [*FORMATS], "Of what --workdir prints.")
flags.DEFINE_list("tables", [], "Which tables, such as quality,rounds; all by default.")
flags.DEFINE_list("policies", [], "Whose rows, in this order; by default all.")
flags.DEFINE_string("paper", None, "Table of the paper to put beside ours, such as table_1.")

MARKED = re.compile(
    r"(<!-- results: (\S+)((?: \w+=\S+)*) -->\n).*?(<!-- end of results -->)", re.DOTALL
)


def result_tables(
    folder: pathlib.Path, *, form: str = "markdown", names=(), paper: str | None = None, only=()
) -> str:
    """The tables of all result files of a folder, with the commands that made them.

    Of all `names` of tables if none is given, in a form of `FORMATS`; ReportError if there is no
    such table. See `collect_tables` for `paper` and `only`.
    """
    found = collect_all(folder, paper, only)
    known = list(dict.fromkeys(name for one in found for name in one.tables))
    for name in names:
        if name not in known:
            raise ReportError(f"{folder}: no table {name}; there are {', '.join(known)}")
    return "\n".join(collected_text(one, form=form, names=names) for one in found)


def fill_page(text: str, root: pathlib.Path) -> str:
    """The page with every marked table made anew from the results it names."""

    def filled(match: re.Match) -> str:
        head, folder, options, end = match.groups()
        given = dict(option.split("=", 1) for option in options.split())
        lists = [given.pop(key, "") for key in ("tables", "policies")]
        names, only = (text.split(",") if text else [] for text in lists)
        paper = given.pop("paper", None)
        for key in given:
            raise ReportError(f"results: {folder}: {key}= is not tables=, policies= or paper=")
        return f"{head}{result_tables(root / folder, names=names, paper=paper, only=only)}{end}"

    return MARKED.sub(filled, text)


def main() -> None:
    if bool(FLAGS.workdir) == bool(FLAGS.page):
        sys.exit("error: give either --workdir or --page")
    if FLAGS.workdir:
        folder = runtime.given_folder("workdir", "the folder of an experiment", exists=True)
        options = {"names": FLAGS.tables, "paper": FLAGS.paper, "only": FLAGS.policies}
        print(result_tables(folder, form=FLAGS.format, **options))
        return
    page = pathlib.Path(FLAGS.page)
    text = fill_page(page.read_text(encoding="utf-8"), page.parent)
    write_atomic(page, lambda file: file.write(text.encode()))


if __name__ == "__main__":
    runtime.run_script(main)
