"""One job on several devices and processes gives what it gives on one."""

import json
import os
import pathlib
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

from bavs_jax.devices import make_mesh, num_shards, over_rays, put_on_all
from experiments.build import check_shards
from experiments.runtime import ConfigError
from tests.toy_runs import toy_config, toy_flags

ROOT = pathlib.Path(__file__).parents[1]
JOBS = ("colour", "proposals", "variance", "flow")


def start(module, *arguments, num_devices=1):
    given = os.environ.get("XLA_FLAGS", "")
    flags = f"{given} --xla_force_host_platform_device_count={num_devices}"
    return subprocess.Popen(
        [sys.executable, "-m", module, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=ROOT,
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
    )


def finish(*processes):
    """Their output; all are ended if one fails."""
    try:
        outputs = [process.communicate(timeout=900)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, output in zip(processes, outputs):
        assert process.returncode == 0, output
    return outputs


def free_address():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{one.getsockname()[1]}"


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The toy job on 1 device, on 8, and on 4 of 2 processes."""
    folder = tmp_path_factory.mktemp("devices")
    address = free_address()
    module = "tests.device_runs"
    finish(
        start(module, folder / "1.npz"),
        start(module, folder / "8.npz", num_devices=8),
        *(
            start(module, folder / "2x2.npz", address, 2, number, num_devices=2)
            for number in range(2)
        ),
    )
    results = {}
    for name in ("1", "8", "2x2"):
        with np.load(folder / f"{name}.npz") as file:
            results[name] = dict(file)
    return results


@pytest.mark.slow
def test_the_jobs_ran_on_as_many_devices_as_they_say(found):
    assert [int(found[name]["num_devices"]) for name in ("1", "8", "2x2")] == [1, 8, 4]


@pytest.mark.slow
@pytest.mark.parametrize("devices", ["8", "2x2"])
@pytest.mark.parametrize("job", JOBS)
def test_gradients_of_one_step_are_equal(found, devices, job):
    one, many = found["1"], found[devices]
    scale = np.abs(one[f"{job}_gradient"]).max()
    assert scale > 1e-4
    gap = np.abs(one[f"{job}_gradient"] - many[f"{job}_gradient"]).max()
    assert gap <= 1e-5 * scale
    np.testing.assert_allclose(many[f"{job}_info"], one[f"{job}_info"], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("devices", ["8", "2x2"])
def test_curvature_scores_and_choice_are_equal(found, devices):
    one, many = found["1"], found[devices]
    scale = np.abs(one["curvature"]).max()
    assert scale > 0.0 and np.abs(one["curvature"] - many["curvature"]).max() <= 1e-5 * scale
    for name in ("scores", "predictive"):
        assert one[name].min() > 0.0
        np.testing.assert_allclose(many[name], one[name], rtol=1e-4)
    np.testing.assert_array_equal(many["chosen"], one["chosen"])


def test_a_single_device_needs_no_mesh():
    assert make_mesh(1) is None and num_shards(None) == 1
    assert over_rays(abs, None, sharded=(True,)) is abs
    tree = {"a": np.ones(2)}
    assert put_on_all(tree, None) is tree


def test_more_devices_than_there_are_is_an_error():
    with pytest.raises(ValueError, match=f"but there are {jax.device_count()}"):
        make_mesh(jax.device_count() + 1)


def test_rays_that_cannot_be_spread_are_named():
    class ThreeDevices:
        size = 3

    with pytest.raises(ConfigError, match=r"config\.train\.num_rays: 128 pixels .* 3 devices"):
        check_shards(toy_config(), ThreeDevices)


def run_flags(folder):
    # Room for all rays: which ones a full buffer leaves out differs from device to device.
    options = toy_flags(policies="('bavs',)", train__capacity=8192)
    return [*options, f"--workdir={folder}"]


@pytest.mark.slow
def test_whole_runs_choose_the_same_views_on_devices_and_processes(tmp_path):
    module, address = "experiments.active_selection", free_address()
    outputs = finish(
        start(module, *run_flags(tmp_path / "1")),
        start(module, *run_flags(tmp_path / "8"), "--devices=0", num_devices=8),
    )
    assert "devices: 8 x cpu" in outputs[1]
    together = ["--num_processes=2", f"--coordinator={address}"]
    outputs = finish(
        *(
            start(module, *run_flags(tmp_path / "2"), *together, f"--process_id={number}")
            for number in range(2)
        )
    )
    assert "devices: 2 x cpu, of 2 processes" in outputs[0] and "devices" not in outputs[1]
    runs = [json.loads((tmp_path / n / "summary.json").read_text())["runs"] for n in "182"]
    rounds = [run[0]["rounds"] for run in runs]
    for other in rounds[1:]:
        assert [r["selected"] for r in other] == [r["selected"] for r in rounds[0]]
        psnr = [[r["psnr"] for r in some] for some in (other, rounds[0])]
        np.testing.assert_allclose(*psnr, atol=0.02)
    lines = [(tmp_path / n / "metrics.jsonl").read_text().count("\n") for n in "182"]
    assert len(set(lines)) == 1  # of two processes one writes


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--devices=9"], "--devices: 9 devices are asked for, but there are 1"),
        (["--num_processes=2"], "--num_processes: needs --coordinator"),
        (
            ["--coordinator=127.0.0.1:1", "--num_processes=2", "--process_id=2"],
            "--process_id: 2 is not below --num_processes, 2",
        ),
    ],
)
def test_wrong_flags_end_in_one_line(tmp_path, flags, message):
    process = start("experiments.active_selection", *run_flags(tmp_path), *flags)
    output = process.communicate(timeout=100)[0]
    assert process.returncode != 0 and message in output and "Traceback" not in output
