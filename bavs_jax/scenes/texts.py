"""Text, JSON and array files: read within bounds, so that no file costs more than it should."""

import errno
import json
import pathlib
from collections.abc import Iterator

import numpy as np

from bavs_jax.scenes.base import SceneError

MAX_TEXT_BYTES = 1 << 25  # transforms of some 30,000 frames; parsed, a file grows twenty-fold
MAX_VALUES = 1 << 26  # of an array


def is_file(path: pathlib.Path) -> bool:
    """Whether there is a file; of a name that is too long for one, there is none."""
    try:
        return path.is_file()
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        return False


def one_line(error: BaseException, most: int | None = None) -> str:
    """A foreign error's message without its line breaks, cut after `most` characters."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if most is None or len(text) <= most else f"{text[:most]} ..."


def check_file(path: pathlib.Path) -> None:
    """Raises SceneError where there is no such file."""
    if not is_file(path):
        raise SceneError(f"{path}: file is missing: check its folder")


def check_size(path: pathlib.Path, most: int, fix: str) -> None:
    """Raises SceneError where a file has more bytes than `most`."""
    size = path.stat().st_size
    if size > most:
        raise SceneError(f"{path}: has {size / 1e6:.0f} MB, over {most / 1e6:.0f}: {fix}")


def read_text(path: pathlib.Path) -> str:
    """A text file, with or without a byte-order mark.

    Raises:
      SceneError: the file is missing, no UTF-8 text, or larger than any that a scene needs.
    """
    check_file(path)
    check_size(path, MAX_TEXT_BYTES, "split it")
    return "".join(line for _, line in text_lines(path))


def text_lines(path: pathlib.Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file of any length, each with its line break."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            yield from enumerate(file, start=1)
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not UTF-8 text ({error.reason}): save it as UTF-8") from error


def parse_json(path: pathlib.Path):
    """The value in a JSON file.

    Raises:
      SceneError: the file cannot be read, is no JSON, is nested too deeply, or holds a whole
        number of thousands of digits.
    """
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise SceneError(f"{path}: line {error.lineno}: {error.msg}: mend the JSON") from error
    except RecursionError as error:
        raise SceneError(f"{path}: lists are nested too deeply: mend the JSON") from error
    except SceneError:
        raise
    except ValueError as error:  # more digits than Python turns into an integer
        raise SceneError(f"{path}: holds a number of too many digits: mend the JSON") from error


def read_json(path: pathlib.Path) -> dict:
    """Reads a JSON file whose top level is an object; errors as of `parse_json`."""
    data = parse_json(path)
    if not isinstance(data, dict):
        raise SceneError(f"{path}: top level is a {type(data).__name__}: make it an object")
    return data


def read_array(path: pathlib.Path) -> np.ndarray:
    """A numeric array from an .npy file, which must be as long as its header says."""
    check_file(path)
    try:
        # Mapped, so that nothing is allocated for what a header claims.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # of many kinds: a head is read as Python, a .npz as a ZIP file
        raise SceneError(
            f"{path}: array cannot be read ({one_line(error)}): save it with np.save"
        ) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise SceneError(f"{path}: holds no array of numbers: save it with np.save")
    if array.size > MAX_VALUES:
        raise SceneError(
            f"{path}: has shape {list(array.shape)}, over {MAX_VALUES / 1e6:.0f} million values: "
            "reduce it"
        )
    return np.array(array)
