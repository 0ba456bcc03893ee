"""Start-up of a script: compilation cache, where files are kept, one-line errors."""

from __future__ import annotations

import math
import os
import pathlib
import sys
import threading
from collections.abc import Callable

import jax
from absl import app, flags, logging

from experiments.errors import ConfigError, one_line, shown


def cache_folder() -> pathlib.Path:
    """Where scenes and compiled programs are kept: `$XDG_CACHE_HOME` or `~/.cache`."""
    root = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(root) / "bavs_jax"


def use_compilation_cache(folder: pathlib.Path | None) -> None:
    """Keeps compiled programs for the next start; None switches that off."""
    if folder is None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


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
    """Runs a script's `main()` after reading its flags; wrong ones end in one line."""

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
        try:
            main()
        except ConfigError as error:
            sys.exit(f"error: {error}")

    app.run(without_arguments, flags_parser=parse)
