"""The folder of an experiment: its config, its summary, and what it exports."""

from __future__ import annotations

import json
import pathlib

from experiments.errors import WorkdirError
from experiments.files import write_atomic, write_json

SUMMARY_VERSION = 1
# What may differ when a folder is taken up again: more policies or seeds add runs.
EXTENSIBLE = (
    *("policies", "seeds", "checkpoint_seconds", "data_dir", "num_pictures"),
    *("evaluation.models", "evaluation.variant", "predict_gain"),
)


def claim(workdir: pathlib.Path, config) -> None:
    """Writes `config.json`, or checks that an earlier run of this folder had the same config.

    Raises:
      WorkdirError: the folder holds a run of another config.
    """
    path = workdir / "config.json"
    values = json.loads(json.dumps(config.to_dict()))
    if path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        for field in sorted(_leaves(before).items() ^ _leaves(values).items()):
            if field[0] not in EXTENSIBLE:
                raise WorkdirError(
                    f"{path}: {field[0]}: differs from the run that is there; "
                    "use another --workdir or the same config"
                )
    write_json(path, values)


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
    paths = sorted(workdir.glob("*/seed_*/result.json"), key=_run_order)
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    summary = {"schema_version": SUMMARY_VERSION, "runs": runs}
    write_json(workdir / "summary.json", summary)
    return summary


def _run_order(path: pathlib.Path):
    return path.parent.parent.name, int(path.parent.name.removeprefix("seed_"))


def export_next_views(workdir: pathlib.Path, policy: str, seed: int) -> pathlib.Path:
    """Copies one run's chosen poses to `next_views/transforms.json`."""
    source = workdir / policy / f"seed_{seed}" / "next_views" / "transforms.json"
    target = workdir / "next_views" / "transforms.json"
    write_atomic(target, lambda file: file.write(source.read_bytes()))
    return target
