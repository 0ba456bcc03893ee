"""Result files, read and checked: the runs of a folder, their pictures, and what they chose."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.files import cut_pictures, load_arrays, read_versioned
from experiments.runtime import ReportError

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

    def value(self, measure: str, num_views: int | None) -> float | None:
        """A measure at the last round with so many views; None if not measured or not finite."""
        values = [r.get(measure) for r in self.rounds if r["num_views"] == num_views]
        if not values or values[-1] is None or not np.isfinite(values[-1]):
            return None
        return float(values[-1])

    @property
    def label(self) -> str:
        return f"{self.policy}, seed {self.seed}"


def read_result(path: Path, version: int = SCHEMA_VERSION, made_by: str = "experiment") -> dict:
    """The content of a script's result file; ReportError if it cannot be used."""
    absent, fix = f"give the --workdir of an {made_by}", f"run the {made_by} again"
    return read_versioned(path, version, error=ReportError, absent=absent, fix=fix)


def load_runs(workdir: Path, policies: Sequence[str] = ()) -> list[Run]:
    """The runs of `summary.json`, policy by policy: of all, or of some in the order given.

    Raises ReportError for a file of no use or of several scenes, or a policy without a run.
    """
    path, runs = workdir / "summary.json", []
    for result in read_result(path)["runs"]:
        if missing := [key for key in RUN_KEYS if key not in result]:
            raise ReportError(f"{path}: a run lacks {', '.join(missing)}; run the experiment again")
        policy, seed = result["policy"], int(result["seed"])
        folder = workdir / policy / f"seed_{seed}"
        runs.append(Run(policy, seed, result["completed"], result["rounds"], result, folder))
    scenes = sorted({run.result["scene"]["name"] for run in runs})
    if len(scenes) > 1:
        raise ReportError(f"{path}: scene differs ({', '.join(scenes)}); use one workdir per scene")
    known = policies_of(runs)
    for policy in policies:
        if policy not in known:
            raise ReportError(f"{workdir}: no run of {policy}; there are {', '.join(known)}")
    return [run for policy in policies or known for run in runs if run.policy == policy]


def policies_of(runs: list[Run]) -> list[str]:
    """Each policy once, in the order of the runs."""
    return list(dict.fromkeys(run.policy for run in runs))


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


def bound_words(bound: dict) -> str:
    """How far a batch can be from the best one, such as `gains 40 of at most 50 nats (80 %)`."""
    return (
        f"the batch gains {bound['gain']:.4g} nats, and no batch of its size more than "
        f"{bound['bound']:.4g} ({bound['ratio']:.0%} of that)"
    )
