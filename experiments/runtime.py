"""Start-up of a script: compilation cache, where files are kept, one-line errors."""

from __future__ import annotations

import os
import pathlib
import sys

import jax


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
