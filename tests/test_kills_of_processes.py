"""The script in processes of its own, each killed at another kind of operation on its files."""

import pytest

from tests.script_server import run_script
from tests.toy_runs import TINY, same_results, toy_flags

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
    script = "experiments.active_selection"
    done = run_script(script, f"--workdir={tmp_path / 'undisturbed'}", *FLAGS)
    assert done.returncode == 0, done.stderr
    for kind, number in KILLS:
        given = str(tmp_path / "killed"), kind, str(number)
        done = run_script("tests.killed_script", *given, *FLAGS)
        assert done.returncode == 137, (kind, number, done.stderr)
    assert not (tmp_path / "killed" / "report.html").exists(), "the run ended before the last kill"
    done = run_script(script, f"--workdir={tmp_path / 'killed'}", *FLAGS)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    same_results(tmp_path / "killed", tmp_path / "undisturbed")
