"""What the process of a script needs: flags, caches, one-line errors, and what it runs on."""

from __future__ import annotations

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
import threading
from collections.abc import Callable

import jax
from absl import app, flags, logging

from bavs_jax.scenes.base import printable
from experiments import signals
from experiments.errors import USER_ERRORS, ConfigError, one_line, shown

PACKAGES = ("bavs_jax", "jax", "jaxlib", "flax", "optax", "numpy")
FLAGS = flags.FLAGS
flags.disclaim_key_flags()  # flags that are defined here are those of the module that asks for them

# --- caches ----------------------------------------------------------------------------------


def cache_folder() -> pathlib.Path | None:
    """Where scenes and compiled programs are kept: in `$XDG_CACHE_HOME` or `~/.cache`.

    None, after a warning, where nothing can be.
    """
    root = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        return usable_cache(pathlib.Path(root).expanduser() / "bavs_jax")
    except RuntimeError as error:  # nobody's home
        warn(f"{root}: {error}: goes on without a cache; set XDG_CACHE_HOME to have one")
        return None


def usable_cache(folder: pathlib.Path) -> pathlib.Path | None:
    """The folder, made if it is not there; None, after a warning, if nothing can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
    except (OSError, ValueError) as error:  # or a name that no folder can have
        why = getattr(error, "strerror", None) or error
        warn(f"{printable(str(folder))}: cannot be used ({why}): goes on without a cache there")
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
    flags.DEFINE_string(
        "compilation_cache_dir",
        "",
        "Folder of compiled programs; by default $XDG_CACHE_HOME/bavs_jax/compiled, or the same in "
        "~/.cache.",
    )


def start_cache() -> None:
    """Does what the flags of the cache say; must come before anything is compiled."""
    if FLAGS.compilation_cache:
        given = FLAGS.compilation_cache_dir
        root = usable_cache(pathlib.Path(given)) if given else cache_folder()
        if root is not None:
            use_compilation_cache(root if given else root / "compiled")


def cache_flags() -> list[str]:
    """The flags of the cache for another process."""
    given = FLAGS.compilation_cache_dir
    directory = [f"--compilation_cache_dir={given}"] if given else []
    return [f"--compilation_cache={FLAGS.compilation_cache}", *directory]


# --- a script's start and end ----------------------------------------------------------------


@functools.cache
def warn(text: str) -> None:
    """A line on standard error, for what goes on all the same; said once."""
    print(f"warning: {text}", file=sys.stderr, flush=True)


def command_line() -> str:
    """The command as a user would type it."""
    module = sys.modules["__main__"].__spec__
    name = f"python -m {module.name}" if module else f"python {sys.argv[0]}"
    return " ".join([name, *sys.argv[1:]])


def end_with_parent() -> None:
    """Ends this process as soon as its standard input is closed.

    A program that starts this one through a pipe need do nothing more to take it along when it
    is killed; what is lost is what a kill of this process loses.
    """

    def watch():
        while os.read(sys.stdin.fileno(), 1024):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def given_folder(flag: str, hint: str, *, exists: bool = False) -> pathlib.Path:
    """The folder that a flag names, which can be made or, if it `exists` already, read.

    Raises:
      ConfigError: there is no name, or none of a folder that can be used.
    """
    text = FLAGS[flag].value
    if not text:
        raise ConfigError(f"--{flag}: is missing; name {hint}")
    path, why = pathlib.Path(text), None
    try:
        if "\0" in text:  # `Path.exists` says no more than that there is none
            raise ValueError("embedded null byte")
        found = path if exists else next(p for p in (path, *path.parents) if p.exists())
        if not found.is_dir():
            why = f"{shown(str(found))} " + ("is no folder" if found.exists() else "does not exist")
    except (OSError, ValueError) as error:  # a name that no file can have
        why = f"{shown(text)} cannot be used ({error})"
    if why:
        raise ConfigError(f"--{flag}: {why}; name {hint}")
    if not os.access(found, os.R_OK | os.X_OK if exists else os.W_OK | os.X_OK):
        raise ConfigError(f"--{flag}: {found}: no permission; name {hint}")
    return path


def check_finite() -> None:
    """Raises ConfigError for a flag whose number is not finite, which no bounds of a flag catch."""
    for name, value in FLAGS.flag_values_dict().items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"--{name}: is {value}; give a finite number")


def run_script(main: Callable[[], None]) -> None:
    """Runs a script's `main()` after reading its flags; what goes wrong ends in one line.

    So do ctrl-C and SIGTERM, with the exit codes that shells give for them.
    """

    def parse(argv):
        try:
            left = FLAGS(argv)
            check_finite()
            return left
        except flags.Error as error:
            sys.exit(f"error: {one_line(error)}; --help explains every flag")
        except ConfigError as error:
            sys.exit(f"error: {error}")
        except Exception as error:  # a config file is a program: it can raise anything
            sys.exit(
                "error: --config: no such option or file, or a value of another type: "
                f"{one_line(error)}"
            )

    def without_arguments(argv):
        if len(argv) > 1:
            sys.exit(f"error: unknown argument {argv[1]!r}; options are given as --name=value")
        # Checkpoint libraries report every write at INFO; warnings and errors still show.
        logging.set_verbosity(logging.WARNING)
        signals.interrupt_work()
        try:
            main()
        except BaseException as error:
            # Libraries may make another error of the interrupt.
            if number := signals.received():
                signals.end(number)
            if isinstance(error, (*USER_ERRORS, OSError)):
                sys.exit(f"error: {' '.join(str(error).split())}")
            raise

    app.run(without_arguments, flags_parser=parse)


# --- what a result was made on ---------------------------------------------------------------


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
