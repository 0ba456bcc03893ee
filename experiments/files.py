"""Files that are written whole or not at all, and read with one-line errors."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import pathlib
from collections.abc import Callable, Iterator

import numpy as np

from experiments.errors import WorkdirError
from experiments.runtime import warn
from experiments.signals import is_first_process


def write_atomic(path: str | os.PathLike, write_fn: Callable) -> None:
    """Calls `write_fn(file)` on a temporary binary file beside `path`, then renames it.

    Of several processes that work together, the first one writes; so it is everywhere here.

    Raises:
      WorkdirError: it cannot be written, such as to a full disk.
    """
    if not is_first_process():
        return
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            write_fn(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise WorkdirError(
            f"{path}: cannot be written ({error.strerror or error}): make room there, then start "
            "again"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


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
    line = (json.dumps(value, allow_nan=False) + "\n").encode()
    try:
        with open(path, "ab+", buffering=0) as file:
            # The lock is for folders that machines share: only there may two lines overlap.
            fcntl.flock(file, fcntl.LOCK_EX)
            if file.seek(0, os.SEEK_END) and os.pread(file.fileno(), 1, file.tell() - 1) != b"\n":
                line = b"\n" + line  # what was being written when a process was killed
            if file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError as error:
        raise WorkdirError(
            f"{path}: cannot be written ({error.strerror}): make room there, then start again"
        ) from error


def read_json(path: str | os.PathLike, otherwise: str = "made again") -> dict | None:
    """What `write_json` has written; None where there is nothing or, after a warning, a damaged
    file.

    Args:
      path: of the file.
      otherwise: what is done about a damaged one.
    """
    try:
        value = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
        if isinstance(value, dict):
            return value
        reason = "not a JSON object"
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError) as error:
        reason = f"not JSON: {error}"
    warn(f"{path}: damaged ({reason}): {otherwise}")
    return None


def read_arrays(path: str | os.PathLike, *names: str) -> dict[str, np.ndarray] | None:
    """What `write_arrays` has written, with some names; None as in `read_json`."""
    try:
        return load_arrays(path, *names)
    except FileNotFoundError:
        return None
    except ValueError as error:
        warn(f"{error}: made again")
        return None


def load_arrays(path: str | os.PathLike, *names: str) -> dict[str, np.ndarray]:
    """The arrays of an `.npz`.

    Raises:
      FileNotFoundError: there is no file.
      ValueError: it is damaged or lacks one of `names`; names the file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise
    # Of zip, zlib, the header's tokens and the size it claims, damage may break any.
    except Exception as error:
        raise ValueError(f"{path}: damaged ({' '.join(str(error).split())})") from error
    if missing := [name for name in names if name not in arrays]:
        raise ValueError(f"{path}: lacks {', '.join(missing)}")
    return arrays


@contextlib.contextmanager
def exclusive(folder: str | os.PathLike, *, wait: bool = True) -> Iterator[None]:
    """Waits until no other process works in a folder, and keeps others out until the end.

    The lock ends with the process that holds it: one that is killed leaves none behind.

    Raises:
      WorkdirError: another process works there, if this one is not to `wait`.
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
            if not wait:
                raise WorkdirError(
                    f"{folder}: another process works here; wait for its end, or use another "
                    "--workdir"
                ) from None
            print(f"{folder}: another process works here; waiting for its end", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def read_versioned(
    path: str | os.PathLike, version: int, *, error: type[Exception], absent: str, fix: str
) -> dict:
    """The content of a JSON object whose `schema_version` this program knows.

    Args:
      path: of the file.
      version: that it must have.
      error: what to raise.
      absent: what to do where there is no file, in the imperative.
      fix: what to do where it is broken or of another version.

    Raises:
      error: one line that names the file, the field and the fix.
    """
    try:
        content = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise error(f"{path}: no such file; {absent}") from None
    except ValueError as problem:  # not JSON, or not text
        raise error(f"{path}: not JSON ({problem}); {fix}") from None
    if not isinstance(content, dict):
        raise error(f"{path}: not a JSON object; {fix}")
    found = content.get("schema_version")
    if found != version:
        raise error(f"{path}: schema_version is {found}, this program reads {version}; {fix}")
    return content


# --- pictures of several sizes in one array ---

PICTURES = ("truth", "rgb", "error", "uncertainty", "depth", "half")


def stack_pictures(images: list[np.ndarray]) -> np.ndarray:
    """Images [H_v, W_v, ...] as one array [n, H, W, ...] of the largest size, filled up with 0."""
    height, width = np.max([image.shape[:2] for image in images], axis=0)
    first = images[0]
    stacked = np.zeros((len(images), height, width, *first.shape[2:]), first.dtype)
    for whole, image in zip(stacked, images):
        whole[: image.shape[0], : image.shape[1]] = image
    return stacked


def cut_pictures(arrays: dict) -> dict:
    """The content of a file of pictures, each picture again at its own size.

    Args:
      arrays: `PICTURES` as from `stack_pictures`, and `sizes` [n, 2] (width, height), without
        which all are of one size.

    Returns:
      The same, with a list of [H_v, W_v, ...] in place of each array of `PICTURES`.
    """
    if "sizes" not in arrays:
        return arrays
    sizes, names = arrays["sizes"], [name for name in PICTURES if name in arrays]
    return arrays | {
        name: [image[:height, :width] for image, (width, height) in zip(arrays[name], sizes)]
        for name in names
    }
