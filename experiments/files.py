"""Files that are written whole or not at all, and what the folder of an experiment holds."""

import contextlib
import errno
import fcntl
import json
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from ml_collections import ConfigDict

from bavs_jax.selection.policies import get_policy
from bavs_jax.uncertainty.model import RECONSTRUCTION
from experiments.configs import base
from experiments.runtime import WorkdirError, is_first_process, reason, warn

SUMMARY_VERSION = 1
PICTURES = ("truth", "rgb", "error", "uncertainty", "depth", "half")
# What may differ when a folder is taken up again: more policies or seeds add runs.
EXTENSIBLE = (
    *("policies", "seeds", "checkpoint_seconds", "data_dir", "num_pictures"),
    *("evaluation.models", "evaluation.variant"),
)

# --- writing: of several processes that work together, the first one does it ----------------------


@contextlib.contextmanager
def _named_errors(path: str | os.PathLike) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        fix = "make room there, then start again"
        raise WorkdirError(f"{path}: cannot be written ({reason(error)}): {fix}") from error


def write_atomic(path: str | os.PathLike, write_fn: Callable) -> None:
    """Calls `write_fn(file)` on a temporary binary file beside `path`, then renames it.

    Raises:
      WorkdirError: it cannot be written, such as to a full disk.
    """
    if not is_first_process():
        return
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with _named_errors(path):
            with open(temporary, "wb") as file:
                write_fn(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
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
    with _named_errors(path), open(path, "ab+", buffering=0) as file:
        # The lock is for folders that machines share: only there may two lines overlap.
        fcntl.flock(file, fcntl.LOCK_EX)
        if file.seek(0, os.SEEK_END) and os.pread(file.fileno(), 1, file.tell() - 1) != b"\n":
            line = b"\n" + line  # what was being written when a process was killed
        if file.write(line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


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
    busy = f"{folder}: another process works here"
    with open(folder / ".lock", "wb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not wait:
                raise WorkdirError(f"{busy}; wait for its end, or use another --workdir") from None
            print(f"{busy}; waiting for its end", flush=True)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


# --- reading ---------------------------------------------------------------------------------


def load_json(path: str | os.PathLike) -> dict:
    """A JSON object; FileNotFoundError, or a ValueError that names a damaged file."""
    try:
        value = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: damaged (not JSON: {error})") from error
    if not isinstance(value, dict):
        raise ValueError(f"{path}: damaged (not a JSON object)")
    return value


def load_arrays(path: str | os.PathLike, *names: str) -> dict[str, np.ndarray]:
    """The arrays of an `.npz`; an error as in `load_json`, also where one of `names` is missing."""
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


def read_json(path: str | os.PathLike, otherwise: str = "made again") -> dict | None:
    """What `write_json` has written; None where there is no file or it is damaged.

    Of a damaged one a warning says what is done `otherwise`.
    """
    return _read(load_json, path, otherwise=otherwise)


def read_arrays(path: str | os.PathLike, *names: str) -> dict[str, np.ndarray] | None:
    """What `write_arrays` has written, with some names; None as in `read_json`."""
    return _read(load_arrays, path, *names, otherwise="made again")


def _read(load_fn: Callable, path, *names: str, otherwise: str):
    try:
        return load_fn(path, *names)
    except FileNotFoundError:
        pass
    except ValueError as error:
        warn(f"{error}: {otherwise}")
    return None


def read_versioned(
    path: str | os.PathLike, version: int, *, error: type[Exception], absent: str, fix: str
) -> dict:
    """The content of a JSON object whose `schema_version` this program knows.

    If it cannot be used, an `error` names the file, the field and what to do: `absent` where there
    is no file, `fix` where it is broken or of another version.
    """
    try:
        content = load_json(path)
    except FileNotFoundError:
        raise error(f"{path}: no such file; {absent}") from None
    except ValueError as problem:
        raise error(f"{problem}; {fix}") from None
    if (found := content.get("schema_version")) != version:
        raise error(f"{path}: schema_version is {found}, this program reads {version}; {fix}")
    return content


# --- pictures of several sizes in one array ---


def stack_pictures(images: list[np.ndarray]) -> np.ndarray:
    """Images [H_v, W_v, ...] as one array [n, H, W, ...] of the largest size, filled up with 0."""
    height, width = np.max([image.shape[:2] for image in images], axis=0)
    stacked = np.zeros((len(images), height, width, *images[0].shape[2:]), images[0].dtype)
    for whole, image in zip(stacked, images):
        whole[: image.shape[0], : image.shape[1]] = image
    return stacked


def cut_pictures(arrays: dict) -> dict:
    """The content of a file of pictures, each of `PICTURES` a list of images [H_v, W_v, ...].

    `sizes` [n, 2] (width, height) says how large they are; without, all are of one size.
    """
    if "sizes" not in arrays:
        return arrays
    cut = {}
    for name in PICTURES:
        if name in arrays:
            pairs = zip(arrays[name], arrays["sizes"])
            cut[name] = [image[:height, :width] for image, (width, height) in pairs]
    return arrays | cut


# --- parts of an experiment ------------------------------------------------------------------


class Part(NamedTuple):
    """A policy with a seed, or round 0 of a seed, which all policies of a field kind share.

    Each has a folder of its own, such as `bavs/seed_0` and `initial/seed_0`.
    """

    policy: str | None  # None: round 0
    kind: str  # of the field that is trained
    seed: int

    @property
    def name(self) -> str:
        """Its folder in the working folder."""
        first = "initial" if self.kind == RECONSTRUCTION else f"initial_{self.kind}"
        return f"{self.policy or first}/seed_{self.seed}"

    @property
    def initial(self) -> "Part":
        """The part that makes the round 0 it starts from."""
        return self._replace(policy=None)


def all_parts(policies, seeds) -> list[Part]:
    """Every part of an experiment, round 0 before what starts from it, seed by seed."""
    parts = [Part(p, get_policy(p).field_kind, seed) for seed in seeds for p in policies]
    return list(dict.fromkeys(p for part in parts for p in (part.initial, part)))


def is_finished(workdir: pathlib.Path, part: Part) -> bool:
    """Whether all files of a part are written, and none is damaged."""
    folder = workdir / part.name
    if part.policy is None:
        return read_json(folder / "round_0.json") is not None
    pictures = folder / "pictures.npz"  # of the first seed only
    return (
        is_completed(read_json(folder / "result.json"))
        and read_json(folder / "next_views" / "transforms.json") is not None
        and read_arrays(folder / "acquisition.npz") is not None
        and (not pictures.exists() or read_arrays(pictures) is not None)
    )


def is_completed(result: dict | None) -> bool:
    """Whether a result file is there, and of a run that has come to its end."""
    return result is not None and bool(result.get("completed"))


# --- the config and the results --------------------------------------------------------------


def leaves(config, prefix: str = "") -> dict:
    """Every option by its dotted name; a group that is no group counts as an option."""
    found = {}
    for key, value in config.items():
        if isinstance(value, (dict, ConfigDict)):
            found |= leaves(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found


# What stood for the default in earlier versions, and is read as None.
WAS_NONE = {
    "": ("data_dir", "load.split", "sampler_kind", "candidates.mode", "view_seed"),
    0: (
        *("load.downscale", "load.pool_size", "load.test_every", "train.learning_rate"),
        *("candidates.min_train_distance", "candidates.min_candidate_distance"),
        "uncertainty.prior_weight",
    ),
}
# What values of options were called, and what is read in place of it.
OLD_VALUES: dict[str, dict] = {option: {old: None} for old in WAS_NONE for option in WAS_NONE[old]}
OLD_VALUES["uncertainty.weighting"] = dict(
    eq13="gauss_newton", eq11="residual_weighted", empirical="empirical_fisher"
)


GONE = ("predict_gain",)  # options that changed neither a field nor a choice


def modern_value(option: str, value):
    """What is read in place of an option's value, for most values that itself."""
    is_word = type(value) in (str, int, float)  # True and False are no old names of 1 and 0
    return OLD_VALUES.get(option, {}).get(value, value) if is_word else value


def modern(saved: dict) -> dict:
    """Options of a `config.json` by their dotted names, in the words of this version."""
    groups = {name: base.get_config()[name].to_dict() for name in ("pool", "targets")}
    options = {}
    # Without these groups all did what is their default; the hash grid was called `field`.
    for option, value in leaves(groups | saved).items():
        name = option.replace("field.", "hash_grid.") if option.startswith("field.") else option
        if name not in GONE:
            options[name] = modern_value(name, value)
    if type(options.get("view_seed")) is str:  # a seed was written as text
        options["view_seed"] = int(options["view_seed"])
    return options


def check_claim(workdir: pathlib.Path, config) -> None:
    """Raises WorkdirError if a folder holds runs of another config; writes nothing."""
    path = workdir / "config.json"
    checkpoints = (p.name.isdigit() for p in workdir.glob("*/seed_*/checkpoints/*"))
    has_work = any(checkpoints) or any(workdir.glob("*/seed_*/result.json"))
    if not has_work or not path.exists():
        return
    try:
        before = modern(load_json(path))
    except ValueError as error:
        raise WorkdirError(
            f"{error}: delete it if the runs there are of this config, and start again; or use "
            "another --workdir"
        ) from error
    old, new = ({k: json.dumps(v) for k, v in c.items()} for c in (before, leaves(config)))
    for option, _ in sorted(old.items() ^ new.items()):
        if option not in EXTENSIBLE:
            raise WorkdirError(
                f"{path}: {option}: differs from the run that is there; "
                "use another --workdir or the same config"
            )


def claim(workdir: pathlib.Path, config) -> None:
    """Makes a folder and its `config.json`; to be called when all else has been checked."""
    check_claim(workdir, config)
    write_json(workdir / "config.json", config.to_dict())


def collect(workdir: pathlib.Path) -> dict:
    """Collects all `<policy>/seed_<n>/result.json` into `summary.json`."""
    runs = {}
    for path in workdir.glob("*/seed_*/result.json"):
        policy, seed = path.parts[-3], path.parts[-2].removeprefix("seed_")
        if not seed.isdecimal():
            warn(f"{path.parent}: not seed_<number>: left out of summary.json")
        elif result := read_json(path, "left out of summary.json until its run is started again"):
            runs[policy, int(seed)] = result
    summary = {"schema_version": SUMMARY_VERSION, "runs": [runs[key] for key in sorted(runs)]}
    write_json(workdir / "summary.json", summary)
    return summary


def export_next_views(workdir: pathlib.Path, policy: str, seed: int) -> pathlib.Path:
    """Copies one run's chosen poses to `next_views/transforms.json`."""
    source = workdir / policy / f"seed_{seed}" / "next_views" / "transforms.json"
    target = workdir / "next_views" / "transforms.json"
    write_atomic(target, lambda file: file.write(source.read_bytes()))
    return target
