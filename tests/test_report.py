"""The report from files alone: its numbers, its choices, and runs that are less than complete."""

from __future__ import annotations

import html
import json
import re

import numpy as np
import pytest
from scipy import stats as scipy_stats

from experiments.reporting import camera_map, pictures, plots, run_tables, stats
from experiments.reporting.report import make_headline, write_report
from experiments.reporting.results import load_runs
from experiments.runtime import ReportError
from tests import report_files


def _page(workdir) -> str:
    return write_report(workdir).read_text(encoding="utf-8")


def _words(page: str) -> str:
    """The text of a page without its tags, with plain spaces."""
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", page)).split())


def _headline(workdir, results):
    runs = load_runs(report_files.write_workdir(workdir, results, arrays=False))
    return make_headline(runs, list(dict.fromkeys(run.policy for run in runs)))


@pytest.fixture(scope="module")
def full_workdir(tmp_path_factory):
    """Three policies with three seeds each and all arrays."""
    results = [
        report_files.make_result(policy, seed, num_rounds=2)
        for policy in ("random", "farthest", "bavs")
        for seed in range(3)
    ]
    return report_files.write_workdir(tmp_path_factory.mktemp("full"), results)


@pytest.fixture(scope="module")
def full_page(full_workdir):
    return _page(full_workdir)


def test_page_needs_nothing_but_itself(full_page):
    targets = re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"')\s>]*)""", full_page)
    assert len(targets) > 50
    assert all(t.startswith(("data:image/png;base64,", "#")) for t in targets)
    assert "<script" not in full_page
    assert "@import" not in full_page


def test_every_id_is_unique_and_every_reference_has_one(full_page):
    ids = re.findall(r'\sid="([^"]+)"', full_page)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'href="#([^"]+)"', full_page)) <= set(ids)


def test_page_is_deterministic(full_workdir, full_page):
    assert _page(full_workdir) == full_page


def test_headline_has_the_numbers_of_summary_json(full_workdir, full_page):
    summary = json.loads((full_workdir / "summary.json").read_text())
    final = {
        policy: np.array(
            [r["rounds"][-1]["psnr"] for r in summary["runs"] if r["policy"] == policy]
        )
        for policy in ("bavs", "random", "farthest")
    }
    words = _words(full_page)
    assert f"With 8 views, bavs reached a PSNR of {final['bavs'].mean():.2f} ± " in words
    for reference in ("random", "farthest"):
        gaps = final["bavs"] - final[reference]
        half = scipy_stats.t.ppf(0.975, 2) * gaps.std(ddof=1) / np.sqrt(3)
        expected = f"{gaps.mean():+.2f} ± {half:.2f} (p".replace("-", "−")
        assert re.search(rf"{re.escape(expected)} [=<] [0-9.]+\) against {reference}", words)


def test_missing_lpips_is_a_dash_with_its_reason(full_page):
    assert "install bavs_jax[lpips]" in _words(full_page)
    assert not re.search(r"\b(nan|None)\b", _words(full_page))


def test_all_sections_are_there(full_page):
    words = _words(full_page)
    for part in ("Quality against", "Final numbers", "Test views", "Which views", "Where the time"):
        assert part in words
    assert "python -m experiments.active_selection" in words
    assert "0.10.2" in words


def test_of_many_policies_the_few_that_matter_have_a_colour(tmp_path):
    names = [*(f"rival_{i}" for i in range(7)), "farthest", "random", "bavs"]
    results = []
    for place, name in enumerate(names):
        for seed in (0, 1):
            result = report_files.make_result(name, seed, gain=0.0)
            result["rounds"][-1]["psnr"] = 20.0 + place + 0.1 * seed
            results.append(result)
    runs = load_runs(report_files.write_workdir(tmp_path, results, arrays=False))
    policies = plots.by_interest(names)
    assert policies == ["bavs", "random", "farthest", *names[:7]]
    (axes,) = plots.quality_figure(runs, policies, stats.MEASURES[0]).axes
    _, labels = axes.get_legend_handles_labels()
    assert labels == policies[:7]
    gap = stats.paired_gap(*(stats.by_seed(runs, name) for name in ("bavs", "random")))
    np.testing.assert_allclose(gap[:2], [1.0, 0.0], atol=1e-12)
    assert "Grey: the runs of the other policies" in _words(_page(tmp_path))


