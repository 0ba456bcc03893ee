"""Finds the n-th true entry of a row, for many rows and many n at once, by counting bits.

A running sum along the row and a binary search in it would say the same, one gather for each
halving; on words of 32 bits it is arithmetic along whole arrays, ten times as quick on a CPU.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

WORD = 32  # bits


class Hits(NamedTuple):
    """Rows of true and false, packed."""

    words: tuple[jax.Array, ...]  # each [R] uint32; the lowest bit is the first column
    before: tuple[jax.Array, ...]  # each [R] int32, true entries in all earlier words

    @property
    def total(self) -> jax.Array:
        """True entries of each row, [R] int32."""
        return self.before[-1] + _count(self.words[-1])


def _count(words: jax.Array) -> jax.Array:
    return jax.lax.population_count(words).astype(jnp.int32)


def pack_hits(hit: jax.Array) -> Hits:
    """Packs rows [R, C] of bool, any C."""
    num_rows, num_columns = hit.shape
    num_words = -(-num_columns // WORD)
    padded = jnp.pad(hit, ((0, 0), (0, num_words * WORD - num_columns)))
    bits = padded.reshape(num_rows, num_words, WORD).astype(jnp.uint32)
    packed = (bits << jnp.arange(WORD, dtype=jnp.uint32)).sum(-1, dtype=jnp.uint32)
    words = tuple(packed[:, i] for i in range(num_words))
    before = [jnp.zeros(num_rows, jnp.int32)]
    for word in words[:-1]:
        before.append(before[-1] + _count(word))
    return Hits(words, tuple(before))


def nth_hit(hits: Hits, index: jax.Array) -> jax.Array:
    """The column of the true entry that `index` others come before.

    Args:
      hits: of R rows.
      index: [R, S] int32 >= 0.

    Returns:
      [R, S] int32; where a row has no such entry, some column of its last word.
    """
    word, column, rest = (jnp.zeros(index.shape, dtype) for dtype in ("uint32", "int32", "int32"))
    for number, (bits, before) in enumerate(zip(hits.words, hits.before)):
        is_later = index >= before[:, None]
        word = jnp.where(is_later, bits[:, None], word)
        column = jnp.where(is_later, number * WORD, column)
        rest = jnp.where(is_later, index - before[:, None], rest)
    half = WORD // 2
    while half:  # is it in the lower half of what is left of the word, or in the upper one?
        in_lower = _count(word & jnp.uint32((1 << half) - 1))
        is_upper = rest >= in_lower
        word = jnp.where(is_upper, word >> half, word)
        column = jnp.where(is_upper, column + half, column)
        rest = jnp.where(is_upper, rest - in_lower, rest)
        half //= 2
    return column
