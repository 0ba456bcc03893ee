"""Flags of the persistent compilation cache, which scripts keep by default."""

from __future__ import annotations

import pathlib

from absl import flags

from experiments import runtime

FLAGS = flags.FLAGS
flags.DEFINE_bool("compilation_cache", True, "Keep compiled programs for the next start.")
flags.DEFINE_string(
    "compilation_cache_dir",
    "",
    "Folder of compiled programs; by default $XDG_CACHE_HOME/bavs_jax/compiled, or the same in "
    "~/.cache.",
)


def start_cache() -> None:
    """Does what the flags say; must come before anything is compiled."""
    if FLAGS.compilation_cache:
        given, folder = FLAGS.compilation_cache_dir, runtime.cache_folder
        root = runtime.usable_cache(pathlib.Path(given)) if given else folder()
        if root is not None:
            runtime.use_compilation_cache(root if given else root / "compiled")


def as_flags() -> list[str]:
    """The same flags for another process."""
    given = FLAGS.compilation_cache_dir
    directory = [f"--compilation_cache_dir={given}"] if given else []
    return [f"--compilation_cache={FLAGS.compilation_cache}", *directory]