def test_the_gap_over_rounds_is_paired_and_leaves_the_initial_views_out(full_workdir):
    runs = load_runs(full_workdir)
    by_hand = []
    for seed in range(3):
        ours, theirs = (
            np.mean([r["psnr"] for r in run.rounds if r["num_views"] > 4])
            for name in ("bavs", "farthest")
            for run in runs
            if (run.policy, run.seed) == (name, seed)
        )
        by_hand.append(ours - theirs)
    half = scipy_stats.t.ppf(0.975, 2) * np.std(by_hand, ddof=1) / np.sqrt(3)
    table = run_tables.rounds_table(runs, ["random", "farthest", "bavs"])
    assert table.head[1:3] == ("PSNR at 6 views (dB)", "PSNR at 8 views (dB)")
    cell = table.rows[2][-1]
    np.testing.assert_allclose(cell.interval[:2], [np.mean(by_hand), half])
    p_value = scipy_stats.ttest_1samp(by_hand, 0.0).pvalue
    expected = f"{np.mean(by_hand):+.2f} ± {half:.2f} (p = {p_value:.2g})".replace("-", "−")
    assert cell.text == expected


# --- words -----------------------------------------------------------------------------------


def test_one_seed_is_said_to_prove_little(tmp_path):
    headline = _headline(tmp_path, [report_files.make_result(p) for p in ("bavs", "random")])
    assert "±" not in headline[0]
    assert "One seed proves little" in headline[1]


def test_a_loss_is_called_a_loss(tmp_path):
    results = [
        report_files.make_result(policy, seed, gain=gain)
        for policy, gain in (("bavs", -1.0), ("random", 0.0))
        for seed in range(3)
    ]
    headline = _headline(tmp_path, results)
    assert "−" in headline[0]
    assert "worse than random" in headline[1] and "excludes zero" in headline[1]


def test_an_interval_with_zero_is_no_clear_difference(tmp_path):
    results = [report_files.make_result(p, s) for p in ("bavs", "random") for s in range(3)]
    for result, gap in zip(results, [0.5, -0.4, 0.3, 0.0, 0.0, 0.0]):
        result["rounds"][-1]["psnr"] = 25.0 + gap
    assert "no clear difference" in _headline(tmp_path, results)[1]


# --- degenerate folders ----------------------------------------------------------------------


def test_one_policy_with_one_seed_and_no_pictures(tmp_path):
    workdir = report_files.write_workdir(tmp_path, [report_files.make_result("bavs")], arrays=False)
    words = _words(_page(workdir))
    assert "nothing to compare it with: add random to config.policies" in words
    assert "No pictures: no run of bavs has any" in words
    assert "has no acquisition.npz yet" in words


def test_incomplete_runs_are_named_and_left_out_of_means(tmp_path):
    results = [report_files.make_result(p, s) for p in ("bavs", "random") for s in range(2)]
    results[1]["completed"] = False
    results[1]["rounds"] = results[1]["rounds"][:2]
    workdir = report_files.write_workdir(tmp_path, results, arrays=False)
    runs = load_runs(workdir)
    ours, theirs = (stats.by_seed(runs, name) for name in ("bavs", "random"))
    assert ours == {0: results[0]["rounds"][-1]["psnr"]}
    assert stats.paired_gap(ours, theirs).num == 1
    assert "left out of all means: bavs, seed 1." in _words(_page(workdir))


