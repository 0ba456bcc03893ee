"""Checkpoints of a run: written atomically, at most a few kept, readable after a kill."""

from __future__ import annotations

import pathlib

import jax
import numpy as np
import orbax.checkpoint as ocp


class Checkpoints:
    """The checkpoints of one run in one folder.

    A checkpoint is a pytree of arrays and a JSON-like dict. Each is written to a temporary folder
    that is renamed when complete, so a kill leaves the last whole one.
    """

    def __init__(self, folder: str | pathlib.Path, *, keep: int = 2):
        self._manager = ocp.CheckpointManager(
            pathlib.Path(folder).absolute(),
            options=ocp.CheckpointManagerOptions(
                max_to_keep=keep, create=True, enable_async_checkpointing=False
            ),
        )

    def latest(self) -> int | None:
        """Number of the newest checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, number: int, state, meta: dict) -> None:
        """Writes a checkpoint; an older one of the same number is replaced."""
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

    def restore(self, template) -> tuple:
        """The newest checkpoint as `(state, meta)`; `template` gives structure, shape and dtype.

        Raises:
          FileNotFoundError: if there is none.
        """
        number = self.latest()
        if number is None:
            raise FileNotFoundError(f"{self._manager.directory}: holds no checkpoint")
        restored = self._manager.restore(
            number,
            args=ocp.args.Composite(
                state=ocp.args.StandardRestore(jax.tree.map(np.asarray, template)),
                meta=ocp.args.JsonRestore(),
            ),
        )
        return jax.tree.map(jax.numpy.asarray, restored["state"]), restored["meta"]

    def close(self) -> None:
        """Ends the manager's threads."""
        self._manager.close()
