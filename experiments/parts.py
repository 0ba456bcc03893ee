"""The parts of an experiment, each with a folder of its own: `bavs/seed_0`, `initial/seed_0`."""

from __future__ import annotations

import pathlib
from typing import NamedTuple

from bavs_jax.selection.policies import get_policy
from bavs_jax.uncertainty.model import RECONSTRUCTION
from experiments.errors import ConfigError
from experiments.files import read_arrays, read_json


class Part(NamedTuple):
    """A policy with a seed, or round 0 of a seed, which all policies of a field kind share."""

    policy: str | None  # None: round 0
    kind: str  # of the field that is trained
    seed: int

    @property
    def name(self) -> str:
        """Its folder in the working folder."""
        first = "initial" if self.kind == RECONSTRUCTION else f"initial_{self.kind}"
        return f"{self.policy or first}/seed_{self.seed}"

    @property
    def initial(self) -> Part:
        """The part that makes the round 0 it starts from."""
        return self._replace(policy=None)


def all_parts(policies, seeds) -> list[Part]:
    """Every part of an experiment, round 0 before what starts from it, seed by seed.

    Raises:
      SelectionError: a policy that does not exist.
    """
    parts = [
        Part(policy, get_policy(policy).field_kind, seed) for seed in seeds for policy in policies
    ]
    return list(dict.fromkeys(p for part in parts for p in (part.initial, part)))


def find_part(name: str, parts: list[Part]) -> Part:
    """The part of that name; raises ConfigError with the known names if there is none."""
    known = {part.name: part for part in parts}
    if name not in known:
        raise ConfigError(f"--part: {name!r} is not part of this config; use one of {(*known,)}")
    return known[name]


def is_finished(workdir: pathlib.Path, part: Part) -> bool:
    """Whether all files of a part are written, and none is damaged."""
    folder = workdir / part.name
    if part.policy is None:
        return read_json(folder / "round_0.json") is not None
    pictures = folder / "pictures.npz"  # of the first seed only
    return (
        is_completed(read_json(folder / "result.json"))
        and read_json(folder / "next_views" / "transforms.json") is not None
        and read_arrays(folder / "acquisition.npz") is not None
        and (not pictures.exists() or read_arrays(pictures) is not None)
    )


def is_completed(result: dict | None) -> bool:
    """Whether a result file is there, and of a run that has come to its end."""
    return result is not None and bool(result.get("completed"))
