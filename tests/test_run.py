"""The script as a user runs it: results, resumption after a real kill, errors, exported poses."""

import json
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from bavs_jax.selection.policies import POLICIES
from experiments.posthoc import remeasure
from experiments.reporting.result_tables import collect_tables
from experiments.runtime import ConfigError, WorkdirError
from tests.script_server import ROOT, run_script
from tests.toy_runs import toy_flags


def script(*flags):
    """Runs the script to its end."""
    return run_script("experiments.active_selection", *flags)


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A run of two policies to its end."""
    folder = tmp_path_factory.mktemp("finished")
    flags = toy_flags(policies="('bavs','random')")
    done = script(f"--workdir={folder}", *flags)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.fixture
def unmeasured(finished, tmp_path, monkeypatch):
    """A copy of it, and a stand-in for LPIPS, whose package need not be there."""
    monkeypatch.setattr(
        "experiments.build.make_lpips_fn", lambda net: (lambda a, b: abs(a - b).mean(), None)
    )
    monkeypatch.setattr("experiments.runtime.cache_folder", lambda: tmp_path / "cache")
    return shutil.copytree(finished[0], tmp_path / "copy")


def load(folder, policy="bavs"):
    return json.loads((folder / policy / "seed_0" / "result.json").read_text())


def test_results_have_the_agreed_form(finished):
    folder, out = finished
    summary = json.loads((folder / "summary.json").read_text())
    assert [run["policy"] for run in summary["runs"]] == ["bavs", "random"]
    for run in summary["runs"]:
        keys = {"schema_version", "scene", "policy", "seed", "config", "versions", "device"}
        assert keys <= run.keys() and run["completed"]
        assert run["baselines"].keys() == {"mean_colour_psnr", "nearest_image_psnr"}
        assert all(5 < psnr < 40 for psnr in run["baselines"].values())
        assert [r["num_views"] for r in run["rounds"]] == [2, 4, 6]
        for row in run["rounds"]:
            assert np.isfinite([row["psnr"], row["ssim"], row["depth_mae"]]).all()
            assert row["lpips"] is None and len(row["selected"]) == 2
            assert row["seconds"].keys() == {
                "train",
                "curvature",
                "fit",
                "score",
                "select",
                "evaluate",
            }
        assert [r["num_test_views"] for r in run["rounds"]] == [2, 2, 3]
    bavs, random = summary["runs"]
    assert bavs["rounds"][0] == random["rounds"][0]  # round 0 is shared
    assert bavs["rounds"][1]["num_survivors"] >= 2 and random["rounds"][1]["num_survivors"] is None
    assert "lpips_net is empty" in bavs["lpips_reason"]
    assert (folder / "report.html").stat().st_size > 10_000 and "report:" in out
    events = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert {e["event"] for e in events} == {"train", "choice", "round"}


def test_next_views_are_the_chosen_poses_in_nerfstudio_format(finished):
    folder, _ = finished
    exported = json.loads((folder / "next_views" / "transforms.json").read_text())
    selected = [v for row in load(folder)["rounds"][1:] for v in row["selected"]]
    assert len(exported["frames"]) == len(selected) == 4
    assert [f["round"] for f in exported["frames"]] == [1, 1, 2, 2]
    for frame in exported["frames"]:
        pose = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
        assert frame["fl_x"] > 0 and frame["w"] == 16


def test_starting_a_finished_run_again_changes_nothing(finished):
    folder, _ = finished
    before = (folder / "bavs" / "seed_0" / "result.json").read_bytes()
    done = script(f"--workdir={folder}", *toy_flags(policies="('bavs','random')"))
    assert done.returncode == 0, done.stderr
    assert (folder / "bavs" / "seed_0" / "result.json").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("kill_at", [9, 13, 17])
def test_killed_run_goes_on_and_ends_like_the_undisturbed_one(finished, tmp_path, kill_at):
    """SIGKILL after a number of log lines, in different rounds; then the same command again."""
    flags = [f"--workdir={tmp_path}", *toy_flags(policies="('bavs',)")]
    process = subprocess.Popen(
        [sys.executable, "-m", "experiments.active_selection", *flags],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    checkpoints, deadline = tmp_path / "bavs" / "seed_0" / "checkpoints", time.monotonic() + 200
    while time.monotonic() < deadline and process.poll() is None:
        numbers = [int(p.name) for p in checkpoints.glob("*") if p.name.isdigit()]
        if numbers and max(numbers) >= kill_at:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "report.html").exists(), "the run had ended before it was killed"
    done = script(*flags)
    assert done.returncode == 0, done.stderr
    got, want = load(tmp_path)["rounds"], load(finished[0])["rounds"]
    for a, b in zip(got, want, strict=True):
        assert a["selected"] == b["selected"]
        np.testing.assert_allclose(a["psnr"], b["psnr"], atol=1e-3)


def test_list_policies_prints_one_a_line():
    done = script("--list_policies")
    lines = done.stdout.splitlines()
    assert [line.split(maxsplit=1) for line in lines] == [
        [n, p.summary] for n, p in POLICIES.items()
    ]


@pytest.mark.parametrize(
    "flags, message",
    [
        pytest.param(["--config.policies=('bavz',)"], "bavz", marks=pytest.mark.slow),
        (["--config.loader=blender"], "BAVS_DATA"),
        (["--config.loader=blender", "--config.data_dir=/nowhere"], "/nowhere"),
        pytest.param(
            ["--config.num_initial=1000"],
            "num_initial is 1000, but the pool has 100",
            marks=pytest.mark.slow,
        ),
        (["--config.no_such_option=1"], "no_such_option"),
    ],
)
def test_wrong_options_end_in_one_line(tmp_path, flags, message, monkeypatch):
    monkeypatch.delenv("BAVS_DATA", raising=False)
    env_flags = [f"--workdir={tmp_path}", *toy_flags(), *flags]
    done = script(*env_flags)
    assert done.returncode != 0
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_another_config_in_the_same_folder_is_refused(finished):
    done = script(
        f"--workdir={finished[0]}",
        *toy_flags(policies="('bavs',)", train__num_steps=28),
    )
    assert done.returncode != 0 and "train.num_steps" in done.stderr
    assert "Traceback" not in done.stderr


# --- LPIPS afterwards ---


def test_lpips_is_added_to_finished_runs(unmeasured, capsys):
    before = {policy: load(unmeasured, policy) for policy in ("bavs", "random")}
    remeasure(unmeasured, "later", policies=["random"])
    assert load(unmeasured) == before["bavs"]
    after = load(unmeasured, "random")
    *earlier, last = after["rounds"]
    assert earlier == before["random"]["rounds"][:-1]
    assert 0 < last["lpips"] < 1 and last | {"lpips": None} == before["random"]["rounds"][-1]
    assert (after["lpips_reason"], after["remeasured_by"]) == (None, "later")
    summary = json.loads((unmeasured / "summary.json").read_text())
    assert summary["runs"] == [before["bavs"], after]
    assert collect_tables(unmeasured).made.count("`, then `later`") == 1
    remeasure(unmeasured, "once more", policies=["random"])
    assert load(unmeasured, "random") == after
    assert "nothing is left to measure" in capsys.readouterr().out


def test_remeasuring_notices_another_scene_and_a_missing_run(unmeasured):
    path = unmeasured / "random" / "seed_0" / "result.json"
    result = load(unmeasured, "random")
    result["rounds"][-1]["psnr"] += 0.5
    path.write_text(json.dumps(result))
    with pytest.raises(WorkdirError, match=r"psnr: the run had .* dB, its checkpoint has"):
        remeasure(unmeasured, "later", policies=["random"])
    assert load(unmeasured, "random") == result
    with pytest.raises(ConfigError, match=r"--policy: warp: .* holds no finished run of it"):
        remeasure(unmeasured, "later", policies=["warp"])


def test_remeasuring_without_the_package_says_what_to_install(unmeasured, monkeypatch):
    monkeypatch.setattr("experiments.build.make_lpips_fn", lambda net: (None, "install it"))
    with pytest.raises(ConfigError, match="--lpips_net: install it"):
        remeasure(unmeasured, "later")
