"""`sweep.json`: what a sweep is made of, and what of it is missing and why."""

from __future__ import annotations

import dataclasses
import pathlib
from typing import Any

from experiments.errors import WorkdirError
from experiments.files import read_versioned, write_json

SCHEMA_VERSION = 1
FILE = "sweep.json"


@dataclasses.dataclass
class Record:
    """A sweep as its file tells it."""

    command: str
    settings: list[dict[str, Any]]  # each: folder, values, policies, seeds
    failed: dict[str, str]  # by folder/policy/seed_n: why, and where its log is

    def missing(self, folder: str, results: set[tuple[str, int]]) -> dict[tuple[str, int], str]:
        """Why a setting's runs that have no completed result have none, by policy and seed."""
        setting = next(s for s in self.settings if s["folder"] == folder)
        planned = [(p, s) for p in setting["policies"] for s in setting["seeds"]]
        return {
            (policy, seed): self.failed.get(f"{folder}/{policy}/seed_{seed}", "not run yet")
            for policy, seed in planned
            if (policy, seed) not in results
        }


def read_record(workdir: pathlib.Path) -> Record | None:
    """The record of a sweep's folder; None where there is none.

    Raises:
      WorkdirError: the file is broken or of another version.
    """
    path = workdir / FILE
    if not path.exists():
        return None
    fix = "delete it and run the sweep again"
    content = read_versioned(path, SCHEMA_VERSION, error=WorkdirError, absent=fix, fix=fix)
    return Record(content["command"], content["settings"], content["failed"])


def write_record(workdir: pathlib.Path, record: Record) -> None:
    """Writes the file."""
    write_json(workdir / FILE, {"schema_version": SCHEMA_VERSION} | dataclasses.asdict(record))


def merged(before: Record | None, now: Record) -> Record:
    """A sweep taken up again: what it had before stays, with more settings, policies or seeds."""
    if before is None:
        return now
    old = {setting["folder"]: setting for setting in before.settings}
    settings = []
    for setting in now.settings:
        other = old.pop(setting["folder"], setting)
        more = {key: _union(setting[key], other[key]) for key in ("policies", "seeds")}
        settings.append(setting | more)
    return Record(now.command, settings + list(old.values()), now.failed | before.failed)


def _union(first: list, second: list) -> list:
    return list(dict.fromkeys([*first, *second]))
