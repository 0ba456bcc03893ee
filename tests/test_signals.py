"""Ctrl-C and SIGTERM in every script, while it imports, reads its config, and works."""

import itertools
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from experiments.jobs import death_words
from tests.scene_files import write_nerfstudio
from tests.toy_runs import toy_flags

ROOT = pathlib.Path(__file__).parents[1]
WORDS = "stopped; the same command goes on\n"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}

# What each script reads first: a pipe in its place holds it up there.
READS = {
    "active_selection": ("--config={}/c.py", "c.py"),
    "benchmark": ("--config={}/c.py", "c.py"),
    "clean_up": ("--config={}/c.py", "c.py"),
    "evaluate_uncertainty": ("--config={}/c.py", "c.py"),
    "export_field": (None, "config.json"),
    "figures": (None, "summary.json"),
    "posterior_draws": (None, "config.json"),
    "remeasure": (None, "config.json"),
    "suggest_views": ("--data={}/data", "config.json"),
    "sweep": ("--config={}/c.py", "c.py"),
    "tables": (None, "summary.json"),
    "time_to_quality": ("--config={}/c.py", "c.py"),
    "view_sets": ("--runs={}", "summary.json"),
}
QUICK = ("active_selection", "tables")


def start(module, *flags, **env):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # not ignored, as in a shell
    try:
        return subprocess.Popen(
            [sys.executable, "-m", module, *flags],
            cwd=ROOT,
            env=os.environ | env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    finally:
        signal.signal(signal.SIGINT, before)


def hold(pipe, process):
    """Waits until the process reads from a named pipe, where it then waits for an end."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        try:
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            time.sleep(0.02)
    raise TimeoutError(pipe)


def check_stopped(process, number, pipe=None, *, seconds=10):
    """Exit code, one line and nothing else on standard error, within some seconds."""
    held = hold(pipe, process) if pipe else None
    process.send_signal(number)
    _, err = process.communicate(timeout=seconds)
    if held is not None:
        os.close(held)
    assert (process.returncode, err) == (CODES[number], WORDS)


def test_every_script_is_tried():
    starts = ("run_script(main)", "run_on_trained(")
    scripts = {
        path.parent.name if path.stem == "__main__" else path.stem
        for path in (ROOT / "experiments").rglob("*.py")
        if '__name__ == "__main__"' in (text := path.read_text()) and any(s in text for s in starts)
    }
    # `check_device` reads no file, and ends at once where there is no accelerator.
    assert scripts - {"check_device"} == READS.keys()


@pytest.mark.parametrize(
    "name, number",
    [
        pytest.param(name, number, marks=[] if name in QUICK else pytest.mark.slow)
        for name, number in zip(READS, itertools.cycle(CODES))
    ],
)
def test_a_script_that_is_stopped_says_so_in_one_line(tmp_path, name, number):
    flag, file = READS[name]
    write_nerfstudio(tmp_path / "data")
    # Then the config that is there counts.
    (tmp_path / "field" / "seed_0" / "checkpoints" / "1").mkdir(parents=True)
    os.mkfifo(tmp_path / file)
    flags = [f"--workdir={tmp_path}", *([flag.format(tmp_path)] if flag else [])]
    check_stopped(start(f"experiments.{name}", *flags), number, tmp_path / file)


@pytest.mark.parametrize("number", CODES)
def test_a_script_that_still_imports_ends_like_that_too(tmp_path, number):
    (tmp_path / "absl.py").write_text(f"open({str(tmp_path / 'pipe')!r}).read()")
    os.mkfifo(tmp_path / "pipe")
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    process = start("experiments.active_selection", PYTHONPATH=path)
    check_stopped(process, number, tmp_path / "pipe")


def test_a_run_that_trains_stops_and_leaves_no_half_file(tmp_path):
    process = start("experiments.active_selection", f"--workdir={tmp_path}", *toy_flags())
    deadline = time.monotonic() + 200
    while not any((tmp_path / "initial" / "seed_0").glob("checkpoints/[0-9]*")):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.01)
    # Python handles a signal between two of its own steps, so not before XLA has compiled what it
    # is at, which takes a slow machine more than 10 seconds.
    check_stopped(process, signal.SIGTERM, seconds=120)
    assert not [*tmp_path.rglob(".*.tmp")] and not (tmp_path / "report.html").exists()


def test_a_worker_that_was_asked_to_end_has_not_failed_by_itself():
    assert death_words(143) == death_words(-15) == "killed by SIGTERM"
