"""Tables of result files in every format; the README's are those that the committed files make."""

import csv
import io
import itertools
import json
import pathlib

import numpy as np
import pytest
from scipy import stats as scipy_stats

from experiments.reporting import stats
from experiments.reporting.result_tables import (
    cleanup_table,
    collect_tables,
    draws_table,
    geometry_table,
)
from experiments.reporting.results import load_runs
from experiments.reporting.run_tables import PAPER
from experiments.reporting.tables import (
    Cell,
    Table,
    comma_separated,
    interval_cell,
    latex,
    markdown,
)
from experiments.runtime import ReportError
from experiments.sweep_plan import Record, write_record
from experiments.tables import MARKED, fill_page, result_tables
from tests.report_files import make_result, write_workdir

ROOT = pathlib.Path(__file__).parents[1]
POLICIES, SEEDS = ("random", "farthest", "bavs", "bavs_topk"), range(5)


@pytest.fixture(scope="module")
def workdir(tmp_path_factory):
    results = [make_result(p, s) for p in POLICIES for s in SEEDS]
    return write_workdir(tmp_path_factory.mktemp("runs"), results, arrays=False)


def final_psnr(policy):
    return np.array([make_result(policy, s)["rounds"][-1]["psnr"] for s in SEEDS])


# --- formats ---


def test_markdown_has_a_line_per_row_and_says_why_a_cell_is_empty():
    table = Table(("policy", "PSNR (dB)"), ((Cell("random"), Cell("—", "not measured")),))
    assert markdown(table).splitlines() == [
        "| policy | PSNR (dB) |",
        "| --- | --- |",
        "| random | — |",
        "",
        "— not measured.",
    ]


def test_csv_has_full_numbers_and_leaves_cells_empty_with_the_reason_at_the_end():
    gap = stats.mean_interval([0.1, 0.25, 0.4])
    rows = (
        (Cell("bavs, ours"), interval_cell(gap, 2, "", gap=True)),
        (Cell("random"), Cell("—", "no gap to itself")),
    )
    first, second = csv.DictReader(io.StringIO(comma_separated(Table(("policy", "gap"), rows))))
    half = "gap, half of the 95 % interval"
    p_value = "gap, p of the paired t-test"
    assert first["policy"] == "bavs, ours" and first["why cells are empty"] == ""
    numbers = [float(first[name]) for name in ("gap", half, p_value)]
    assert numbers == [gap.mean, gap.half, stats.paired_p_value(gap)]
    assert [second[n] for n in ("gap", half, p_value)] == ["", "", ""]
    assert second["why cells are empty"] == "no gap to itself"


def test_latex_gives_every_sign_its_own_meaning():
    table = Table(("a_b", "50 %"), ((Cell("x & y"), Cell("−0.25 ± 0.1 (p < 0.001)")),))
    assert latex(table).splitlines() == [
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"a\_b & 50 \% \\",
        r"\midrule",
        r"x \& y & $-$0.25 $\pm$ 0.1 (p $<$ 0.001) \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    assert latex(Table(("a",), ((Cell("—", "100 % missing"),),))).endswith(
        "\n\n--- 100 \\% missing."
    )


@pytest.mark.parametrize("form", ["markdown", "csv", "latex"])
def test_every_format_has_every_table(workdir, form):
    text = result_tables(workdir, form=form)
    for policy in POLICIES:
        assert text.count(policy.replace("_", "\\_") if form == "latex" else policy) >= 3
    only = result_tables(workdir, form=form, names=["time"])
    assert "training" in only and "PSNR" not in only
    with pytest.raises(ReportError, match="no table nothing; there are quality"):
        result_tables(workdir, names=["nothing"])


# --- the paired test ---


def test_p_is_that_of_the_paired_t_test(workdir):
    expected = scipy_stats.ttest_rel(final_psnr("bavs"), final_psnr("random")).pvalue
    runs = collect_tables(workdir).tables["quality"].rows
    cell = next(row for row in runs if row[0].text == "bavs")[-2]  # gaps to random and farthest
    np.testing.assert_allclose(cell.p_value, expected, rtol=1e-9)  # the same formula in float64
    assert f"(p = {expected:.2g})" in cell.text or "(p < 0.001)" in cell.text


def test_p_is_below_5_percent_just_where_the_interval_excludes_zero():
    rng = np.random.default_rng(0)
    sides = set()
    for _ in range(200):
        gap = stats.mean_interval(rng.normal(0.8, 1.0, size=5))
        excludes = abs(gap.mean) > gap.half
        assert (stats.paired_p_value(gap) < 0.05) == excludes
        sides.add(excludes)
    assert sides == {True, False}


