"""A run that is killed at every operation on its files ends as one that nothing has disturbed."""

import collections
import gc
import json
import logging
import re
import sys
import threading

import pytest

from experiments import runner
from tests.file_operations import watched
from tests.toy_runs import TINY, same_results, toy_config


class Killed(BaseException):
    """Not an Exception: nothing may catch it, as nothing outlives a kill."""


@pytest.fixture
def run_all(monkeypatch, cache):
    """`run_all(folder)`: the script's work; scene and compiled programs are made once."""
    config = toy_config(policies=("bavs",), **TINY)
    scene = runner.load_config_scene(config, cache_dir=str(cache / "scenes"))
    problem = runner.Problem(config, scene)
    monkeypatch.setattr(runner, "load_config_scene", lambda *args, **options: scene)
    monkeypatch.setattr(runner, "Problem", lambda *args: problem)
    return lambda folder: runner.run_all(config, folder, "command", None)


@pytest.fixture
def silent_threads(monkeypatch):
    """What a kill would have ended in silence: threads that complain of it later on."""
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: None)
    for name in ("absl", "asyncio"):
        monkeypatch.setattr(logging.getLogger(name), "disabled", True)
    yield
    gc.collect()


def start(run_all, folder, known: set) -> tuple | None:
    """Starts the run and kills it at the first operation not in `known`; None at its end.

    From that moment on no operation happens, in whatever thread: files stay as a kill leaves them.
    """
    counts, killed_at = collections.Counter(), []

    def on_operation(name, path):
        if killed_at:
            raise Killed
        # Of a file that is written in several goes, each.
        operation = (name, re.sub(r"\.\d+\.tmp$", "", path.removeprefix(str(folder))))
        counts[operation] += 1
        if (*operation, counts[operation]) not in known:
            killed_at.append((*operation, counts[operation]))
            raise Killed

    try:
        with watched(folder, on_operation):
            run_all(folder)
    except BaseException:
        if not killed_at:
            raise
    return killed_at[0] if killed_at else None


@pytest.mark.slow
@pytest.mark.usefixtures("silent_threads")
def test_killed_at_every_operation_a_run_ends_like_the_undisturbed_one(run_all, tmp_path):
    run_all(tmp_path / "undisturbed")
    known: set = set()
    folder = tmp_path / "killed"
    while (operation := start(run_all, folder, known)) is not None:
        known.add(operation)
        assert len(known) < 1000
        # Threads that a kill would have ended may still write, but not to where it goes on.
        if folder.exists():
            folder = folder.rename(tmp_path / f"killed_{len(known)}")
    kinds = collections.Counter(name for name, *_ in known)
    print(f"killed {len(known)} times: {dict(kinds)}")
    assert kinds.keys() >= {"os.rename", "fsync", "write", "open", "os.mkdir", "os.remove"}
    assert len(known) > 200
    same_results(folder, tmp_path / "undisturbed")
    # Half a line, written when it was killed, spoils no other.
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    assert {"initial", "bavs"} == {json.loads(x)["policy"] for x in lines if x.endswith("}")}
