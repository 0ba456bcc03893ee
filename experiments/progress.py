"""Progress of long work: a bar on a terminal, a plain line every few seconds elsewhere.

The library never imports this: a script passes `advance` as a callback.

    with progress.track(steps, "train", unit="steps") as task:
        for _ in range(steps):
            ...
            task.advance(1, loss=loss, psnr=psnr)
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

PLAIN_INTERVAL = 10.0  # seconds between two lines where there is no terminal


class Task(Protocol):
    """What `track` hands out."""

    def advance(self, n: int = 1, **numbers: float) -> None:
        """Counts `n` more units as done and shows `numbers` until they are given again."""


@contextlib.contextmanager
def track(
    total: int,
    description: str,
    unit: str = "steps",
    *,
    stream: TextIO | None = None,
    interval: float = PLAIN_INTERVAL,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Task]:
    """Shows how far a piece of work is, how fast it goes and when it will end.

    Args:
      total: how many units the work has.
      description: what is being done, in a word or two.
      unit: what is counted, in the plural.
      stream: where to write; standard output by default. A bar if it is a terminal.
      interval: least number of seconds between two lines where it is not.
      clock: seconds since some moment; another one is of use in tests.

    Yields:
      A `Task`; call its `advance` as the work goes on.
    """
    stream = sys.stdout if stream is None else stream
    meter = _Meter(total, description, unit, clock)
    if stream.isatty():
        with _bar(stream) as bar:
            yield _BarTask(meter, bar, bar.add_task(description, total=total, meter=meter))
        return
    task = _PlainTask(meter, stream, interval)
    try:
        yield task
    finally:
        task.write_line()


class _Meter:
    """Counts units and seconds, and puts them in words."""

    def __init__(self, total, description, unit, clock):
        self.total, self.description, self.unit, self.clock = total, description, unit, clock
        self.done, self.numbers, self.start = 0, {}, clock()

    def advance(self, n, numbers):
        self.done += n
        # A new dict: the bar reads it from its own thread.
        self.numbers = {**self.numbers, **numbers}

    def state(self) -> str:
        """Rate, elapsed and remaining time, and the current numbers."""
        elapsed = self.clock() - self.start
        parts = [f"{elapsed:.0f} s elapsed"]
        if self.done and elapsed > 0:
            rate = self.done / elapsed
            remaining = max(self.total - self.done, 0) / rate
            parts = [f"{rate:.3g} {self.unit}/s", *parts, f"{remaining:.0f} s remaining"]
        parts += [f"{name} {float(value):.4g}" for name, value in self.numbers.items()]
        return ", ".join(parts)


class _BarTask:
    def __init__(self, meter, bar, task_id):
        self._meter, self._bar, self._task_id = meter, bar, task_id

    def advance(self, n: int = 1, **numbers: float) -> None:
        self._meter.advance(n, numbers)
        self._bar.advance(self._task_id, n)


class _StateColumn(ProgressColumn):
    """The meter in words, made only when the bar is redrawn.

    A number may still be on its way from the device; reading it at every step would wait for it.
    """

    def render(self, task) -> Text:
        return Text(task.fields["meter"].state())


class _PlainTask:
    def __init__(self, meter, stream, interval):
        self._meter, self._stream, self._interval = meter, stream, interval
        self._last_line = meter.start

    def advance(self, n: int = 1, **numbers: float) -> None:
        self._meter.advance(n, numbers)
        now = self._meter.clock()
        # The last unit is left to the line that closes the task.
        if now - self._last_line >= self._interval and self._meter.done < self._meter.total:
            self._last_line = now
            self.write_line()

    def write_line(self) -> None:
        meter = self._meter
        line = f"{meter.description}: {meter.done}/{meter.total} {meter.unit}, {meter.state()}"
        print(line, file=self._stream, flush=True)


def _bar(stream: TextIO) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _StateColumn(),
        console=Console(file=stream),
    )