def test_p_agrees_with_flipping_the_signs_of_many_seeds():
    gaps = np.random.default_rng(1).normal(0.3, 1.0, size=14)
    flips = np.array(list(itertools.product((-1, 1), repeat=14)))
    by_flips = np.mean(np.abs(flips @ gaps) >= np.abs(gaps.sum()) - 1e-12)
    # Gaps of 14 normal seeds: both tests ask the same, up to the shape of the tails.
    np.testing.assert_allclose(stats.paired_p_value(stats.mean_interval(gaps)), by_flips, atol=0.02)


def test_p_of_one_seed_and_of_equal_gaps():
    assert stats.paired_p_value(stats.mean_interval([0.5])) is None
    assert stats.paired_p_value(stats.mean_interval([0.5, 0.5])) == 0.0
    assert stats.paired_p_value(stats.mean_interval([0.0, 0.0])) == 1.0


# --- the paper beside ours ---


def test_the_papers_rows_stand_beside_ours(workdir):
    table = collect_tables(workdir, "table_1").tables["paper"]
    rows = {row[0].text: dict(zip(table.head, row)) for row in table.rows}
    assert [row[1].text for row in table.rows[:5]] == [row.name for row in PAPER["table_1"]]
    assert rows["bavs"]["PSNR (dB)"].text.startswith(f"{final_psnr('bavs').mean():.2f} ± ")
    texts = [cell.text for cell in table.rows[4]]
    assert texts[3] == "29.02" and texts[-1] == "+1.88"  # 29.023 - 27.138, as a float
    assert rows["activenerf"]["PSNR (dB)"].why == "activenerf: no completed run"
    assert rows["farthest"]["in the paper"].why == "the paper prints no such number"


def test_table_2_starts_from_the_initial_views(workdir):
    table = collect_tables(workdir, "table_2").tables["paper"]
    first = [make_result("random", s)["rounds"][0]["psnr"] for s in SEEDS]
    assert table.rows[0][0].text == "initial views" and table.rows[0][1].text == "Origin"
    np.testing.assert_allclose(table.rows[0][2].interval.mean, np.mean(first))


def test_table_4_has_time_and_candidates(workdir):
    table = collect_tables(workdir, "table_4").tables["paper"]
    bavs = dict(zip(table.head, table.rows[1]))
    # As report_files makes them: 4 rounds with 6 s of scoring and 0.02 s of selecting; 35 left.
    np.testing.assert_allclose(bavs["scoring and selecting (s)"].interval.mean, 4 * 6.02)
    assert bavs["candidates scored"].text == "35"
    topk = dict(zip(table.head, table.rows[0]))
    assert "not in its result files" in topk["candidates scored"].why
    with pytest.raises(ReportError, match="table_9: no such table"):
        collect_tables(workdir, "table_9")


# --- sweeps ---


def make_sweep(folder):
    """Two settings: the second is 1 dB better, lacks a seed, and a third has nothing at all."""
    rows = [
        {"folder": f"L={n}", "values": {"L": n}, "policies": ["random", "bavs"], "seeds": [0, 1, 2]}
        for n in (5, 6, 7)
    ]
    log = "L=6/bavs/seed_2/log.txt"
    write_record(
        folder,
        Record("the command", rows, {"L=6/bavs/seed_2": f"failed: out of luck (log: {log})"}),
    )
    for n, seeds in ((5, (0, 1, 2)), (6, (0, 1))):
        results = [make_result(p, s) for p in ("random", "bavs") for s in seeds]
        for result in results if n == 6 else ():
            result["rounds"][-1]["psnr"] += 1.0
        write_workdir(folder / f"L={n}", results, arrays=False)
    return folder


def test_settings_are_compared_seed_by_seed(tmp_path):
    table = collect_tables(make_sweep(tmp_path)).tables["settings"]
    assert table.head[:4] == ("L", "policy", "seeds", "views")
    assert table.head[-1] == "PSNR gap to L=5 (dB)"
    rows = {(row[0].text, row[1].text): row for row in table.rows}
    assert list(rows) == [(n, p) for n in "567" for p in ("random", "bavs")]
    gap = rows["6", "bavs"][-1].interval
    np.testing.assert_allclose([gap.mean, gap.half, gap.num], [1.0, 0.0, 2], atol=1e-9)
    assert rows["5", "bavs"][-1].why == "a setting has no gap to itself"
    assert rows["7", "bavs"][-1].why == "L=7, bavs: no completed run"


def test_settings_that_set_different_options_go_by_their_names(tmp_path):
    changes = {
        "unchanged": {},
        "L=5": {"L": 5},
        "weighting=a": {"weighting": "a"},
    }
    rows = [
        {"folder": name, "values": values, "policies": ["bavs"], "seeds": [0, 1]}
        for name, values in changes.items()
    ]
    write_record(tmp_path, Record("the command", rows, {}))
    for name in changes:
        write_workdir(tmp_path / name, [make_result("bavs", s) for s in (0, 1)], arrays=False)
    table = collect_tables(tmp_path).tables["settings"]
    assert table.head[:2] == ("setting", "policy")
    assert table.head[-1] == "PSNR gap to unchanged (dB)"
    assert [row[0].text for row in table.rows] == [*changes]


