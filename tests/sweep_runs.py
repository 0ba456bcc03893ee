"""Helpers for tests that start the sweep script and interfere with its processes."""

import json
import pathlib
import signal
import subprocess
import sys
import time
from collections import Counter

ROOT = pathlib.Path(__file__).parents[1]


def start_sweep(flags):
    """The script, as a process of its own that ctrl-C reaches."""
    # A shell lets its background jobs ignore it, and so would all that these start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return _started(flags)
    finally:
        signal.signal(signal.SIGINT, before)


def _started(flags):
    return subprocess.Popen(
        [sys.executable, "-m", "experiments.sweep", *flags],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end_of(process, seconds=540):
    """(Exit code, all it printed)."""
    out, _ = process.communicate(timeout=seconds)
    return process.returncode, out


def wait_until(condition, process, seconds=300):
    """Waits for something to become true while the sweep runs."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, f"the sweep has ended: {process.communicate()[0]}"
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.01)


def last_checkpoint(folder) -> int:
    """Number of the newest checkpoint of a part, -1 for none."""
    numbers = [int(p.name) for p in (folder / "checkpoints").glob("*") if p.name.isdigit()]
    return max(numbers, default=-1)


def processes_with(text: str) -> list[int]:
    """Ids of the running processes whose command has this text in it."""
    found = []
    for path in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = path.read_bytes().decode(errors="replace").replace("\0", " ")
        except OSError:  # it ended in between
            continue
        if text in command:
            found.append(int(path.parent.name))
    return found


def attempts(folder) -> int:
    """How often a part was started."""
    return (folder / "log.txt").read_text().count("$ python -m")


def rounds_measured(workdir) -> Counter:
    """How often each round of each part was measured."""
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    events = [event for event in map(json.loads, lines) if event["event"] == "round"]
    return Counter((e["policy"], e["seed"], e["round"]) for e in events)


def result(workdir, policy, seed) -> dict:
    return json.loads((workdir / policy / f"seed_{seed}" / "result.json").read_text())
