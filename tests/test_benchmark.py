"""The benchmark: what is counted, what is fitted, and a tiny run from end to end."""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bavs_jax.selection.batch import SelectionInfo, acquire
from bavs_jax.selection.distances import pairwise_distances
from bavs_jax.selection.policies import get_policy
from experiments.bench.measure import benchmark
from experiments.bench.page import ceiling_plot
from experiments.bench.results import BENCHMARK, STAGES, amount, benchmark_tables, duration
from experiments.bench.stages import make_selection_run
from experiments.bench.subject import default_sizes, make_subject
from experiments.bench.timing import (
    Work,
    compiled_work,
    fit_growth,
    measure_ceilings,
    timed,
    timed_runs,
)
from experiments.bench.work import selection_work, slot_width
from experiments.build_scene import load_config_scene
from experiments.reporting.tables import collected_text
from tests.toy_runs import toy_config

pytestmark = pytest.mark.usefixtures("quick_compilation")

SIZES = {
    "repeats": 2,
    "train_calls": 1,
    "render_rays": 4096,
    "curvature_rays": 512,
    "candidates": 4,
    "candidate_pixels": 8,
    "select_candidates": 32,
    "batch_size": 4,
    "matmul": 256,
    "copy_mb": 1,
    "growth.repeats": 1,
    "growth.train_calls": 1,
    # Two sizes where nothing is compiled anew.
    "growth.train_rays": (64,),
    "growth.render_rays": (2048, 4096),
    "growth.curvature_rays": (256, 512),
    "growth.grid_log2": (4,),
    "growth.grid_rays": 128,
    "growth.candidates": (8, 16),
    "growth.candidate_pixels": 4,
    "growth.batch_size": (2,),
}


@pytest.fixture
def measured_without_counts(tmp_path):
    """The results page's own file, as a GPU would leave it."""
    path = pathlib.Path("experiments/results/benchmark") / BENCHMARK
    result = json.loads(path.read_text())
    for name, stage in result["stages"].items():
        if name != "train":
            stage |= {"flops_per_run": 0.0, "flops_per_s": 0.0, "share_of_matmul_ceiling": 0.0}
    (tmp_path / BENCHMARK).write_text(json.dumps(result))
    return tmp_path / BENCHMARK


# --- counts ----------------------------------------------------------------------------------


def test_matrix_product_is_counted_as_its_closed_form():
    m, k, n = 48, 32, 16
    work = compiled_work(jnp.matmul, jnp.ones((m, k)), jnp.ones((k, n)))
    assert work.flops == 2 * m * k * n
    assert work.bytes == 4 * (m * k + k * n + m * n)


def test_counts_need_shapes_only_and_know_that_fused_steps_pass_nothing_through_memory():
    x = jax.ShapeDtypeStruct((1000,), jnp.float32)
    work = compiled_work(lambda x: 2.0 * x + 1.0, x)
    assert work == Work(flops=2 * 1000, bytes=2 * 4 * 1000)


def test_unrolled_steps_add_up_and_a_loop_counts_once():
    a = jnp.ones((32, 32))
    product = compiled_work(jnp.matmul, a, a)
    unrolled = compiled_work(lambda a: a @ a @ a @ a, a)
    assert unrolled.flops == (product * 3).flops
    loop = compiled_work(lambda a: jax.lax.fori_loop(0, 3, lambda _, x: x @ a, a), a)
    # The loop's own counter is counted too.
    np.testing.assert_allclose(loop.flops, product.flops, rtol=1e-3)


def test_operations_are_counted_without_the_device_that_holds_the_arrays(monkeypatch):
    """As on a GPU, whose compiler counts none."""
    devices, original = [], jax.stages.Lowered.cost_analysis

    def watched(self):
        devices.append(jax.config.jax_default_device)
        return original(self)

    monkeypatch.setattr(jax.stages.Lowered, "cost_analysis", watched)
    key, tree = jax.random.key(0), {"x": 1.0}  # a type of its own, and a bare number
    work = compiled_work(lambda key, tree: jax.random.normal(key, (3,)) + tree["x"], key, tree)
    assert work.flops > 0 and work.bytes > 0
    assert devices == [jax.devices("cpu")[0]]


