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
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn
from rich.text import Text

PLAIN_INTERVAL = 10.0  # seconds between two lines where there is no terminal


class Task:
    """What `track` hands out: counts units and seconds, and puts them in words."""

    def __init__(self, total: int, description: str, unit: str, clock: Callable[[], float]):
        self.total, self.description, self.unit, self._clock = total, description, unit, clock
        self.done, self._numbers, self._start = 0, {}, clock()
        self.on_advance: Callable[[int], None] = lambda n: None

    def advance(self, n: int = 1, **numbers: float) -> None:
        """Counts `n` more units as done and shows `numbers` until they are given again."""
        self.done += n
        # A new dict: the bar reads it from its own thread.
        self._numbers = {**self._numbers, **numbers}
        self.on_advance(n)

    def seconds(self) -> float:
        """Since the task began."""
        return self._clock() - self._start

    def state(self) -> str:
        """Rate, elapsed and remaining time, and the current numbers."""
        elapsed = self.seconds()
        parts = [f"{elapsed:.0f} s elapsed"]
        if self.done and elapsed > 0:
            rate = self.done / elapsed
            remaining = max(self.total - self.done, 0) / rate
            parts = [f"{rate:.3g} {self.unit}/s", *parts, f"{remaining:.0f} s remaining"]
        parts += [f"{name} {float(value):.4g}" for name, value in self._numbers.items()]
        return ", ".join(parts)


class _StateColumn(ProgressColumn):
    """The task in words, made only when the bar is redrawn.

    A number may still be on its way from the device; reading it at every step would wait for it.
    """

    def render(self, task) -> Text:
        return Text(task.fields["own"].state())


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
    task, shown_at = Task(total, description, unit, clock), 0.0
    if stream.isatty():
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        with Progress(*columns, _StateColumn(), console=Console(file=stream)) as bar:
            number = bar.add_task(description, total=total, own=task)
            task.on_advance = lambda n: bar.advance(number, n)
            yield task
        return

    def write_line() -> None:
        line = f"{description}: {task.done}/{total} {unit}, {task.state()}"
        print(line, file=stream, flush=True)

    def write_sometimes(n: int) -> None:
        nonlocal shown_at
        # The last unit is left to the line that closes the task.
        if task.seconds() - shown_at >= interval and task.done < total:
            shown_at = task.seconds()
            write_line()

    task.on_advance = write_sometimes
    try:
        yield task
    finally:
        write_line()
