"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pathlib
from collections.abc import Callable, Iterator

import numpy as np

from experiments.processes import is_first_process


def write_atomic(path: str | os.PathLike, write_fn: Callable) -> None:
    """Calls `write_fn(file)` on a temporary binary file beside `path`, then renames it.

    Of several processes that work together, the first one writes; so it is everywhere here.
    """
    if not is_first_process():
        return
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            write_fn(file)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: str | os.PathLike, value) -> None:
    """Strict JSON, indented; a NaN is an error here, so it must be turned into null before."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    write_atomic(path, lambda file: file.write(text.encode()))


def write_arrays(path: str | os.PathLike, **arrays) -> None:
    """A compressed `.npz`."""
    write_atomic(path, lambda file: np.savez_compressed(file, **arrays))


def append_line(path: str | os.PathLike, value: dict) -> None:
    """One JSON object as a line at the end of a file that several processes may write to."""
    if not is_first_process():
        return
    line = json.dumps(value, allow_nan=False) + "\n"
    with open(path, "ab", buffering=0) as file:
        # The lock is for folders that machines share: only there may two lines overlap.
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(line.encode())


@contextlib.contextmanager
def exclusive(folder: str | os.PathLike) -> Iterator[None]:
    """Waits until no other process works in a folder, and keeps others out until the end.

    The lock ends with the process that holds it: one that is killed leaves none behind.
    """
    if not is_first_process():
        yield
        return
    folder = pathlib.Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "wb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print(f"{folder}: another process works here; waiting for its end", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