def test_stages_without_counts_have_no_share(measured_without_counts):
    table = collected_text(benchmark_tables(measured_without_counts))
    assert "operations were not counted on this device" in table
    assert "0 FLOP" not in table
    svg = ceiling_plot(json.loads(measured_without_counts.read_text()))
    assert svg.count("scoring candidates") == 0 and svg.count("training") == 1


def test_work_adds_subtracts_and_scales():
    assert (Work(5.0, 7.0) + Work(1.0, 1.0)) * 2 - Work(2.0, 6.0) == Work(10.0, 10.0)


@pytest.mark.parametrize("mean, width", [(0.3, 8), (8.0, 8), (8.1, 16), (33.0, 64), (100.0, 64)])
def test_slot_width_holds_the_mean_ray(mean, width):
    assert slot_width(mean, 64) == width


# --- ceilings and clock ----------------------------------------------------------------------


def test_ceilings_are_what_the_best_run_reached(monkeypatch):
    """With a clock that says 4 s, then 2 s, for each kind of program."""
    runs = iter([([4.0, 2.0], []), ([4.0, 2.0], [])])
    monkeypatch.setattr("experiments.bench.timing.timed_runs", lambda fn, repeats: next(runs))
    ceilings = measure_ceilings(matmul=100, copy_mb=1, repeats=2)
    assert ceilings.flops_per_s == 2 * 100**3 / 2.0
    assert ceilings.bytes_per_s == 2 * 10**6 / 2.0


def test_timing_waits_for_the_result(monkeypatch):
    """With a clock that only work moves: 1 s until a call returns, 5 s more for each result."""
    now = [0.0]
    monkeypatch.setattr("experiments.bench.timing.time.perf_counter", lambda: now[0])

    class Pending:
        def block_until_ready(self):
            now[0] += 5.0
            return self

    results = {"a": Pending(), "b": [Pending()]}

    def dispatch():
        now[0] += 1.0
        return results

    assert timed(dispatch) == (11.0, results)
    assert timed_runs(dispatch, 3) == ([11.0] * 3, [results] * 3)


# --- stages ----------------------------------------------------------------------------------


def test_selection_is_timed_by_the_path_of_runs():
    config = toy_config()
    subject = make_subject(config, load_config_scene(config, cache_dir=None), 3)
    run, ctx = make_selection_run(subject, 32, 4)
    selected, info = run()
    chosen, expected = acquire(get_policy("bavs"), jax.random.key(1), ctx, 4)
    np.testing.assert_array_equal(selected, chosen)
    assert isinstance(info, SelectionInfo) and 4 <= info.survivors.sum() < 32
    np.testing.assert_array_equal(info.scores, expected.scores)
    one = compiled_work(pairwise_distances, ctx.positions, ctx.positions[:1])
    fewer = info._replace(survivors=info.survivors & (np.cumsum(info.survivors) <= 4))
    extra = selection_work(ctx, info).flops - selection_work(ctx, fewer).flops
    # A survivor is compared with all candidates by the filter, and again where it is ranked.
    assert extra == 2 * one.flops * (info.survivors.sum() - 4)


# --- fits ------------------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0, 3.0])
def test_power_laws_give_their_exponent(exponent):
    sizes = np.array([5, 10, 40, 100])
    fit = fit_growth(sizes, 0.02 * sizes**exponent)
    np.testing.assert_allclose(fit.exponent, exponent, atol=1e-10)


def test_a_fixed_cost_is_told_from_linear_growth():
    sizes = np.array([25, 100, 400, 1000])
    fit = fit_growth(sizes, 0.3 + 0.001 * sizes)
    np.testing.assert_allclose([fit.intercept_s, fit.slope_s], [0.3, 0.001], rtol=1e-9)
    assert fit.largest_deviation < 1e-9 and 0.0 < fit.exponent < 1.0


def test_what_is_not_linear_is_off_the_line():
    sizes = np.array([1.0, 2.0, 4.0, 8.0])
    assert fit_growth(sizes, sizes**2).largest_deviation > 0.2


