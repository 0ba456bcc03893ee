"""What every script needs: errors in one line, flags, caches, progress, and what it runs on."""

import contextlib
import functools
import importlib.metadata
import math
import os
import pathlib
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator

import jax
import numpy as np
from absl import app, flags, logging
from jax.experimental import multihost_utils
from ml_collections import config_flags
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from bavs_jax.export.formats import ExportError
from bavs_jax.placement.collect import PlacementError
from bavs_jax.scenes import SceneError
from bavs_jax.scenes.base import printable
from bavs_jax.selection import SelectionError
from experiments import handle_signals, stop

PACKAGES = ("bavs_jax", "jax", "jaxlib", "flax", "optax", "numpy")
PLAIN_INTERVAL = 10.0  # seconds between two lines of progress where there is no terminal
FLAGS = flags.FLAGS
flags.disclaim_key_flags()  # flags that are defined here are those of the module that asks for them

# --- errors ----------------------------------------------------------------------------------


class ConfigError(ValueError):
    """An option that cannot be used: one line that names it and the fix."""


class WorkdirError(ValueError):
    """A folder that cannot be used: one line that names the file, the field and the fix."""


class ReportError(ValueError):
    """A file that cannot be used: one line that names the file, the field and the fix."""


# What a script prints in place of a traceback. FloatingPointError is a loss that is not finite.
USER_ERRORS = (
    *(ConfigError, WorkdirError, ReportError, FloatingPointError, OSError),
    *(SceneError, SelectionError, PlacementError, ExportError),
)


def shown(value) -> str:
    """A value that a user gave, in one short line of characters that can be printed."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write out a number of thousands of digits
        return f"a number of {value.bit_length():,} bits"
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text):,} characters)"


def one_line(error: Exception) -> str:
    """An error in one line: of a traceback, where it began and what went wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(dict.fromkeys([lines[0], lines[-1]])) if lines else type(error).__name__


def reason(error: Exception) -> str:
    """What was wrong, without the name of the file that an OSError repeats."""
    return getattr(error, "strerror", None) or str(error)


@functools.cache
def warn(text: str) -> None:
    """A line on standard error, for what goes on all the same; said once."""
    print(f"warning: {text}", file=sys.stderr, flush=True)


# --- a script's start and end ----------------------------------------------------------------


def run_script(main: Callable[[], None]) -> None:
    """Runs a script's `main()` after reading its flags; what goes wrong ends in one line.

    So do ctrl-C and SIGTERM, with the exit codes that shells give for them.
    """
    received = []

    def interrupt(number, frame):
        if received:
            stop(number)
        received.append(number)
        raise KeyboardInterrupt

    def parse(argv):
        try:
            left = FLAGS(argv)
        except flags.Error as error:
            sys.exit(f"error: {one_line(error)}; --help explains every flag")
        except Exception as error:  # a config file is a program: it can raise anything
            sys.exit(
                "error: --config: no such option or file, or a value of another type: "
                f"{one_line(error)}"
            )
        for name, value in FLAGS.flag_values_dict().items():  # no bounds of a flag catch a NaN
            if isinstance(value, float) and not math.isfinite(value):
                sys.exit(f"error: --{name}: is {value}; give a finite number")
        return left

    def without_arguments(argv):
        if len(argv) > 1:
            sys.exit(f"error: unknown argument {argv[1]!r}; options are given as --name=value")
        # Checkpoint libraries report every write at INFO; warnings and errors still show.
        logging.set_verbosity(logging.WARNING)
        handle_signals(interrupt)
        try:
            main()
        except BaseException as error:
            if received:  # libraries may make another error of the interrupt
                stop(received[0])
            if isinstance(error, USER_ERRORS):
                sys.exit(f"error: {' '.join(str(error).split())}")
            raise

    app.run(without_arguments, flags_parser=parse)


def command_line() -> str:
    """The command as a user would type it."""
    module = sys.modules["__main__"].__spec__
    name = f"python -m {module.name}" if module else f"python {sys.argv[0]}"
    return " ".join([name, *sys.argv[1:]])


def given_folder(flag: str, hint: str, *, exists: bool = False) -> pathlib.Path:
    """The folder that a flag names, which can be made or, if it `exists` already, read.

    Raises ConfigError with a `hint` of what to name if it cannot be used.
    """
    text = FLAGS[flag].value
    if not text:
        raise ConfigError(f"--{flag}: is missing; name {hint}")
    path = pathlib.Path(text)
    try:
        if "\0" in text:  # `Path.exists` says no more than that there is none
            raise ValueError("embedded null byte")
        found = path if exists else next(p for p in (path, *path.parents) if p.exists())
        os.scandir(found).close()
        if not exists and not os.access(found, os.W_OK | os.X_OK):
            raise PermissionError(f"no permission to write into {found}")
    except (OSError, ValueError) as error:
        why = f"{shown(text)} cannot be used ({reason(error)})"
        raise ConfigError(f"--{flag}: {why}; name {hint}") from None
    return path


def define_config_flag(what: str, default: str | None = None) -> None:
    """Gives a script the flag of its config: `what` that is, with the file of a default."""
    text = f"{what}; options are explained in experiments/configs/base.py, set as "
    config_flags.DEFINE_config_file(
        "config", default, f"{text}--config.name=value.", lock_config=True
    )


# --- caches ----------------------------------------------------------------------------------


