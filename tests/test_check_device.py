"""The check of an accelerator against the CPU."""

import json

import jax
import numpy as np
import pytest

from experiments import stages
from experiments.reporting.result_tables import DEVICE_FILE, collect_all, differences_table
from experiments.stages import difference, too_large
from tests.script_server import run_script


def test_difference_is_relative_and_counts_whole_numbers():
    wanted = np.array([3.0, 4.0], np.float32)
    assert difference(wanted, wanted) == 0.0
    np.testing.assert_allclose(difference(np.float32([3.0, 4.5]), wanted), 0.1, rtol=1e-6)
    assert difference(np.array([1, 2, 3, 5]), np.array([1, 2, 3, 4])) == 0.25
    assert np.isnan(difference(np.float32([np.nan, 4.0]), wanted))


def test_what_is_too_large_is_named_and_nan_always_is():
    found = {"grid": {"loss": 1e-5, "gradient": 2e-3, "views, bavs": 0.0}}
    found["mlp"] = {"loss": float("nan"), "views, bavs": 0.25}
    wrong = ["mlp: loss", "mlp: views, bavs"]
    assert too_large(found, 1e-2) == wrong
    assert too_large(found, 1e-4) == ["grid: gradient", *wrong]
    table = differences_table({"grid": {"loss": 1e-5}, "mlp": {"curvature": 2e-3}})
    assert table.head == ("field", "loss", "curvature")
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["grid", "1.0e-05", "—"],
        ["mlp", "—", "2.0e-03"],
    ]


def test_without_an_accelerator_there_is_nothing_to_compare(tmp_path):
    command = ["experiments.check_device", f"--workdir={tmp_path / 'out'}"]
    done = run_script(*command)
    assert done.returncode == 1 and not (tmp_path / "out").exists()
    assert done.stderr.startswith("error: JAX_PLATFORMS: ") and done.stderr.count("\n") == 1
    done = run_script(*command, "--fields=grids")
    assert "--fields: unknown ['grids']; known: hash_grid, " in done.stderr


@pytest.mark.slow
def test_a_device_that_computes_something_else_is_found_out(monkeypatch):
    """Numbers of one device against its own, first as they are, then with another step size."""
    (device,) = jax.devices("cpu")[:1]
    same = stages.check_field("hash_grid", device, device)
    assert set(same.values()) == {0.0} and {"gradient", "curvature", "views, bavs"} <= same.keys()
    original = stages.Problem
    calls = []

    def other_second_time(config, *args):
        calls.append(config)
        if len(calls) == 2:
            config = config.copy_and_resolve_references()
            config.uncertainty.weighting = "empirical_fisher"
        return original(config, *args)

    monkeypatch.setattr(stages, "Problem", other_second_time)
    other = stages.check_field("hash_grid", device, device)
    assert other["curvature"] > 0.1 and other["loss"] == 0.0


def test_table_of_a_file_names_device_and_precision(tmp_path):
    result = {
        "schema_version": 1,
        "command": "made",
        "device": "a card",
        "matmul_precision": "highest",
    }
    result |= {"differences": {"hash_grid": {"loss": 1e-7}}}
    (tmp_path / DEVICE_FILE).write_text(json.dumps(result))
    (found,) = collect_all(tmp_path)
    assert "a card" in found.made and "highest" in found.made
    assert found.tables["differences"].rows[0][1].text == "1.0e-07"
