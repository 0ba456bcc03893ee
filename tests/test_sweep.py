"""The sweep script as a user runs it: stopped, killed, failing, and started again."""

import itertools
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from experiments.configs import quickstart
from experiments.files import exclusive, write_arrays, write_json
from experiments.runtime import ConfigError, WorkdirError
from experiments.sweep_plan import (
    Record,
    make_settings,
    make_trials,
    merged,
    parse_axes,
    read_record,
    setting_name,
    write_record,
)
from tests.script_server import run_script
from tests.sweep_runs import (
    attempts,
    end_of,
    last_checkpoint,
    processes_with,
    result,
    rounds_measured,
    start_sweep,
    wait_until,
)
from tests.toy_runs import toy_flags

FLAGS = toy_flags(num_rounds=1, policies="('random','farthest')")


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory):
    """A sweep that was stopped with ctrl-C, started again, and lost a worker on the way."""
    work = tmp_path_factory.mktemp("sweep")
    flags = [*FLAGS, "--jobs=2", f"--workdir={work}"]
    process = start_sweep(flags)
    wait_until(lambda: last_checkpoint(work / "initial" / "seed_0") >= 2, process)
    process.send_signal(signal.SIGINT)
    stopped = end_of(process)
    left = processes_with(str(work))

    process = start_sweep(flags)
    wait_until(lambda: last_checkpoint(work / "random" / "seed_0") >= 10, process)
    for pid in processes_with(f"--workdir={work} --part=random/seed_0"):
        os.kill(pid, signal.SIGKILL)
    return work, stopped, left, end_of(process)


@pytest.mark.slow
def test_ctrl_c_stops_every_process_and_says_so(disturbed):
    _, (code, out), left, _ = disturbed
    assert code == 130 and "the same command goes on" in out and "Traceback" not in out
    assert left == []


@pytest.mark.slow
def test_nothing_is_lost_or_run_twice(disturbed):
    work, _, _, (code, out) = disturbed
    assert code == 0, out
    assert "random/seed_0: retried: killed by SIGKILL" in out
    tries = [attempts(work / f"{name}/seed_0") for name in ("initial", "random", "farthest")]
    assert tries == [2, 2, 1]  # stopped, killed, undisturbed
    wanted = [("initial", 0, 0), ("random", 0, 1), ("farthest", 0, 1)]
    assert rounds_measured(work) == dict.fromkeys(wanted, 1)
    runs = json.loads((work / "summary.json").read_text())["runs"]
    assert [run["policy"] for run in runs] == ["farthest", "random"]
    assert all(run["completed"] for run in runs)
    assert (work / "report.html").exists() and (work / "next_views" / "transforms.json").exists()


@pytest.mark.slow
def test_a_finished_sweep_runs_nothing_again(disturbed):
    work, *_ = disturbed
    before = (work / "random" / "seed_0" / "result.json").stat().st_mtime_ns
    code, out = end_of(start_sweep([*FLAGS, f"--workdir={work}"]))
    assert code == 0 and "trials: 2, finished before: 2" in out
    assert (work / "random" / "seed_0" / "result.json").stat().st_mtime_ns == before
    assert attempts(work / "farthest" / "seed_0") == 1


@pytest.fixture(scope="module")
def half_failed(tmp_path_factory):
    """A sweep over a setting that cannot be run and one that can, which nothing disturbs."""
    work = tmp_path_factory.mktemp("half")
    flags = [*FLAGS, "--axis=policy=random", "--axis=config.num_initial=1000,2", "--jobs=1"]
    return work, end_of(start_sweep([*flags, f"--workdir={work}"]))


@pytest.mark.slow
def test_a_setting_that_fails_does_not_stop_the_others(half_failed):
    work, (code, out) = half_failed
    assert code == 1 and "Traceback" not in out
    log = work / "num_initial=1000" / "initial" / "seed_0" / "log.txt"
    assert "num_initial is 1000, but the pool has 100" in out and str(log) in out
    assert result(work / "num_initial=2", "random", 0)["completed"]
    record = read_record(work)
    why = record.missing("num_initial=1000", set())
    assert why.keys() == {("random", 0)} and "has failed" in why["random", 0]
    assert record.missing("num_initial=2", {("random", 0)}) == {}


