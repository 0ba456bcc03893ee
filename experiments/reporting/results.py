"""Result files, read and checked: the runs of a folder, their pictures, and what they chose."""

from __future__ import annotations

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

    def value(self, measure: str, num_views: int) -> float | None:
        """A measure at the last round with so many views; None if not measured or not finite."""
        values = [r.get(measure) for r in self.rounds if r["num_views"] == num_views]
        if not values or values[-1] is None or not np.isfinite(values[-1]):
            return None
        return float(values[-1])

    @property
    def label(self) -> str:
        return f"{self.policy}, seed {self.seed}"


def read_result(path: Path, version: int = SCHEMA_VERSION, made_by: str = "experiment") -> dict:
    """The content of a script's result file.

    Raises:
      ReportError: the file is missing, broken or of another version.
    """
    return read_versioned(
        path,
        version,
        error=ReportError,
        absent=f"give the --workdir of an {made_by}",
        fix=f"run the {made_by} again",
    )


def load_runs(workdir: Path, policies: Sequence[str] = ()) -> list[Run]:
    """The runs of `summary.json`: all in its order, or those of some policies in their order.

    Raises:
      ReportError: the file is missing or broken, or holds runs of more than one scene; or a policy
        has no run.
    """
    path = workdir / "summary.json"
    runs = [_load_run(result, path) for result in read_result(path)["runs"]]
    scenes = sorted({run.result["scene"]["name"] for run in runs})
    if len(scenes) > 1:
        raise ReportError(f"{path}: scene differs ({', '.join(scenes)}); use one workdir per scene")
    known = policies_of(runs)
    for policy in policies:
        if policy not in known:
            raise ReportError(f"{workdir}: no run of {policy}; there are {', '.join(known)}")
    return [run for policy in policies for run in runs if run.policy == policy] or runs


def policies_of(runs: list[Run]) -> list[str]:
    """Each policy once, in the order of the runs."""
    return list(dict.fromkeys(run.policy for run in runs))


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


# --- what was chosen ---


@dataclasses.dataclass(frozen=True)
class Round:
    """One round of choosing; view ids are rows of `positions`."""

    number: int  # from 1, as round 0 only trains on the initial views
    candidates: np.ndarray  # [C] views that could have been chosen
    survives: np.ndarray  # [C] bool, passed the distance filter
    scores: np.ndarray  # [C], NaN where not scored
    selected: np.ndarray  # [K] views, as the next three
    names: list[str]
    selected_scores: np.ndarray  # NaN where not scored
    distances: np.ndarray  # to the nearest training view, scene units

    @property
    def is_scored(self) -> bool:
        """Whether the policy gave any chosen view a score."""
        return bool(np.isfinite(self.selected_scores).any())


def make_rounds(acquisition: dict[str, np.ndarray]) -> list[Round]:
    """Replays the rounds of one run from its `acquisition.npz`."""
    positions = np.asarray(acquisition["positions"], float)
    names = acquisition.get("names", [f"view {view}" for view in range(len(positions))])
    training, rounds = np.asarray(acquisition["initial"], int), []
    for i, selected in enumerate(np.asarray(acquisition["selected"], int)):
        selected = selected[selected >= 0]  # -1 fills a round that chose fewer
        candidates = np.setdiff1d(np.asarray(acquisition["pool"], int), training)
        scores = np.asarray(acquisition["scores"][i], float)
        gaps = np.linalg.norm(positions[selected][:, None] - positions[training], axis=-1)
        rounds.append(
            Round(
                number=i + 1,
                candidates=candidates,
                survives=np.asarray(acquisition["survivors"][i], bool)[candidates],
                scores=scores[candidates],
                selected=selected,
                names=[str(names[view]) for view in selected],
                selected_scores=scores[selected],
                distances=gaps.min(-1) if training.size else np.full(len(selected), np.nan),
            )
        )
        training = np.concatenate([training, selected])
    return rounds


def bound_words(bound: dict) -> str:
    """How far a batch can be from the best one, such as `gains 40 of at most 50 nats (80 %)`."""
    return (
        f"the batch gains {bound['gain']:.4g} nats, and no batch of its size more than "
        f"{bound['bound']:.4g} ({bound['ratio']:.0%} of that)"
    )
