"""Runs jobs as processes on this machine, each on cores of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Iterator

from experiments.sweeps.capacity import Slot
from experiments.sweeps.process import end_process, open_process
from experiments.sweeps.schedule import Ended, Job

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
