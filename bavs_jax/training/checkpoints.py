"""Checkpoints of a run: written atomically, at most a few kept, readable after a kill."""

import contextlib
import itertools
import logging
import pathlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator

import jax
import numpy as np
import orbax.checkpoint as ocp

from bavs_jax.scenes.texts import one_line

# What a checkpoint with damaged or missing files raises; no memory or no permission is none of it.
DAMAGE = (ValueError, LookupError, TypeError, FileNotFoundError, NotADirectoryError)
LONGEST_REASON = 200  # characters of an error in a message
STRAGGLE_SECONDS = 0.3  # in which reads that were under way beside a failed one end, and complain


class Checkpoints:
    """The checkpoints of one run in one folder.

    A checkpoint is a pytree of arrays and a JSON-like dict. Each is written to a temporary folder
    that is renamed when complete, so a kill leaves the last whole one. What is damaged in another
    way is renamed to `bad_<number>`, and the one before it counts.

    Args:
      folder: where they are.
      keep: how many.
      warn_fn: is given a line for each one that is set aside.
    """

    def __init__(
        self,
        folder: str | pathlib.Path,
        *,
        keep: int = 2,
        warn_fn: Callable[[str], None] = warnings.warn,
    ):
        self._folder, self._warn_fn = pathlib.Path(folder), warn_fn
        with _without_tracebacks():  # nor warnings of what a kill has left half deleted
            self._manager = ocp.CheckpointManager(
                self._folder.absolute(),
                options=ocp.CheckpointManagerOptions(
                    max_to_keep=keep, create=True, enable_async_checkpointing=False
                ),
            )

    def save(self, number: int, state, meta: dict) -> None:
        """Writes a checkpoint; an older one of the same number is replaced.

        Raises:
          OSError: it cannot be written, such as to a full disk; one line.
        """
        try:
            with _without_tracebacks():
                if number in self._manager.all_steps():
                    self._manager.delete(number)
                self._manager.save(
                    number,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardSave(jax.tree.map(np.asarray, state)),
                        meta=ocp.args.JsonSave(meta),
                    ),
                )
                self._manager.wait_until_finished()
        except (ValueError, OSError) as error:  # tensorstore has no error of its own
            reason = one_line(error, LONGEST_REASON)
            raise OSError(
                f"{self._folder}: checkpoint {number} cannot be written ({reason}): "
                "make room there, then start again"
            ) from error

    def restore(self, template) -> tuple | None:
        """The newest checkpoint that can be read as `(state, meta)`, or None if there is none.

        Those that cannot be read are set aside. `template` gives structure, shape and dtype.
        """
        for number in sorted(self._manager.all_steps(), reverse=True):
            with _without_tracebacks():
                try:
                    restored = self._manager.restore(
                        number,
                        args=ocp.args.Composite(
                            state=ocp.args.StandardRestore(jax.tree.map(np.asarray, template)),
                            meta=ocp.args.JsonRestore(),
                        ),
                    )
                except DAMAGE as error:
                    time.sleep(STRAGGLE_SECONDS)
                    self._set_aside(number, error)
                    continue
            return jax.tree.map(jax.numpy.asarray, restored["state"]), restored["meta"]
        return None

    def close(self) -> None:
        """Ends the manager's threads."""
        self._manager.close()

    def _set_aside(self, number: int, error: Exception) -> None:
        names = (f"bad_{number}{f'_{i}' if i > 1 else ''}" for i in itertools.count(1))
        target = next(p for p in map(self._folder.joinpath, names) if not p.exists())
        self._warn_fn(
            f"{self._folder / str(number)}: checkpoint is damaged "
            f"({one_line(error, LONGEST_REASON)}): set aside as {target.name}"
        )
        if jax.process_index() == 0:
            (self._folder / str(number)).rename(target)
        self._manager.reload()


@contextlib.contextmanager
def _without_tracebacks() -> Iterator[None]:
    """The threads of orbax print every error before it is raised here; in here they do not."""
    logger, hook = logging.getLogger("absl"), sys.unraisablehook
    before = logger.disabled
    logger.disabled, sys.unraisablehook = True, lambda unraisable: None
    try:
        yield
    finally:
        logger.disabled, sys.unraisablehook = before, hook
