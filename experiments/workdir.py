"""The folder of an experiment: its parts, its config, its summary, and what it exports."""

from __future__ import annotations

import json
import pathlib
from typing import NamedTuple

from bavs_jax.selection.policies import get_policy
from bavs_jax.uncertainty.model import RECONSTRUCTION
from experiments.errors import ConfigError, WorkdirError
from experiments.files import read_arrays, read_json, write_atomic, write_json
from experiments.runtime import warn

SUMMARY_VERSION = 1
# What may differ when a folder is taken up again: more policies or seeds add runs.
EXTENSIBLE = (
    *("policies", "seeds", "checkpoint_seconds", "data_dir", "num_pictures"),
    *("evaluation.models", "evaluation.variant"),
)


# --- parts -----------------------------------------------------------------------------------


class Part(NamedTuple):
    """A policy with a seed, or round 0 of a seed, which all policies of a field kind share.

    Each has a folder of its own, such as `bavs/seed_0` and `initial/seed_0`.
    """

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


# --- the config and the results --------------------------------------------------------------


def check_claim(workdir: pathlib.Path, config) -> None:
    """Checks that what was made in a folder was made with the same config; writes nothing.

    Raises:
      WorkdirError: it holds a run of another config, or of one that cannot be read.
    """
    path = workdir / "config.json"
    if not path.exists() or not _holds_work(workdir):
        return
    before = read_json(path, otherwise="")
    if before is None:
        raise WorkdirError(
            f"{path}: damaged: delete it if the runs there are of this config, and start again; "
            "or use another --workdir"
        )
    for field in sorted(_leaves(before).items() ^ _leaves(_as_json(config)).items()):
        if field[0] not in EXTENSIBLE:
            raise WorkdirError(
                f"{path}: {field[0]}: differs from the run that is there; "
                "use another --workdir or the same config"
            )


def claim(workdir: pathlib.Path, config) -> None:
    """Makes a folder and its `config.json`; to be called when all else has been checked.

    Raises:
      WorkdirError: see `check_claim`.
    """
    check_claim(workdir, config)
    workdir.mkdir(parents=True, exist_ok=True)
    write_json(workdir / "config.json", _as_json(config))


def _as_json(config) -> dict:
    return json.loads(json.dumps(config.to_dict()))


def _holds_work(workdir: pathlib.Path) -> bool:
    """Whether anything is there that a config has made."""
    numbers = (path.name for path in workdir.glob("*/seed_*/checkpoints/*"))
    return any(map(str.isdigit, numbers)) or any(workdir.glob("*/seed_*/result.json"))


def _leaves(values: dict, prefix: str = "") -> dict[str, str]:
    """A nested dict as {"a.b": text}; lists count as leaves."""
    leaves = {}
    for name, value in values.items():
        if isinstance(value, dict):
            leaves |= _leaves(value, f"{prefix}{name}.")
        else:
            leaves[prefix + name] = json.dumps(value)
    return leaves


def collect(workdir: pathlib.Path) -> dict:
    """Collects all `<policy>/seed_<n>/result.json` into `summary.json`."""
    paths = []
    for path in workdir.glob("*/seed_*/result.json"):
        policy, seed = path.parts[-3], path.parts[-2].removeprefix("seed_")
        if seed.isdecimal():
            paths.append((policy, int(seed), path))
        else:
            warn(f"{path.parent}: not seed_<number>: left out of summary.json")
    results = [
        read_json(path, otherwise="left out of summary.json until its run is started again")
        for _, _, path in sorted(paths)
    ]
    summary = {"schema_version": SUMMARY_VERSION, "runs": [r for r in results if r is not None]}
    write_json(workdir / "summary.json", summary)
    return summary


def export_next_views(workdir: pathlib.Path, policy: str, seed: int) -> pathlib.Path:
    """Copies one run's chosen poses to `next_views/transforms.json`."""
    source = workdir / policy / f"seed_{seed}" / "next_views" / "transforms.json"
    target = workdir / "next_views" / "transforms.json"
    write_atomic(target, lambda file: file.write(source.read_bytes()))
    return target
