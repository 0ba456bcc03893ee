"""The streams of randomness of a run: one key for each purpose, all of them from its seed.

`run_key` itself goes to `active.py`, which folds in the number of the round, 0, 1, ...; every other
purpose folds in a number of its own from the far end, so that no two ever draw the same.
"""

from __future__ import annotations

import jax

STREAMS = {
    "init": 2**31 - 1,  # the parameters before training
    "pictures": 2**31 - 2,  # uncertainty of a trained field: pictures, clean-up, exports
    "evaluation": 2**31 - 3,  # uncertainty models that are measured on the test views
    "surface": 2**31 - 4,  # points on a true surface and on a mesh
    "draws": 2**31 - 5,  # fields drawn from the posterior
    "photos": 2**31 - 6,  # curvature of all photos of a capture
    "places": 2**31 - 7,  # poses that are suggested
    "choice": 2**31 - 8,  # policies that choose among these
}


def run_key(seed: int) -> jax.Array:
    """The key from which all of a run's randomness comes."""
    return jax.random.key(seed)


def stream_key(seed: int, stream: str) -> jax.Array:
    """The key of one of `STREAMS` of a run."""
    return jax.random.fold_in(run_key(seed), STREAMS[stream])
