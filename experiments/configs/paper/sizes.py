"""The two sizes of each table and figure."""

from __future__ import annotations

from ml_collections import ConfigDict


def of_size(size: str, *, laptop: ConfigDict, paper: ConfigDict) -> ConfigDict:
    """The config of a size, named after the colon of `--config=table_1.py:paper`.

    Raises:
      ValueError: there is no such size.
    """
    sizes = {"laptop": laptop, "paper": paper}
    if size not in sizes:
        raise ValueError(f"size {size!r}: use one of {', '.join(sizes)}")
    return sizes[size]