@pytest.mark.parametrize("rounds_left", [0, 1])
def test_runs_that_chose_nothing(tmp_path, rounds_left):
    result = report_files.make_result("bavs", num_rounds=0, completed=False)
    result["rounds"] = result["rounds"][:rounds_left]
    words = _words(_page(report_files.write_workdir(tmp_path, [result])))
    assert "There is no result yet." in words
    assert "no view has been chosen beyond the initial ones" in words


def test_no_run_at_all(tmp_path):
    assert "There is no result yet." in _words(_page(report_files.write_workdir(tmp_path, [])))


def test_null_and_nan_measures_do_not_reach_the_page(tmp_path):
    results = [report_files.make_result(policy) for policy in ("bavs", "random")]
    for one in results[0]["rounds"]:
        one["psnr"], one["depth_mae"] = None, float("nan")
    page = _page(report_files.write_workdir(tmp_path, results, arrays=False))
    assert "bavs reached a PSNR of — dB" in _words(page)
    assert "PSNR: not measured" in _words(page)
    assert "not a finite number" in _words(page)
    assert not re.search(r">[^<]*\bnan\b", page)


def test_text_from_files_is_escaped(tmp_path):
    result = report_files.make_result("bavs", command="run --x='<script>alert(1)</script>'")
    assert "<script>" not in _page(report_files.write_workdir(tmp_path, [result], arrays=False))


@pytest.mark.parametrize(
    "content, message",
    [
        (None, "no such file"),
        ("{", "not JSON"),
        ('{"schema_version": 9, "runs": []}', "schema_version is 9"),
        ('{"schema_version": 1, "runs": [{"policy": "bavs"}]}', "a run lacks scene"),
    ],
)
def test_unusable_summary_is_named(tmp_path, content, message):
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    with pytest.raises(ReportError, match=rf"summary\.json: .*{message}"):
        write_report(tmp_path)


def test_two_scenes_are_not_mixed(tmp_path):
    results = [report_files.make_result("bavs", seed) for seed in range(2)]
    results[1]["scene"] = {**results[1]["scene"], "name": "lego"}
    with pytest.raises(ReportError, match="scene differs"):
        write_report(report_files.write_workdir(tmp_path, results, arrays=False))


# --- statistics, maps, pictures --------------------------------------------------------------


def test_mean_interval_agrees_with_scipy():
    values = np.array([24.1, 25.3, 24.7, 26.0])
    interval = stats.mean_interval(values)
    expected = scipy_stats.t.interval(0.95, 3, values.mean(), scipy_stats.sem(values))
    found = [interval.mean - interval.half, interval.mean + interval.half]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert stats.mean_interval([]) is None


def test_gap_is_paired_so_the_luck_of_a_seed_cancels(tmp_path):
    results = [report_files.make_result(p, s) for p in ("bavs", "random") for s in range(3)]
    for result, level in zip(results, [21.0, 25.0, 29.0, 20.0, 24.0, 28.0]):
        result["rounds"][-1]["psnr"] = level
    runs = load_runs(report_files.write_workdir(tmp_path, results, arrays=False))
    gap = stats.paired_gap(*(stats.by_seed(runs, name) for name in ("bavs", "random")))
    np.testing.assert_allclose(gap[:2], [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 2, -3)])
def test_projection_keeps_areas_and_its_landmarks(up):
    up = np.array(up, float) / np.linalg.norm(up)
    directions = np.random.default_rng(0).normal(size=(20000, 3))
    points = camera_map.equal_area(directions, up)
    # Uniform on the sphere is uniform on the disc of radius 2: a circle of radius r holds r^2 / 4.
    inside = np.mean(np.linalg.norm(points, axis=-1) < 1.0)
    np.testing.assert_allclose(inside, 0.25, atol=4 * np.sqrt(0.25 * 0.75 / 20000))  # 4 s.e.
    np.testing.assert_allclose(camera_map.equal_area(3 * up[None], up), [[0, 0]], atol=1e-7)
    horizon = np.cross(up, directions[:5])
    radii = np.linalg.norm(camera_map.equal_area(horizon, up), axis=-1)
    np.testing.assert_allclose(radii, np.sqrt(2.0), rtol=1e-12)