@pytest.mark.slow
def test_a_run_that_was_stopped_and_killed_ends_like_an_undisturbed_one(disturbed, half_failed):
    killed = result(disturbed[0], "random", 0)["rounds"]
    undisturbed = result(half_failed[0] / "num_initial=2", "random", 0)["rounds"]
    for a, b in zip(killed, undisturbed, strict=True):
        assert a["selected"] == b["selected"]
        # Threads of the CPU may add up in another order.
        np.testing.assert_allclose(a["psnr"], b["psnr"], atol=1e-3)


def test_a_second_sweep_in_the_same_folder_is_refused(tmp_path):
    flags = [*FLAGS, f"--workdir={tmp_path}"]
    with exclusive(tmp_path):
        done = run_script("experiments.sweep", *flags)
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {tmp_path}: another process works here; ")
    assert (done.stdout + done.stderr).count("\n") == 1
    assert [*tmp_path.iterdir()] == [tmp_path / ".lock"]


def test_a_sweep_that_is_killed_leaves_no_lock(tmp_path):
    code = "import sys, time; from experiments.files import exclusive; "
    code += "lock = exclusive(sys.argv[1]); lock.__enter__(); print('locked', flush=True); "
    code += "time.sleep(100)"
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "locked\n"
    with pytest.raises(WorkdirError, match="another process"), exclusive(tmp_path, wait=False):
        pass
    process.kill()
    process.wait()
    with exclusive(tmp_path, wait=False):
        pass


# --- axes, plan and record, without running anything ---


def test_axes_are_read_by_the_type_of_their_option():
    config = quickstart.get_config()
    texts = [
        "policy=random,farthest",
        "seed=0:3,7",
        "config.uncertainty.log2_cells=5:8",
        "config.candidates.image_scale=0.25,1",
        "config.proposal.finest=(64,128),(32,64)",
        "config.uncertainty.weighting=gauss_newton,residual_weighted",
        "config.from_scratch=True,False",
    ]
    axes = parse_axes(texts, config)
    assert axes.policies == ("random", "farthest") and axes.seeds == (0, 1, 2, 7)
    expected = {
        "uncertainty.log2_cells": (5, 6, 7),
        "candidates.image_scale": (0.25, 1.0),
        "proposal.finest": ((64, 128), (32, 64)),
        "uncertainty.weighting": ("gauss_newton", "residual_weighted"),
        "from_scratch": (True, False),
    }
    combinations = itertools.product(*expected.values())
    assert axes.settings == [dict(zip(expected, values)) for values in combinations]
    assert parse_axes([], config).policies == config.policies


def test_options_may_change_together():
    texts = ["config.num_rounds+config.batch_size=4+4,1+16", "config.image_size=50,100"]
    assert parse_axes(texts, quickstart.get_config()).settings == [
        {"num_rounds": rounds, "batch_size": batch, "image_size": size}
        for rounds, batch in ((4, 4), (1, 16))
        for size in (50, 100)
    ]
    with pytest.raises(ConfigError, match="given twice"):
        parse_axes([texts[0], "config.batch_size=2"], quickstart.get_config())


def test_options_may_change_one_at_a_time(tmp_path):
    config = quickstart.get_config()
    changes = ["config.uncertainty.log2_cells=5,7", "config.num_rounds+config.batch_size=1+8"]
    axes = parse_axes(["config.image_size=50,100"], config, changes)
    ablated = ({}, {"uncertainty.log2_cells": 5}, {"uncertainty.log2_cells": 7})
    ablated = (*ablated, {"num_rounds": 1, "batch_size": 8})
    assert axes.settings == [{"image_size": size} | one for size in (50, 100) for one in ablated]
    made = make_settings(config, parse_axes([], config, changes[:1]), tmp_path)
    names = ["unchanged", "uncertainty.log2_cells=5", "uncertainty.log2_cells=7"]
    assert [setting.name for setting in made] == names
    assert made[0].config == config and made[1].config.uncertainty.log2_cells == 5


