"""Streams of randomness: which there are, and that no two draw the same."""

import pathlib
import re

import jax
import numpy as np
import pytest

import experiments
from experiments.build import STREAMS, run_key, stream_key


def words(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def test_no_two_streams_rounds_or_seeds_share_a_key():
    found = [words(stream_key(seed, name)) for seed in range(3) for name in STREAMS]
    found += [words(run_key(seed)) for seed in range(3)]
    rounds = jax.vmap(jax.random.fold_in, (None, 0))
    found += [words(key) for seed in range(3) for key in rounds(run_key(seed), np.arange(100))]
    assert len(set(found)) == len(found) == 3 * (len(STREAMS) + 1 + 100)


@pytest.mark.parametrize("stream, back", [("init", 1), ("pictures", 2), ("evaluation", 3)])
def test_streams_of_published_runs_stay_what_they_were(stream, back):
    expected = jax.random.fold_in(jax.random.key(7), 2**31 - back)
    assert words(stream_key(7, stream)) == words(expected)


def test_scripts_take_their_keys_from_the_one_list():
    """A key of a script's own could be that of another purpose."""
    own_key = re.compile(r"random\.(key|PRNGKey)\(|2 ?\*\* ?31")
    files = {p: p.read_text() for p in pathlib.Path(experiments.__file__).parent.rglob("*.py")}
    assert [p.name for p, text in files.items() if own_key.search(text)] == ["build.py"]
    asked_for = re.findall(r'stream_key\([\w.]+, "(\w+)"\)', "".join(files.values()))
    assert set(asked_for) == set(STREAMS)