def test_projection_is_seen_from_above():
    up = np.array([0.0, 0.0, 1.0])
    points = camera_map.equal_area(np.eye(3)[:2], up)  # x to the right, y to the top
    np.testing.assert_allclose(points, np.sqrt(2.0) * np.eye(2), atol=1e-12)


def test_cameras_within_a_scene_are_drawn_on_a_plan():
    rng = np.random.default_rng(0)
    around = rng.normal(size=(50, 3))
    around *= rng.uniform(1.0, 2.9, (50, 1)) / np.linalg.norm(around, axis=-1, keepdims=True)
    assert not camera_map.stand_within(around)
    assert camera_map.stand_within(rng.uniform(-1.0, 1.0, (50, 3)))
    # Up to a turn, distances on the plan are the level parts of distances.
    up = np.array([1.0, 2.0, -2.0]) / 3.0
    level = around - np.outer(around @ up, up)
    apart, wanted = (
        np.linalg.norm(x[:, None] - x, axis=-1) for x in (camera_map.plan(around, 5.0 * up), level)
    )
    np.testing.assert_allclose(apart, wanted, atol=1e-12)


def test_choices_are_named_with_their_scores_and_what_the_run_knows_of_them(tmp_path):
    result = report_files.make_result("bavs", num_rounds=2)
    workdir = report_files.write_workdir(tmp_path, [result], arrays=False)
    nan = np.nan
    acquisition = {
        "positions": np.zeros((5, 3)),
        "scores": np.array([[nan, 0.9, 0.5, 0.7, 0.1], [nan, nan, nan, 0.2, nan]]),
        "selected": np.array([[3, 2], [4, -1]]),
    }
    table = run_tables.choices_table(load_runs(workdir)[0], acquisition)
    assert [row[0].text for row in table.rows] == ["1", "2"]
    assert [row[-1].text for row in table.rows] == ["view 3 (0.7), view 2 (0.5)", "view 4"]
    # Columns of what this policy never has, such as the bound of a greedy batch, are left out.
    assert table.head[1:-1] == ("left by the distance filter", "farthest-view would share")
    assert [cell.text for cell in table.rows[0][1:-1]] == ["35", "1"]


@pytest.mark.parametrize("capture", ["orbit of many distances", "forward facing", "in the centre"])
def test_maps_of_captures_that_are_no_orbit(capture):
    acquisition = report_files.make_acquisition("bavs", 0, 2)
    rng = np.random.default_rng(3)
    offsets = acquisition["positions"] - acquisition["centre"]
    if capture == "orbit of many distances":
        offsets = offsets * rng.uniform(0.5, 1.5, (len(offsets), 1))
    elif capture == "forward facing":
        offsets = np.array([4.0, 0.0, 0.2]) + 0.3 * rng.normal(size=offsets.shape)
    else:
        offsets[17] = 0.0
    acquisition["positions"] = acquisition["centre"] + offsets
    svg = camera_map.map_plot(acquisition, salt="test")
    assert svg.startswith("<svg ")
    assert "nan" not in svg


def test_shrink_averages_areas_of_colours_and_of_values():
    image = np.arange(2 * 4 * 3, dtype=np.uint8).reshape(2, 4, 3) * 4
    blocks = image.reshape(2, 2, 2, 3).mean(axis=(0, 2))
    np.testing.assert_allclose(pictures.shrink(image, 2)[0], blocks, atol=0.5)  # rounded to 8 bits
    values = np.float32([[0.0, 1.0], [2.0, 5.0]])
    np.testing.assert_allclose(pictures.shrink(values, 1), [[2.0]])
    assert pictures.shrink(values, 2) is values