def settings_of(tmp_path, all_values):
    """The settings table of a sweep whose n-th setting ends n dB above the first."""
    rows = []
    for number, values in enumerate(all_values):
        name = ",".join(f"{option}={value}" for option, value in values.items())
        rows.append({"folder": name, "values": values, "policies": ["bavs"], "seeds": [0]})
        result = make_result("bavs", 0)
        result["rounds"][-1]["psnr"] = 20.0 + number
        write_workdir(tmp_path / name, [result], arrays=False)
    write_record(tmp_path, Record("the command", rows, {}))
    return collect_tables(tmp_path).tables["settings"]


def test_a_setting_is_compared_with_the_first_that_is_most_like_it(tmp_path):
    grid = [
        {"scene": scene, "num_initial": views, "train.num_steps": steps}
        for scene in ("lego", "ship")
        for views in (8, 12)
        for steps in (1, 3)
    ]
    table = settings_of(tmp_path, grid)
    assert table.head[-1] == "PSNR gap to train.num_steps=1 (dB)"
    assert [row[-1].text for row in table.rows] == ["—", "+1.00"] * 4


def test_options_that_change_together_are_compared_within_a_scene(tmp_path):
    both = [
        {"scene": scene, "from_scratch": anew, "train.num_steps": steps}
        for scene in ("lego", "ship")
        for anew, steps in ((True, 3), (False, 1))
    ]
    table = settings_of(tmp_path, both)
    assert table.head[-1] == "PSNR gap to from_scratch=True,train.num_steps=3 (dB)"
    assert [row[-1].text for row in table.rows] == ["—", "+1.00"] * 2


def test_scenes_are_not_compared_with_each_other(tmp_path):
    rows = [{"loader": "blender", "scene": s, "train.num_rays": 2} for s in ("lego", "ship")]
    assert settings_of(tmp_path, rows).head[-1] == "Depth error (scene units)"


def make_scenes(folder, names=("lego", "ship")):
    """A sweep over scenes: each is 2 dB above the one before, and one run is missing."""
    rows = []
    for number, name in enumerate(names):
        rows.append({"folder": f"scene={name}", "values": {"scene": name}})
        rows[-1] |= {"policies": ["random", "bavs"], "seeds": [0, 1, 2]}
        results = [make_result(p, s) for p in ("random", "bavs") for s in (0, 1, 2)]
        for result in results:
            result["scene"]["name"] = name
            result["rounds"][-1]["psnr"] += 2.0 * number
            result["rounds"][-1]["num_survivors"] = 10 * number
            result["rounds"][-1]["seconds"]["score"] = 3.0 * number
        write_workdir(folder / f"scene={name}", results[: 6 - number], arrays=False)
    write_record(folder, Record("over scenes", rows, {}))
    return folder


def test_a_sweep_over_scenes_has_their_mean_and_the_papers_rows(tmp_path):
    found = collect_tables(make_scenes(tmp_path), "table_1")
    assert found.tables["settings"].head[-1] == "PSNR gap to random (dB)"
    assert found.notes[0] == "Tables after the first are of means over these 2 scenes."
    rows = {row[0].text: row for row in found.tables["quality"].rows}
    of_lego = collect_tables(tmp_path / "scene=lego").tables["quality"]
    one = {row[0].text: row for row in of_lego.rows}
    assert (rows["random"][1].text, rows["bavs"][1].text) == ("3", "2")  # seeds that all have
    level, alone = (float(r["random"][3].text.split()[0]) for r in (rows, one))
    assert level == pytest.approx(alone + 1.0, abs=0.011)
    row = next(row for row in found.tables["paper"].rows if row[0].text == "random")
    assert row[2].text == rows["random"][3].text and row[3].text == "27.14"


def test_means_over_scenes_are_taken_seed_by_seed(tmp_path):
    folder = make_scenes(tmp_path)
    scenes = [load_runs(folder / f"scene={name}") for name in ("lego", "ship")]
    runs = stats.in_all_scenes(scenes)
    assert sorted(run.label for run in runs if run.policy == "bavs") == (
        ["bavs, seed 0"] * 2 + ["bavs, seed 1"] * 2
    )
    one, other = (stats.by_seed(some, "random") for some in scenes)
    means = {seed: pytest.approx((one[seed] + other[seed]) / 2) for seed in (0, 1, 2)}
    assert stats.by_seed(runs, "random") == means
    assert stats.by_seed(runs, "random", "lpips") == {}
    found = stats.run_seconds(runs, "random", "score")
    assert (found.mean, found.num) == (pytest.approx(1.5), 3)  # 0 s on lego, 3 s on ship


