"""Jobs as real processes: order, retries after a kill, failures, and what a kill leaves behind."""

import os
import pathlib
import re
import signal
import subprocess
import sys
import time

import pytest

from experiments.jobs import Job, LocalEngine, make_slots, open_process, run_jobs

ROOT = pathlib.Path(__file__).parents[1]

# Writes where it runs and when, and then a file that says that it has finished.
WORK = """
import json, os, sys, time
start = time.monotonic()
{body}
cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
line = json.dumps({{"name": {name!r}, "start": start, "end": time.monotonic(), "cores": cores}})
print(line)
open({done!r}, "w").write(line)
"""


def make_job(folder, name, body="", needs=None):
    done = folder / f"{name}.done"
    code = WORK.format(body=body, name=name, done=str(done))
    return Job(name, ("-c", code), folder / f"{name}.log", done.exists, needs)


def slots(num):
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
    return make_slots([*cores, *cores][:num], 100.0, [], jobs=num)


def run(jobs, num_slots=1, retries=2):
    events = run_jobs(jobs, LocalEngine(slots(num_slots)), retries=retries, wait_seconds=0.2)
    return [event for event in events if event.kind != "tick"]


def kinds(events, name):
    return [event.kind for event in events if event.job.name == name]


def test_a_job_waits_for_what_it_needs_and_nothing_runs_twice(tmp_path):
    first, second = make_job(tmp_path, "first"), make_job(tmp_path, "second", needs="first")
    events = run([second, first], num_slots=2)
    assert [(e.kind, e.job.name) for e in events] == [
        ("started", "first"),
        ("finished", "first"),
        ("started", "second"),
        ("finished", "second"),
    ]
    again = run([second, first])
    assert {e.kind for e in again} == {"finished"}  # and not started
    assert first.log.read_text().count("$ python") == 1


def test_a_killed_job_is_started_again_a_bounded_number_of_times(tmp_path):
    kill_once = f"""
if not os.path.exists({str(tmp_path / "killed")!r}):
    open({str(tmp_path / "killed")!r}, "w").close()
    os.kill(os.getpid(), 9)
"""
    jobs = [
        make_job(tmp_path, "unlucky", kill_once),
        make_job(tmp_path, "hopeless", "os.kill(os.getpid(), 9)"),
        make_job(tmp_path, "after", needs="hopeless"),
        make_job(tmp_path, "other"),
    ]
    events = run(jobs, retries=1)
    assert kinds(events, "unlucky") == ["started", "retried", "started", "finished"]
    assert kinds(events, "hopeless") == ["started", "retried", "started", "failed"]
    assert kinds(events, "after") == ["failed"]
    assert kinds(events, "other") == ["started", "finished"]
    reasons = {e.job.name: e.reason for e in events if e.kind == "failed"}
    assert "SIGKILL" in reasons["hopeless"] and "2 times" in reasons["hopeless"]
    assert "hopeless" in reasons["after"]


def test_a_job_that_ends_with_an_error_fails_at_once_with_its_last_words(tmp_path):
    events = run(
        [
            make_job(tmp_path, "wrong", "sys.exit('error: no such folder')"),
            make_job(tmp_path, "silent", "os._exit(0)"),
            make_job(tmp_path, "right"),
        ]
    )
    assert kinds(events, "wrong") == ["started", "failed"]
    assert kinds(events, "silent") == ["started", "failed"]  # it has left no result
    assert kinds(events, "right") == ["started", "finished"]
    assert next(e.reason for e in events if e.kind == "failed") == "error: no such folder"


def test_a_closed_iterator_leaves_no_process(tmp_path):
    job = make_job(tmp_path, "long", "print('pid', os.getpid(), flush=True); time.sleep(100)")
    events = run_jobs([job], LocalEngine(slots(1)), retries=0, wait_seconds=0.2)
    assert next(events).kind == "started"
    pid = printed_pid(job.log)
    events.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_process_ends_with_the_program_that_started_it(tmp_path):
    """The starter is killed with SIGKILL, so that it can do nothing about it."""
    child = "from experiments.active_selection import end_with_parent as e; e(); "
    child += "import os, time; print('pid', os.getpid(), flush=True); time.sleep(100)"
    starter = (
        "import pathlib, sys, time; from experiments.jobs import open_process; "
        f"p = open_process(['-c', {child!r}], pathlib.Path(sys.argv[1])); time.sleep(100)"
    )
    log = tmp_path / "log.txt"
    process = subprocess.Popen([sys.executable, "-c", starter, str(log)], cwd=ROOT)
    pid = printed_pid(log)
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 60
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not alive(pid)


def alive(pid):
    """Whether a process runs; one that has ended but was not waited for does not."""
    try:
        state = pathlib.Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def printed_pid(log):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        found = re.search(r"^pid (\d+)\n", log.read_text() if log.exists() else "", re.MULTILINE)
        if found:
            return int(found[1])
        time.sleep(0.02)
    raise AssertionError(f"{log} names no process")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs cores that can be pinned")
def test_a_process_runs_on_its_slot_alone(tmp_path):
    cores = sorted(os.sched_getaffinity(0))
    job = make_job(tmp_path, "pinned")
    events = run_jobs([job], LocalEngine(make_slots(cores, 100.0, [], jobs=1)), retries=0)
    assert "finished" in [e.kind for e in events]
    assert f'"cores": [{cores[0]}]' in (tmp_path / "pinned.done").read_text()
    assert sorted(os.sched_getaffinity(0)) == cores  # ours are as before


def test_slots_fit_cores_memory_and_gpus():
    cores = list(range(8))
    assert [s.cores for s in make_slots(cores, 100.0, [], cores_per_trial=3)] == [
        (0, 1, 2),
        (3, 4, 5),
    ]
    assert len(make_slots(cores, 7.0, [], gb_per_trial=2.0)) == 3
    assert len(make_slots(cores, 0.5, [], gb_per_trial=2.0)) == 1  # it may still work
    assert len(make_slots(cores, 100.0, [], jobs=2)) == 2
    assert len(make_slots(cores, 100.0, [], jobs=20)) == 8
    two = make_slots(cores, 100.0, ["0", "1"])
    assert [s.env["CUDA_VISIBLE_DEVICES"] for s in two] == ["0", "1"]
    assert [len(s.cores) for s in two] == [4, 4]
    shared = make_slots(cores, 100.0, ["0", "1"], jobs=4)
    assert [s.env["CUDA_VISIBLE_DEVICES"] for s in shared] == ["0", "1", "0", "1"]
    assert {s.env["XLA_PYTHON_CLIENT_MEM_FRACTION"] for s in shared} == {"0.450"}


def test_log_holds_the_command_and_all_that_was_printed(tmp_path):
    log = tmp_path / "deep" / "log.txt"
    code = "import sys; print('out', flush=True); sys.stderr.write('err')"
    assert open_process(["-c", code], log).wait() == 0
    first, *rest = log.read_text().splitlines()
    assert first.startswith("$ python -c 'import sys") and rest == ["out", "err"]
