"""The script in processes of its own, each killed at another kind of operation on its files."""

import pathlib
import subprocess
import sys

import pytest

from tests.toy_runs import TINY, same_results, toy_flags

ROOT = pathlib.Path(__file__).parents[1]
FLAGS = toy_flags(policies="('bavs',)", **TINY)
# One after another on the same folder; each goes on from what the last has left.
KILLS = (
    ("fsync", 1),
    ("os.mkdir", 8),
    ("os.rename", 3),
    ("write", 60),
    ("os.remove", 5),
    ("open", 20),
)


@pytest.mark.slow
def test_processes_killed_at_each_kind_of_operation_end_like_an_undisturbed_one(tmp_path):
    def script(*command):
        return subprocess.run(
            [sys.executable, "-m", *command, *FLAGS],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=300,
        )

    done = script("experiments.active_selection", f"--workdir={tmp_path / 'undisturbed'}")
    assert done.returncode == 0, done.stderr
    for kind, number in KILLS:
        done = script("tests.killed_script", str(tmp_path / "killed"), kind, str(number))
        assert done.returncode == 137, (kind, number, done.stderr)
    assert not (tmp_path / "killed" / "report.html").exists(), "the run ended before the last kill"
    done = script("experiments.active_selection", f"--workdir={tmp_path / 'killed'}")
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    same_results(tmp_path / "killed", tmp_path / "undisturbed")