def test_a_sweep_over_options_has_no_row_of_the_paper(tmp_path):
    with pytest.raises(ReportError, match="table_1 is over scenes; give the folder of one"):
        collect_tables(make_sweep(tmp_path), "table_1")
    table = collect_tables(tmp_path, only=["bavs"]).tables["settings"]
    assert {row[1].text for row in table.rows} == {"bavs"}


def test_what_is_missing_of_a_sweep_says_why(tmp_path):
    text = result_tables(make_sweep(tmp_path))
    assert "the command" in text
    assert "Missing: L=6, bavs, seed 2: failed: out of luck (log: L=6/bavs/seed_2/log.txt)." in text
    assert "Missing: L=7, random, seed 0: not run yet." in text
    assert "Missing: L=5" not in text


def test_a_sweep_over_seeds_alone_reads_like_an_experiment(tmp_path):
    write_workdir(tmp_path, [make_result("random", s) for s in (0, 1)], arrays=False)
    row = {"folder": ".", "values": {}, "policies": ["random", "bavs"], "seeds": [0, 1]}
    write_record(tmp_path, Record("swept", [row], {}))
    found = collect_tables(tmp_path)
    assert found.made.startswith("`swept`")
    assert [row[0].text for row in found.tables["quality"].rows] == ["random", "bavs"]
    assert found.notes == [f"Missing: bavs, seed {s}: not run yet." for s in (0, 1)]
    assert collect_tables(tmp_path, only=["random"]).notes == []


# --- pages ---


def test_a_page_names_its_tables(workdir, tmp_path):
    mark = f"<!-- results: {workdir} tables=paper paper=table_1 -->"
    page = fill_page(f"a\n{mark}\nold\n<!-- end of results -->\nb", tmp_path)
    assert "ActiveNeRF*" in page and "old" not in page and "training" not in page
    assert page.startswith(f"a\n{mark}\n") and page.endswith("<!-- end of results -->\nb")
    with pytest.raises(ReportError, match="colour="):
        fill_page(f"<!-- results: {workdir} colour=red -->\n<!-- end of results -->", tmp_path)


def test_a_page_names_its_rows(tmp_path):
    runs = [
        make_result(policy, seed) for policy in ("bavs", "random", "farthest") for seed in (0, 1)
    ]
    write_workdir(tmp_path, runs, arrays=False)
    page = "<!-- results: . tables=quality policies={} -->\n<!-- end of results -->"
    rows = fill_page(page.format("random,bavs"), tmp_path).splitlines()
    starts = [row.split("|")[1].strip() for row in rows if row.startswith("|")]
    assert starts == ["policy", "---", "random", "bavs"]
    with pytest.raises(ReportError, match="no run of entropy; there are bavs, random, farthest"):
        fill_page(page.format("entropy"), tmp_path)


@pytest.mark.parametrize(
    "page",
    [
        "README.md",
        *(
            f"experiments/results/{n}.md"
            for n in ("README", "POLICIES", "PAPER", "FIELDS", "TRIES")
        ),
    ],
)
def test_pages_show_what_the_result_files_say(page):
    path = ROOT / page
    text = path.read_text(encoding="utf-8")
    assert MARKED.search(text), f"{page} has no table of results"
    filled = fill_page(text, path.parent)
    assert filled == text, f"run python -m experiments.tables --page={page}"


def test_a_broken_record_is_one_line(tmp_path):
    write_workdir(tmp_path, [make_result()], arrays=False)
    (tmp_path / "sweep.json").write_text(json.dumps({"schema_version": 9}))
    with pytest.raises(ValueError, match="schema_version is 9") as error:
        collect_tables(tmp_path)
    assert "\n" not in str(error.value)


# --- results of other scripts ---


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
    changes = [text.removesuffix(" (p < 0.001)") for text in texts["change"]]
    assert changes[:2] == ["+1.00 ± 0.00", "+0.50 ± 0.00"]
    assert changes[2:] == ["−5.00 ± 0.00", "−8.00 ± 0.00", "−1.00 ± 0.00"]


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
    result = {"schema_version": 1, "command": "python -m x", "device": "CPU", "rows": rows}
    (tmp_path / "cleanup.json").write_text(json.dumps(result))
    page = "<!-- results: . -->\nold\n<!-- end of results -->\n"
    lines = fill_page(page, tmp_path).splitlines()
    assert lines[1] == "`python -m x` (CPU; 1 seed)" and lines[-1] == "<!-- end of results -->"
    assert lines[-2].startswith("| change | +1.00 | +0.50 | −5.00 | −8.00 |")
