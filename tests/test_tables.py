"""The README's tables are those that the committed result files make."""

import json
import pathlib

from experiments.posthoc.tables import cleanup_table, draws_table, geometry_table
from experiments.report.tables import Cell, Table
from experiments.tables import MARKED, fill_page, markdown

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


def cleaned_row(seed, *, before, after, floating):
    def measures(psnr, covered, share, floats, kept):
        test = {"psnr": psnr, "psnr_covered": covered, "psnr_covered_before": before[1]}
        test |= {"share_covered": share, "share_floating": floats}
        return {"test": test, "training": {"content_kept": kept}}

    # Over the pixels that the untouched render covers its PSNR is another one: 99 dB.
    return {
        "seed": seed,
        "before": measures(before[0], 99.0, 1.0, floating[0], 1.0),
        "after": measures(after[0], after[1], 0.95, floating[1], 0.99),
    }


def test_clean_up_is_compared_over_the_same_pixels_seed_by_seed():
    rows = [
        cleaned_row(0, before=(20.0, 22.0), after=(20.5, 23.0), floating=(0.10, 0.02)),
        cleaned_row(1, before=(24.0, 26.0), after=(24.5, 27.0), floating=(0.20, 0.12)),
    ]
    table = cleanup_table(rows)
    texts = {row[0].text: [cell.text for cell in row[1:]] for row in table.rows}
    assert texts["before"][0].startswith("24.00 ±") and texts["after"][0].startswith("25.00 ±")
    assert texts["change"][:2] == ["+1.00 ± 0.00", "+0.50 ± 0.00"]
    assert texts["change"][2:] == ["−5.00 ± 0.00", "−8.00 ± 0.00", "−1.00 ± 0.00"]


def test_measures_that_no_pixel_has_are_dashes_with_a_reason():
    rows = [cleaned_row(0, before=(20.0, None), after=(20.5, None), floating=(None, None))]
    table = cleanup_table(rows)
    assert [row[1].text for row in table.rows] == ["—"] * 3 and table.reasons == (
        "no pixel counts",
    )
    assert [row[2].text for row in table.rows] == ["20.00", "20.50", "+0.50"]


def test_tables_of_draws_and_geometry():
    spread = {"spread": 0.01, "spread_all": 0.005, "rank_correlation": None}
    moved = {"test": spread | {"spread": 0.05}, "farthest": spread | {"spread": 0.09}}
    table = draws_table([{"seed": 0, "training": spread, **moved}])
    assert [row[1].text for row in table.rows] == ["0.0100", "0.0500", "0.0900"]
    error = {"chamfer": 0.02, "accuracy": 0.01, "completeness": 0.03, "f_score": 0.9}
    error |= {"distance": 0.024}
    table = geometry_table([{"seed": 0, "seen": None, "whole": error, "floor": error}])
    assert len(table.rows) == 2 and table.head[-1] == "F-score at 0.024"
    assert [cell.text for cell in table.rows[0][1:]] == ["0.0200", "0.0100", "0.0300", "0.9000"]


def test_result_files_of_trained_runs_fill_a_page(tmp_path):
    rows = [cleaned_row(0, before=(20.0, 22.0), after=(20.5, 23.0), floating=(0.10, 0.02))]
    result = {"command": "python -m x", "device": "CPU", "rows": rows}
    (tmp_path / "cleanup.json").write_text(json.dumps(result))
    page = "<!-- results: . -->\nold\n<!-- end of results -->\n"
    lines = fill_page(page, tmp_path).splitlines()
    assert lines[1] == "`python -m x` (CPU; 1 seed)" and lines[-1] == "<!-- end of results -->"
    assert lines[-2].startswith("| change | +1.00 | +0.50 | −5.00 | −8.00 |")