@pytest.mark.parametrize(
    "value, text", [(0.5, "0.5 "), (1234.0, "1.23 k"), (5e6, "5 M"), (2.2e11, "220 G")]
)
def test_amounts_have_three_digits_and_a_prefix(value, text):
    assert amount(value) == text


@pytest.mark.parametrize(
    "seconds, text", [(2e-4, "0.2 ms"), (0.9994, "999 ms"), (0.9999, "1.00 s"), (75.0, "75.0 s")]
)
def test_durations_change_to_milliseconds_below_one_second(seconds, text):
    assert duration(seconds) == text


# --- end to end ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(quick_compilation, tmp_path_factory):
    folder = tmp_path_factory.mktemp("benchmark")
    sizes = default_sizes()
    sizes.update_from_flattened_dict(SIZES)
    config = toy_config(train__num_steps=16, march__num_slots=8)
    benchmark(config, sizes, folder, num_views=3, growth=True, profile=True, command="command")
    return folder


def positive(*numbers) -> bool:
    flat = np.concatenate([np.ravel(number) for number in numbers])
    return bool(np.all(np.isfinite(flat)) and np.all(flat > 0))


@pytest.mark.slow
def test_every_number_is_there_and_positive(measured):
    result = json.loads((measured / "benchmark.json").read_text())
    rates = ("train", "render", "curvature")
    keys = [f"{name}_rays_per_s" for name in rates] + ["train_samples_per_s", "candidates_per_s"]
    assert positive(*(result[key] for key in (*keys, "batch_select_ms", "peak_memory_mb")))
    assert isinstance(result["device"], str) and result["device"]
    assert result["stages"].keys() == STAGES.keys()
    for stage in result["stages"].values():
        unit = stage["unit"]
        left_out = ("unit", "peak_device_memory_so_far_mb")
        assert positive(*(v for k, v in stage.items() if k not in left_out))
        assert len(stage["run_s"]) == 2
        np.testing.assert_allclose(
            stage["flops_per_s"] * stage["median_run_s"], stage["flops_per_run"], rtol=1e-9
        )
        assert stage[f"{unit}_per_run"] <= stage[f"{unit}_per_s"] * max(stage["run_s"]) * (1 + 1e-9)
    assert positive(*result["ceilings"].values())


@pytest.mark.slow
def test_memory_never_shrinks_and_more_samples_are_more_work(measured):
    result = json.loads((measured / "benchmark.json").read_text())
    memory = [stage["peak_memory_so_far_mb"] for stage in result["stages"].values()]
    memory.append(result["peak_memory_mb"])
    for row in result["growth"].values():
        memory += row["peak_memory_so_far_mb"]
    assert np.all(np.diff(memory) >= 0)
    # A ray that is trained on is rendered, differentiated and one of many of its step.
    per_ray = {
        name: result["stages"][name]["flops_per_run"] / result["stages"][name]["rays_per_run"]
        for name in ("train", "render", "curvature")
    }
    assert per_ray["render"] < per_ray["train"] and per_ray["render"] < per_ray["curvature"]


@pytest.mark.slow
def test_growth_has_a_fit_for_each_series(measured):
    growth = json.loads((measured / "benchmark.json").read_text())["growth"]
    assert growth.keys() == {
        *("train_rays", "render_rays", "curvature_rays", "curvature_grid"),
        *("score_candidates", "select_candidates", "select_batch"),
    }
    assert growth["curvature_grid"]["sizes"] == [16]  # 2^4 cells per side
    for row in growth.values():
        assert np.all(np.diff(row["sizes"]) > 0) and len(row["sizes"]) == len(row["median_s"])
        assert positive(row["median_s"])
        if len(row["sizes"]) == 1:
            assert row["fit"] is None
        else:
            assert np.isfinite(list(row["fit"].values())).all()


@pytest.mark.slow
def test_page_tables_and_trace_are_written(measured):
    page = (measured / "benchmark.html").read_text()
    assert page.count("<svg") == 1 + 7 and "scoring candidates" in page
    tables = collected_text(benchmark_tables(measured / BENCHMARK))
    assert tables.startswith("`command` (") and tables.count("\n| --- |") == 2
    assert "one size only" in tables
    assert list((measured / "trace").rglob("*.xplane.pb"))
