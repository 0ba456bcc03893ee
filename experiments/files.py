"""Files that are written whole or not at all."""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import Callable

import numpy as np


def write_atomic(path: str | os.PathLike, write_fn: Callable) -> None:
    """Calls `write_fn(file)` on a temporary binary file beside `path`, then renames it."""
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
    """One JSON object as a line at the end of a file."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(value, allow_nan=False) + "\n")
