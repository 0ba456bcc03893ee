"""Progress lines where there is no terminal, and the bar where there is one."""

from __future__ import annotations

import io
import itertools

import pytest

from experiments import runtime


class _Terminal(io.StringIO):
    def isatty(self):
        return True


def test_plain_lines_come_at_most_every_10_seconds_and_once_at_the_end():
    stream, now = io.StringIO(), [0.0]
    with runtime.track(30, "train", "steps", stream=stream, clock=lambda: now[0]) as task:
        for step in range(30):
            now[0] += 1.0  # one unit a second
            task.advance(1, loss=1.0 / (step + 1))
    assert stream.getvalue().splitlines() == [
        "train: 10/30 steps, 1 steps/s, 10 s elapsed, 20 s remaining, loss 0.1",
        "train: 20/30 steps, 1 steps/s, 20 s elapsed, 10 s remaining, loss 0.05",
        "train: 30/30 steps, 1 steps/s, 30 s elapsed, 0 s remaining, loss 0.03333",
    ]


def test_plain_numbers_stay_until_they_are_given_again():
    stream, ticks = io.StringIO(), itertools.count(0.0, 20.0)
    with runtime.track(4, "train", stream=stream, clock=lambda: next(ticks)) as task:
        task.advance(1, psnr=20.0)
        task.advance(2, loss=0.5)
        task.advance(1, psnr=25.5)
    assert stream.getvalue().splitlines()[-1].endswith("psnr 25.5, loss 0.5")


def test_plain_line_is_written_even_if_the_work_stops_early():
    stream = io.StringIO()
    with (
        pytest.raises(KeyboardInterrupt),
        runtime.track(5, "score", "views", stream=stream, clock=lambda: 3.0) as task,
    ):
        task.advance(2)
        raise KeyboardInterrupt
    assert stream.getvalue() == "score: 2/5 views, 0 s elapsed\n"


def test_a_terminal_gets_a_bar():
    stream = _Terminal()
    with runtime.track(3, "train", "steps", stream=stream) as task:
        for _ in range(3):
            task.advance(1, loss=0.25)
    assert "3/3" in stream.getvalue()
    assert "remaining" in stream.getvalue()
