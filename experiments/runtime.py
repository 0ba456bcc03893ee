"""Start-up of a script: compilation cache, where files are kept, one-line errors."""

from __future__ import annotations

import functools
import math
import os
import pathlib
import sys
import tempfile
import threading
from collections.abc import Callable

import jax
from absl import app, flags, logging

from bavs_jax.scenes.base import printable
from experiments import signals
from experiments.errors import USER_ERRORS, ConfigError, one_line, shown


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
    text = flags.FLAGS[flag].value
    if not text:
        raise ConfigError(f"--{flag}: is missing; name {hint}")
    path, why = pathlib.Path(text), None
    try:
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
    for name, value in flags.FLAGS.flag_values_dict().items():
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"--{name}: is {value}; give a finite number")


def run_script(main: Callable[[], None]) -> None:
    """Runs a script's `main()` after reading its flags; what goes wrong ends in one line.

    So do ctrl-C and SIGTERM, with the exit codes that shells give for them.
    """

    def parse(argv):
        try:
            left = flags.FLAGS(argv)
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
