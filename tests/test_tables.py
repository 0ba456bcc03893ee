"""The README's tables are those that the committed result files make."""

import pathlib

from experiments.report.tables import Cell, Table, markdown
from experiments.tables import MARKED, fill_page

ROOT = pathlib.Path(__file__).parents[1]


def test_markdown_has_a_line_per_row_and_says_why_a_cell_is_empty():
    table = Table(("policy", "PSNR (dB)"), ((Cell("random"), Cell("—", "not measured")),))
    assert markdown(table).splitlines() == [
        "| policy | PSNR (dB) |",
        "| --- | --- |",
        "| random | — |",
        "",
        "— not measured.",
    ]


def test_readme_shows_what_the_result_files_say():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert MARKED.search(text), "README.md has no table of results"
    assert fill_page(text, ROOT) == text, "run python -m experiments.tables --page=README.md"
