"""Trials as processes of this machine, each on cores of its own."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import pathlib
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator

from experiments.sweeps.capacity import Slot
from experiments.sweeps.schedule import Ended, Job


class StepCounter:
    """Optimiser steps that each part of a working folder has behind it."""

    def __init__(self, workdir: pathlib.Path, steps_per_round: int):
        self._path, self._steps_per_round = workdir / "metrics.jsonl", steps_per_round
        self._offset = 0
        self._steps = collections.Counter()

    def read(self) -> dict[str, int]:
        """Steps by name of the part, round 0 included; reads only what is new since last time."""
        if not self._path.exists():
            return self._steps
        with open(self._path, "rb") as file:
            file.seek(self._offset)
            text = file.read()
        end = text.rfind(b"\n") + 1
        self._offset += end
        for line in text[:end].splitlines():
            try:
                event = json.loads(line)
            except ValueError:  # what was being written when a process was killed
                continue
            rounds = event["round"] + (event["event"] == "round")
            steps = rounds * self._steps_per_round + event.get("step", 0)
            part = f"{event['policy']}/seed_{event['seed']}"
            # A part that was killed goes back to its checkpoint, which is no progress.
            self._steps[part] = max(self._steps[part], steps)
        return self._steps


def open_process(argv, log: pathlib.Path, *, env=None, cwd=None) -> subprocess.Popen:
    """Starts this Python with `argv`; all it prints is added to the log.

    It has a session of its own, so that ctrl-C reaches only the program that started it, and its
    standard input is a pipe, which closes when that program is killed.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab", buffering=0) as file:
        file.write(f"$ python {shlex.join(argv)}\n".encode())
        return subprocess.Popen(
            [sys.executable, *argv],
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | (env or {}),
            cwd=cwd,
            start_new_session=True,
        )


def end_process(process: subprocess.Popen, patience: float = 5.0) -> None:
    """Asks a process to end, and makes it."""
    process.terminate()
    try:
        process.wait(patience)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


POLL_SECONDS = 0.05


class LocalEngine:
    """See `schedule.Engine`."""

    def __init__(self, slots: list[Slot]):
        self._free = list(slots)
        self._running: list[tuple[Job, Slot, subprocess.Popen]] = []

    def has_room(self) -> bool:
        return bool(self._free)

    def start(self, job: Job) -> None:
        slot = self._free.pop(0)
        with _pinned(slot.cores):
            process = open_process(job.argv, job.log, env=slot.env)
        self._running.append((job, slot, process))

    def wait(self, seconds: float) -> list[Ended]:
        deadline = time.monotonic() + seconds
        while not (ended := self._take_ended()) and time.monotonic() < deadline:
            time.sleep(POLL_SECONDS)
        return ended

    def stop(self) -> None:
        for _, _, process in self._running:
            process.terminate()
        for _, _, process in self._running:
            end_process(process)

    def _take_ended(self) -> list[Ended]:
        codes = [(job, slot, process.poll()) for job, slot, process in self._running]
        self._running = [entry for entry in self._running if entry[2].returncode is None]
        self._free += [slot for _, slot, code in codes if code is not None]
        return [Ended(job, code) for job, _, code in codes if code is not None]


@contextlib.contextmanager
def _pinned(cores: tuple[int, ...]) -> Iterator[None]:
    """What is started in here runs on these cores only, from its first instruction on."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
