"""The benchmark: what is timed, and a tiny run from end to end."""

import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from bavs_jax.selection.batch import SelectionInfo
from experiments.build import load_config_scene
from experiments.reporting.benchmark import BENCHMARK, STAGES, amount, benchmark_tables, duration
from experiments.reporting.tables import collected_text
from experiments.stages import Subject, timed, timed_runs
from tests.toy_runs import toy_config, toy_flags

ROOT = pathlib.Path(__file__).parents[1]

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
}


def test_files_of_older_benchmarks_keep_their_counts():
    for name, dashed in (("benchmark", False), ("benchmark_h100", True)):
        path = ROOT / "experiments" / "results" / name / BENCHMARK
        table = benchmark_tables(path).tables["stages"]
        assert table.head[4:] == (
            *("operations a second", "of the matrix product", "bytes a second", "of the copy"),
        )
        text = collected_text(benchmark_tables(path))
        assert ("operations were not counted on this device" in text) == dashed


def test_timing_waits_for_the_result():
    """With work that takes no time until its result is waited for."""
    waited = []

    class Pending:
        def block_until_ready(self):
            waited.append(self)
            return self

    results = {"a": Pending(), "b": [Pending()]}
    seconds, value = timed(lambda: results)
    assert value is results and len(waited) == 2 and seconds >= 0.0
    first, seconds, values = timed_runs(lambda: results, 3)
    assert first >= 0.0 and len(seconds) == 3
    assert values == [results] * 3 and len(waited) == 10


def test_selection_is_timed_by_the_path_of_runs():
    config = toy_config()
    subject = Subject(config, load_config_scene(config, cache_dir=None), 3)
    selected, info = subject.selection(32, 4)()
    again, _ = subject.selection(32, 4)()
    np.testing.assert_array_equal(selected, again)
    assert isinstance(info, SelectionInfo) and 4 <= info.survivors.sum() < 32


@pytest.mark.parametrize(
    "value, text", [(12.0, "12 B"), (1234.0, "1.23 kB"), (5e6, "5 MB"), (2.2e11, "220 GB")]
)
def test_amounts_have_three_digits_and_a_prefix(value, text):
    assert amount(value, "B") == text


@pytest.mark.parametrize(
    "seconds, text", [(2e-4, "0.2 ms"), (0.9994, "999 ms"), (0.9999, "1.00 s"), (75.0, "75.0 s")]
)
def test_durations_change_to_milliseconds_below_one_second(seconds, text):
    assert duration(seconds) == text


# --- end to end ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The script's folder, of a tiny benchmark."""
    folder = tmp_path_factory.mktemp("benchmark")
    command = [sys.executable, "-m", "experiments.benchmark", f"--workdir={folder}"]
    command += toy_flags(train__num_steps=16, march__num_slots=8)
    command += [f"--sizes.{name}={value}" for name, value in SIZES.items()]
    done = subprocess.run(
        [*command, "--num_views=3", "--profile"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
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
        assert stage[f"{unit}_per_run"] <= stage[f"{unit}_per_s"] * max(stage["run_s"]) * (1 + 1e-9)
    assert positive(*result["ceilings"].values())


@pytest.mark.slow
def test_memory_never_shrinks(measured):
    result = json.loads((measured / "benchmark.json").read_text())
    memory = [stage["peak_memory_so_far_mb"] for stage in result["stages"].values()]
    memory.append(result["peak_memory_mb"])
    assert np.all(np.diff(memory) >= 0)


@pytest.mark.slow
def test_page_tables_and_trace_are_written(measured):
    page = (measured / "benchmark.html").read_text()
    assert "scoring\u00a0candidates" in page
    tables = collected_text(benchmark_tables(measured / BENCHMARK))
    assert tables.startswith("`python -m experiments.benchmark ") and tables.count("\n| --- |") == 1
    assert list((measured / "trace").rglob("*.xplane.pb"))