@pytest.mark.parametrize(
    "text, message",
    [
        ("seed=0:3", "seed is an axis"),
        ("policy=random", "policy is an axis"),
        ("config.nothing=1", "no axis config.nothing"),
        ("config.image_size=50", "given twice"),
    ],
)
def test_a_wrong_change_is_one_line_that_names_it(text, message):
    with pytest.raises(ConfigError, match=message) as error:
        parse_axes(["config.image_size=50,100"], quickstart.get_config(), [text])
    assert str(error.value).startswith(f"--change={text}: ") and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text, message",
    [
        ("config.num_rounds+config.batch_size=4", "is not 2 values"),
        ("policy+seed=random+1", "no axis policy"),
        ("seed", "give name=value"),
        ("seed=", "give name=value"),
        ("seed=a", "not of type int"),
        ("seed=1,1", "twice"),
        ("seed=3:3", "no value"),
        ("polcy=random", "no axis polcy"),
        ("config.nothing=1", "no axis config.nothing"),
        ("config.uncertainty=1", "group of options"),
        ("config.policies=random", "sweep over policy"),
        ("config.from_scratch=1", "not of type bool"),
    ],
)
def test_a_wrong_axis_is_one_line_that_names_it(text, message):
    with pytest.raises(ConfigError, match=message) as error:
        parse_axes([text], quickstart.get_config())
    assert "\n" not in str(error.value) and "--axis=" in str(error.value)


def test_settings_have_folders_of_their_own_that_any_shell_can_name():
    assert setting_name({}) == "."
    assert setting_name({"a.b": 5, "c": "x/y z"}) == "a.b=5,c=x_y_z"
    assert setting_name({"finest": (64, 128)}) == "finest=_64,_128_"


def test_a_trial_is_a_single_run_of_one_part_and_shares_round_0(tmp_path):
    config = quickstart.get_config()
    axes = parse_axes(["policy=random,bavs", "seed=4", "config.batch_size=2,4"], config)
    first, second = make_settings(config, axes, tmp_path)
    assert (first.config.batch_size, second.config.batch_size, config.batch_size) == (2, 4, 4)
    assert first.folder == tmp_path / "batch_size=2"
    trials = make_trials(first, ["--config=c.py"], ["--compilation_cache_dir=c"])
    assert [t.part.name for t in trials] == ["initial/seed_4", "random/seed_4", "bavs/seed_4"]
    assert [t.needs for t in trials] == [None, *[f"{first.folder}/initial/seed_4"] * 2]
    argv = trials[1].argv
    assert argv[:3] == ("-m", "experiments.active_selection", "--config=c.py")
    assert "--config.policies=('random', 'bavs')" in argv and "--config.batch_size=2" in argv
    assert "--part=random/seed_4" in argv and "--compilation_cache_dir=c" in argv
    done = first.folder / "random" / "seed_4"
    write_json(done / "result.json", {"completed": True})
    assert [t.part.name for t in make_trials(first, [])] == [t.part.name for t in trials]
    write_json(done / "next_views" / "transforms.json", {})
    write_arrays(done / "acquisition.npz")
    assert [t.part.name for t in make_trials(first, [])] == ["initial/seed_4", "bavs/seed_4"]


def test_a_sweep_taken_up_with_more_axes_keeps_what_it_had(tmp_path):
    row = {"folder": "a=1", "values": {"a": 1}, "policies": ["random"], "seeds": [0, 1]}
    write_record(tmp_path, Record("first", [row], {"a=1/random/seed_1": "failed: why"}))
    more = {"folder": "a=2", "values": {"a": 2}, "policies": ["bavs"], "seeds": [2]}
    again = row | {"policies": ["bavs"], "seeds": [2]}
    record = merged(read_record(tmp_path), Record("second", [more, again], {}))
    assert [s["folder"] for s in record.settings] == ["a=2", "a=1"]
    assert record.settings[1]["policies"] == ["bavs", "random"]
    assert record.settings[1]["seeds"] == [2, 0, 1]
    assert record.missing("a=1", {("random", 0)})["random", 1] == "failed: why"
    assert record.missing("a=1", set())["bavs", 0] == "not run yet"