def cache_folder(given: str = "") -> pathlib.Path | None:
    """Where scenes and compiled programs are kept: `given`, or `bavs_jax` in the user's cache.

    It is there; None, after a warning, if nothing can be written to it.
    """
    root = given or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        folder = pathlib.Path(root).expanduser() / ("" if given else "bavs_jax")
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except (OSError, ValueError, RuntimeError) as error:  # the last: a user without a home
        warn(
            f"{printable(root)}: cannot be used ({reason(error)}): goes on without a cache; set "
            "XDG_CACHE_HOME or --compilation_cache_dir to have one"
        )
        return None
    return folder


def scene_cache() -> str | None:
    """Where scenes are kept, as loaders take it."""
    folder = cache_folder()
    return None if folder is None else str(folder / "scenes")


def use_compilation_cache(folder: pathlib.Path) -> None:
    """Keeps compiled programs for the next start."""
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def define_cache_flags() -> None:
    """Gives a script the flags of the compilation cache, which it keeps by default."""
    flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")
    text = "Their folder, $XDG_CACHE_HOME/bavs_jax/compiled or in ~/.cache by default."
    flags.DEFINE_string("compilation_cache_dir", "", text)


def start_cache() -> None:
    """Does what the flags of the cache say; must come before anything is compiled."""
    given = FLAGS.compilation_cache_dir
    folder = cache_folder(given) if FLAGS.compilation_cache else None
    if folder is not None:
        use_compilation_cache(folder if given else folder / "compiled")


# --- processes that work together ------------------------------------------------------------


def is_first_process() -> bool:
    """Whether this process is the one that writes files."""
    return not jax.distributed.is_initialized() or jax.process_index() == 0


def as_first_process(value: bool) -> bool:
    """What the first process says, so that all do the same where clocks or files differ."""
    if not jax.distributed.is_initialized():
        return value
    return bool(multihost_utils.broadcast_one_to_all(np.array(value)))


# --- progress --------------------------------------------------------------------------------


class Task:
    """What `track` hands out: counts what is done; its text says how far and how fast that is."""

    def __init__(self, total: int, unit: str, clock: Callable[[], float]):
        self.total, self.unit, self.clock = total, unit, clock
        self.done, self.numbers, self.start = 0, {}, clock()
        self.on_advance: Callable[[int], None] = lambda n: None

    def advance(self, n: int = 1, **numbers: float) -> None:
        """Counts `n` more units as done and shows `numbers` until they are given again."""
        self.done += n
        self.numbers = {**self.numbers, **numbers}  # a new dict: the bar's own thread reads it
        self.on_advance(n)

    def __str__(self) -> str:
        """Rate, elapsed and remaining time, and the current numbers."""
        elapsed = self.clock() - self.start
        parts = [f"{elapsed:.0f} s elapsed"]
        if self.done and elapsed > 0:
            rate = self.done / elapsed
            remaining = max(self.total - self.done, 0) / rate
            parts = [f"{rate:.3g} {self.unit}/s", *parts, f"{remaining:.0f} s remaining"]
        return ", ".join(parts + [f"{name} {float(x):.4g}" for name, x in self.numbers.items()])


@contextlib.contextmanager
def track(
    total: int, description: str, unit: str = "steps", *, stream=None, clock=time.monotonic
) -> Iterator[Task]:
    """Shows how far a piece of work is, how fast it goes and when it will end.

    It has `total` units. On a terminal there is a bar, elsewhere a line every `PLAIN_INTERVAL`
    seconds and at the end. The library never imports this: scripts pass it on as a callback.

    Yields:
      A `Task`; call its `advance(n, loss=loss)` as the work goes on.
    """
    stream = sys.stdout if stream is None else stream
    task = Task(total, unit, clock)
    if stream.isatty():
        # The last column is made when the bar is redrawn: a number may still be on its way from
        # the device, and reading it at every step would wait for it.
        words = TextColumn("{task.fields[own]}", markup=False)
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), words
        with Progress(*columns, console=Console(file=stream)) as bar:
            number = bar.add_task(description, total=total, own=task)
            task.on_advance = lambda n: bar.advance(number, n)
            yield task
        return
    shown_at = task.start

    def write_line() -> None:
        print(f"{description}: {task.done}/{total} {unit}, {task}", file=stream, flush=True)

    def write_sometimes(n: int) -> None:
        nonlocal shown_at
        # The last unit is left to the line that closes the task.
        if clock() - shown_at >= PLAIN_INTERVAL and task.done < total:
            shown_at = clock()
            write_line()

    task.on_advance = write_sometimes
    try:
        yield task
    finally:
        write_line()


# --- what a result was made on ---------------------------------------------------------------


def made_by() -> dict:
    """What every result file says of how it was made."""
    return {"command": command_line(), "device": device_name(), "versions": versions()}


def versions() -> dict[str, str]:
    """Of the packages that results depend on, of Python, and of this code where it is known."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    found["python"] = platform.python_version()
    commit = code_commit()
    return found if commit is None else found | {"commit": commit}


def code_commit() -> str | None:
    """The git commit of this code, `-dirty` if files differ from it; None outside of a checkout."""
    folder = pathlib.Path(__file__).parents[1]
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=10"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def device_name() -> str:
    """The device that JAX uses, such as `CPU, x86_64, 2 cores`."""
    device = jax.devices()[0]
    if device.platform != "cpu":
        return f"{device.device_kind} x {jax.device_count()}"
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count()
    return f"CPU, {platform.machine()}, {cores} core{'s' if cores > 1 else ''}"


def peak_memory_mb() -> float:
    """Most memory of the host that this process has held so far, in units of 10^6 bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def peak_device_memory_mb() -> float | None:
    """Likewise of the device's own memory; None where the device is the host."""
    stats = jax.devices()[0].memory_stats()
    return None if stats is None else stats["peak_bytes_in_use"] / 1e6
