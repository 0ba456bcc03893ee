"""The folder of an experiment: its config, its summary, and what it exports."""

from __future__ import annotations

import json
import pathlib

from experiments.errors import WorkdirError
from experiments.files import read_json, write_atomic, write_json
from experiments.runtime import warn

SUMMARY_VERSION = 1
# What may differ when a folder is taken up again: more policies or seeds add runs.
EXTENSIBLE = (
    *("policies", "seeds", "checkpoint_seconds", "data_dir", "num_pictures"),
    *("evaluation.models", "evaluation.variant"),
)


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
