"""Tables and file of `evaluate_uncertainty` on made-up rows."""

import copy

import pytest

from experiments.reporting.tables import Table
from experiments.reporting.uncertainty import (
    CONSTANT,
    RESULT_VERSION,
    coverage_table,
    load_result,
    save_result,
    summary_table,
)
from experiments.runtime import ReportError
from experiments.tables import result_tables

LEVELS = [0.5, 0.9, 0.95]


def interval_numbers(coverage, width):
    return {
        "levels": LEVELS,
        "num_calibration_views": 60,
        "num_test_views": 30,
        "coverage": [coverage, 0.9, 0.95],
        "coverage_stderr": [0.01, 0.02, None],
        "decile_coverage": [[0.9] * 10] * 3,
        "mean_width": [0.1, width, None],
        "score": [0.2, 0.3, None],
        "constant_coverage": [0.5, 0.89, 1.0],
        "constant_decile_coverage": [[0.8] * 10] * 3,
        "constant_width": [0.2, 0.5, None],
        "width_ratio": [0.5, width / 0.5, None],
        "score_ratio": [0.4, 0.6, None],
        "share_with_band": 0.98,
        "error_without_band": None,
    }


def make_rows():
    def row(model, seed, own, common):
        def numbers(value):
            return {
                f"{of}_mae_{how}": {"ause": value, "unnormalised": value / 10}
                for of in ("depth", "colour")
                for how in ("per_image", "pooled")
            }

        return {
            "model": model,
            "seed": seed,
            "num_views": 20,
            "psnr": 20.0 + seed,
            "psnr_common": 22.0,
            "own": numbers(own),
            "common": numbers(common),
            "intervals": {"depth": interval_numbers(0.5 + 0.02 * seed, 0.2 + 0.1 * seed)},
        }

    return [
        *(row("laplace", seed, 0.2, 0.2 + 0.01 * seed) for seed in (0, 1)),
        *(row("entropy", seed, 0.4, 0.5 + 0.01 * seed) for seed in (0, 1)),
        row("cf_nerf", 7, 0.1, 0.3),
    ]


def make_result():
    splits = {str(s): {"fit": [0, 1], "calibration": [2, 3, 4], "test": [5]} for s in (0, 1, 7)}
    return {
        "schema_version": RESULT_VERSION,
        "scene": "procedural",
        "kind": "procedural",
        "image_size": [100, 80],
        "command": "python -m x",
        "device": "CPU",
        "config": {"scene": "sculpture", "train": {"num_steps": 1600}},
        "interval_views": splits,
        "rows": make_rows(),
    }


def cells_of(table):
    """By the first cells of a row, the texts by the names of the columns."""
    return {row[0].text: dict(zip(table.head, (cell.text for cell in row))) for row in table.rows}


def test_summary_has_a_row_for_each_model_and_field():
    table = summary_table(make_rows())
    assert len(table.rows) == 6 and len(table.head) == 10
    own, common = cells_of(Table(table.head, table.rows[:3])), table.rows[3:]
    assert own["entropy"]["AUSE depth MAE"] == "0.400 ± 0.000"
    assert own["entropy"]["depth: minus laplace"] == "+0.200 ± 0.000 (p < 0.001)"
    assert own["cf_nerf"]["PSNR of the field (dB)"] == "27.00"
    assert [row[1].text for row in common] == ["common field"] * 3
    assert own["laplace"]["PSNR of the field (dB)"] == "20.50 ± 6.35"
    assert own["laplace"]["depth: minus laplace"] == "—"
    assert common[2][5].why.endswith("share no seed")
    assert common[1][3].text == "22.00 ± 0.00" and common[1][5].text == "+0.300 ± 0.000 (p < 0.001)"


def test_summary_without_depth_says_why():
    rows = copy.deepcopy(make_rows())
    for row in rows:
        for field in ("own", "common"):
            row[field] = {k: v for k, v in row[field].items() if k.startswith("colour")}
    table = summary_table(rows)
    assert table.rows[0][4].text == "—" and "depth: this scene has no true one" in table.reasons
    assert table.rows[1][7].text == "0.400 ± 0.000"


def test_coverage_in_per_cent_with_its_standard_error_beside_one_constant_width():
    cells = cells_of(coverage_table(make_rows(), "depth"))
    assert list(cells) == ["laplace", "entropy", "cf_nerf", CONSTANT]
    ours, constant = cells["laplace"], cells[CONSTANT]
    assert ours["covered at 50% (%)"] == "51.0 ± 1.0" and ours["covered at 95% (%)"] == "95.0"
    assert ours["mean half-width at 90% (scene units)"] == "0.1250"
    assert ours["width / constant's at 50%, 90%, 95%"] == "0.50 / 0.50 / —"
    assert constant["covered at 90% (%)"] == "89.0"
    assert constant["mean half-width at 90% (scene units)"] == "0.2500"


def test_file_gives_the_numbers_back_and_its_tables(tmp_path):
    result = make_result()
    result["rows"][0]["psnr"] = 1.0 / 3.0
    save_result(tmp_path, result)
    read = load_result(tmp_path)
    assert read.keys() == result.keys() and read["interval_views"] == result["interval_views"]
    assert read["rows"][0]["psnr"] == 0.333333  # six digits
    assert [row.keys() for row in read["rows"]] == [row.keys() for row in result["rows"]]
    again = tmp_path / "again"
    save_result(again, read)
    assert load_result(again) == read
    text = result_tables(tmp_path)
    assert text.startswith("`python -m x` (CPU;") and text.count("| laplace |") == 3
    assert "2 views fit the scale, 3 calibrate and 1 test" in text


@pytest.mark.parametrize(
    ("text", "words"),
    [("{", "not JSON"), ('{"schema_version": 1}', "schema_version is 1"), (None, "no such file")],
)
def test_a_file_of_no_use_is_an_error_of_one_line(tmp_path, text, words):
    if text is not None:
        (tmp_path / "uncertainty.json").write_text(text)
    with pytest.raises(ReportError, match=words):
        load_result(tmp_path)


def test_rows_of_none_are_an_error(tmp_path):
    save_result(tmp_path, make_result() | {"rows": []})
    with pytest.raises(ReportError, match="rows"):
        load_result(tmp_path)
