"""Every change that Python makes to files below a folder, one operation at a time."""

from __future__ import annotations

import builtins
import contextlib
import io
import os
import pathlib
import sys
from collections.abc import Callable, Iterator

# Audit events that change files, and which of their arguments are paths.
EVENTS = {
    "os.rename": 2,
    "os.remove": 1,
    "os.rmdir": 1,
    "os.mkdir": 1,
    "os.link": 2,
    "os.symlink": 2,
    "os.truncate": 1,
}

_watchers: list[Callable] = []


def _audit(event: str, args: tuple) -> None:
    if not _watchers:
        return
    if event in EVENTS:
        for watcher in _watchers:
            watcher(event, args[: EVENTS[event]])
    elif event == "open" and isinstance(args[2], int) and args[2] & (os.O_CREAT | os.O_TRUNC):
        for watcher in _watchers:
            watcher(event, args[:1])


class _WatchedFile(io.FileIO):
    """Writes in two halves, and says so before each."""

    def write(self, data) -> int:
        data = memoryview(data).cast("B")
        half = len(data) // 2
        for part in (data[:half], data[half:]):
            for watcher in _watchers:
                watcher("write", (self.name,))
            while part:
                part = part[super().write(part) :]
        return len(data)


def _watched_open(plain_open: Callable) -> Callable:
    def watched(
        file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, closefd=True,
        opener=None,
    ):  # fmt: skip
        if not _watchers or not set(mode) & set("wax+"):
            return plain_open(file, mode, buffering, encoding, errors, newline, closefd, opener)
        raw = _WatchedFile(file, mode.replace("b", "").replace("t", ""), closefd, opener)
        if buffering == 0:
            return raw
        binary = (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)
        return binary if "b" in mode else io.TextIOWrapper(binary, encoding, errors, newline)

    return watched


@contextlib.contextmanager
def watched(folder: pathlib.Path, on_operation: Callable[[str, str], None]) -> Iterator[None]:
    """Calls `on_operation(name, path)` before each operation on something below a folder.

    Seen are what is opened for writing, each half of what is written, fsync, and what is renamed,
    removed, made or cut; from every thread, but not what compiled libraries do by themselves.
    """
    root = os.path.realpath(folder)

    def watcher(name, paths):
        for path in paths:
            if isinstance(path, int):
                path = os.readlink(f"/proc/self/fd/{path}")
            if os.path.realpath(os.fspath(path)).startswith(root):
                on_operation(name, os.fspath(path))
                return

    def fsync(fd):
        watcher("fsync", (fd if isinstance(fd, int) else fd.fileno(),))
        plain_fsync(fd)

    plain_open, plain_fsync = builtins.open, os.fsync
    builtins.open = io.open = _watched_open(plain_open)
    os.fsync = fsync
    _watchers.append(watcher)
    if not _hooked:
        sys.addaudithook(_audit)
        _hooked.append(True)
    try:
        yield
    finally:
        _watchers.remove(watcher)
        builtins.open = io.open = plain_open
        os.fsync = plain_fsync


_hooked: list[bool] = []  # an audit hook cannot be taken away
