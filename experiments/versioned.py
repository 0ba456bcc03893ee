"""Result files as JSON with a version: read and checked in one place."""

from __future__ import annotations

import json
import os
import pathlib


def read_versioned(
    path: str | os.PathLike, version: int, *, error: type[Exception], absent: str, fix: str
) -> dict:
    """The content of a JSON object whose `schema_version` this program knows.

    Args:
      path: of the file.
      version: that it must have.
      error: what to raise.
      absent: what to do where there is no file, in the imperative.
      fix: what to do where it is broken or of another version.

    Raises:
      error: one line that names the file, the field and the fix.
    """
    try:
        content = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise error(f"{path}: no such file; {absent}") from None
    except ValueError as problem:  # not JSON, or not text
        raise error(f"{path}: not JSON ({problem}); {fix}") from None
    if not isinstance(content, dict):
        raise error(f"{path}: not a JSON object; {fix}")
    found = content.get("schema_version")
    if found != version:
        raise error(f"{path}: schema_version is {found}, this program reads {version}; {fix}")
    return content
