"""The files of a working folder, read and checked: `summary.json` and the arrays of each run."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.errors import ReportError
from experiments.files import load_arrays, read_versioned
from experiments.picture_stack import cut_pictures

SCHEMA_VERSION = 1
PICTURE_KEYS = ("view_ids", "names", "truth", "rgb", "error", "uncertainty", "round")
ACQUISITION_KEYS = (
    *("positions", "up", "centre", "pool"),
    *("scores", "survivors", "selected", "initial"),
)
RUN_KEYS = ("scene", "policy", "seed", "rounds", "completed")


@dataclasses.dataclass(frozen=True)
class Run:
    """One policy with one seed."""

    policy: str
    seed: int
    completed: bool
    rounds: list[dict]  # as in result.json, round 0 first
    result: dict  # the whole of result.json
    folder: Path  # where its pictures.npz and acquisition.npz are, if it has them

    def value(self, measure: str, num_views: int) -> float | None:
        """A measure at the last round with so many views; None if not measured or not finite."""
        values = [r.get(measure) for r in self.rounds if r["num_views"] == num_views]
        if not values or values[-1] is None or not np.isfinite(values[-1]):
            return None
        return float(values[-1])

    @property
    def label(self) -> str:
        return f"{self.policy}, seed {self.seed}"


def read_result(path: Path) -> dict:
    """The content of a script's result file.

    Raises:
      ReportError: the file is missing, broken or of another version.
    """
    return read_versioned(
        path,
        SCHEMA_VERSION,
        error=ReportError,
        absent="give the --workdir of an experiment",
        fix="run the experiment again",
    )


def load_runs(workdir: Path) -> list[Run]:
    """All runs of `summary.json`, in its order.

    Raises:
      ReportError: the file is missing or broken, or holds runs of more than one scene.
    """
    path = workdir / "summary.json"
    summary = read_result(path)
    runs = [_load_run(result, path) for result in summary["runs"]]
    scenes = sorted({run.result["scene"]["name"] for run in runs})
    if len(scenes) > 1:
        raise ReportError(f"{path}: scene differs ({', '.join(scenes)}); use one workdir per scene")
    return runs


def load_runs_of(workdir: Path, policies: Sequence[str]) -> list[Run]:
    """The runs of some policies, in the order of these; of all where none is named.

    Raises:
      ReportError: see `load_runs`; or a policy has no run.
    """
    runs = load_runs(workdir)
    known = dict.fromkeys(run.policy for run in runs)
    for policy in policies:
        if policy not in known:
            raise ReportError(f"{workdir}: no run of {policy}; there are {', '.join(known)}")
    return [run for policy in policies or known for run in runs if run.policy == policy]


def _load_run(result: dict, path: Path) -> Run:
    missing = [key for key in RUN_KEYS if key not in result]
    if missing:
        raise ReportError(f"{path}: a run lacks {', '.join(missing)}; run the experiment again")
    return Run(
        policy=result["policy"],
        seed=int(result["seed"]),
        completed=bool(result["completed"]),
        rounds=result["rounds"],
        result=result,
        folder=path.parent / result["policy"] / f"seed_{result['seed']}",
    )


def load_pictures(run: Run) -> dict[str, np.ndarray] | None:
    """Test images of a run, each at its own size, or None if it has none (yet)."""
    arrays = _load_arrays(run.folder / "pictures.npz", PICTURE_KEYS)
    return None if arrays is None else cut_pictures(arrays)


def load_acquisition(run: Run) -> dict[str, np.ndarray] | None:
    """Cameras, scores and choices of a run, or None if it has none (yet)."""
    return _load_arrays(run.folder / "acquisition.npz", ACQUISITION_KEYS)


def _load_arrays(path: Path, keys: tuple[str, ...]) -> dict[str, np.ndarray] | None:
    try:
        return load_arrays(path, *keys)
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ReportError(f"{error}; run the experiment again, which makes it anew") from error
