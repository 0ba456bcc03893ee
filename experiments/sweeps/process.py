"""One attempt at a job: a process of its own that ends with whoever started it."""

from __future__ import annotations

import os
import pathlib
import shlex
import subprocess
import sys


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
