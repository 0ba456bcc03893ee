"""In what order jobs run, what happens to one whose worker dies, and what to say of one that fails.

Nothing here knows what a job does or where it runs: an engine starts jobs and tells how they end.
"""

from __future__ import annotations

import collections
import pathlib
import signal
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

from experiments.signals import CODES

STOPPED = {code: number for number, code in CODES.items()}  # exit codes of what was asked to end


class Job(NamedTuple):
    """One process of the project's Python, to be run at most once to its end."""

    name: str
    argv: tuple[str, ...]  # after the name of the interpreter
    log: pathlib.Path  # what it prints, all attempts one after another
    is_finished: Callable[[], bool]  # from its files
    needs: str | None = None  # another job that must be finished before


class Ended(NamedTuple):
    """How an attempt ended."""

    job: Job
    code: int | None  # exit status, -n: killed by signal n; None: its machine is gone


class Engine(Protocol):
    """Where jobs run."""

    def has_room(self) -> bool:
        """Whether another job can be started now."""

    def start(self, job: Job) -> None:
        """Starts a job and returns at once."""

    def wait(self, seconds: float) -> list[Ended]:
        """Jobs that have ended, after at most so many seconds."""

    def stop(self) -> None:
        """Ends all jobs that still run."""


class Event(NamedTuple):
    """Something that happened to a job; `tick` is that time went by."""

    kind: str  # "started", "retried", "finished", "failed" or "tick"
    job: Job | None = None
    reason: str = ""  # why it is tried again or has failed


def run_jobs(
    jobs: list[Job], engine: Engine, *, retries: int, wait_seconds: float = 1.0
) -> Iterator[Event]:
    """Runs jobs to their end and says what happens; closing the iterator stops what runs.

    A job that is finished already is not started. One that dies without having said why (it is
    killed, or its machine is gone) is started again, at most `retries` times; one that ends by
    itself with an error would only do so again. A failure stops nothing but the jobs that need
    the failed one.
    """
    waiting = {job.name: job for job in jobs}
    running: set[str] = set()
    failed: set[str] = set()
    attempts = collections.Counter()
    try:
        while waiting or running:
            for job in list(waiting.values()):
                if job.needs in waiting or job.needs in running:
                    continue
                if job.is_finished():
                    del waiting[job.name]
                    yield Event("finished", job)
                elif job.needs in failed:
                    del waiting[job.name]
                    failed.add(job.name)
                    yield Event("failed", job, f"{job.needs}, which it needs, has failed")
                elif engine.has_room():
                    del waiting[job.name]
                    running.add(job.name)
                    attempts[job.name] += 1
                    engine.start(job)
                    yield Event("started", job)
            for job, code in engine.wait(wait_seconds) if running else ():
                running.remove(job.name)
                died = code is None or code < 0 or code in STOPPED
                if code == 0 and job.is_finished():
                    yield Event("finished", job)
                elif died and attempts[job.name] <= retries:
                    # At the head: others may wait for it.
                    waiting = {job.name: job, **waiting}
                    yield Event("retried", job, death_words(code))
                else:
                    failed.add(job.name)
                    again = f", {attempts[job.name]} times" if attempts[job.name] > 1 else ""
                    reason = f"{death_words(code)}{again}" if died else last_words(job.log)
                    yield Event("failed", job, reason)
            yield Event("tick")
    finally:
        engine.stop()


def death_words(code: int | None) -> str:
    """How a process that did not end by itself came to its end."""
    if code is None:
        return "its machine or its worker is gone"
    number = STOPPED.get(code, -code)
    name = signal.Signals(number).name
    hint = "; out of memory?" if number == signal.SIGKILL else ""
    return f"killed by {name}{hint}"


def last_words(log: pathlib.Path) -> str:
    """The last line of a log."""
    lines = log.read_text(encoding="utf-8", errors="replace").split("\n") if log.exists() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "printed nothing")
