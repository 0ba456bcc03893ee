"""How work in pieces tells how far it is; who calls it chooses what is shown of that."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import jax
import numpy as np

Progress = Callable[[int], None]  # is told how many more things are done since its last call


class Bar(Protocol):
    """The progress of one piece of work."""

    def advance(self, num: int, /) -> None:
        """`num` more things are done, since the last call."""


class Track(Protocol):
    """Opens a bar, and closes it when the work is over: `total` things will be done; `label` says
    what for, `unit` what they are, in plural."""

    def __call__(self, total: int, label: str, unit: str, /) -> AbstractContextManager[Bar]: ...


def map_chunks(
    fn: Callable[[np.ndarray], Any], num: int, chunk: int, progress_fn: Progress | None = None
) -> Any:
    """Joins what `fn` gives of the rows 0 .. num - 1, num > 0, `chunk` of them at a time.

    `fn(rows [chunk])` gives a pytree of [chunk, ...], and this one of [num, ...] on the host; the
    last rows are filled up with copies of the last one, so that it is compiled once.
    """
    parts = []
    for start in range(0, num, chunk):
        count = min(chunk, num - start)
        found = fn(np.minimum(np.arange(start, start + chunk), num - 1))
        parts.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], found))
        if progress_fn is not None:
            progress_fn(count)
    return jax.tree.map(lambda *pieces: np.concatenate(pieces), *parts)
