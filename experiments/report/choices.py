"""What was chosen in each round, from which candidates, and how each choice stood among them."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Choice:
    """One chosen view as it looked when it was chosen."""

    view_id: int
    name: str
    score: float | None  # None: the policy gave none
    rank: int | None  # 1 is the highest score of the round
    num_scored: int
    rank_left: int | None  # the same among those that the distance filter left
    num_left: int
    distance: float  # to the nearest training view, scene units


@dataclasses.dataclass(frozen=True)
class Round:
    """One round of choosing; view ids are rows of `positions`."""

    number: int  # from 1, as round 0 only trains on the initial views
    training: np.ndarray  # [I + ...] views held before
    candidates: np.ndarray  # [C] views that could have been chosen
    survives: np.ndarray  # [C] bool, passed the distance filter
    scores: np.ndarray  # [C], NaN where not scored
    selected: np.ndarray  # [K]
    choices: tuple[Choice, ...]


def make_rounds(acquisition: dict[str, np.ndarray]) -> list[Round]:
    """Replays the rounds of one run."""
    training = np.asarray(acquisition["initial"], int)
    pool = np.asarray(acquisition["pool"], int)
    rounds = []
    for i, selected in enumerate(np.asarray(acquisition["selected"], int)):
        selected = selected[selected >= 0]  # -1 fills a round that chose fewer
        candidates = np.setdiff1d(pool, training)
        scores = np.asarray(acquisition["scores"][i], float)
        rounds.append(
            Round(
                number=i + 1,
                training=training,
                candidates=candidates,
                survives=np.asarray(acquisition["survivors"][i], bool)[candidates],
                scores=scores[candidates],
                selected=selected,
                choices=_choices(acquisition, i, candidates, training),
            )
        )
        training = np.concatenate([training, selected])
    return rounds


def _choices(acquisition, index, candidates, training) -> tuple[Choice, ...]:
    positions = np.asarray(acquisition["positions"], float)
    scores = np.asarray(acquisition["scores"][index], float)
    survives = np.asarray(acquisition["survivors"][index], bool)
    selected = np.asarray(acquisition["selected"][index], int)
    known = scores[candidates][np.isfinite(scores[candidates])]
    left = scores[candidates][np.isfinite(scores[candidates]) & survives[candidates]]
    names = acquisition.get("names")
    choices = []
    for view in selected[selected >= 0]:
        has_score = bool(np.isfinite(scores[view]))
        distances = np.linalg.norm(positions[training] - positions[view], axis=-1)
        choices.append(
            Choice(
                view_id=int(view),
                name=f"view {view}" if names is None else str(names[view]),
                score=float(scores[view]) if has_score else None,
                rank=int((known > scores[view]).sum()) + 1 if has_score else None,
                num_scored=known.size,
                rank_left=int((left > scores[view]).sum()) + 1 if has_score else None,
                num_left=left.size,
                distance=float(distances.min()) if distances.size else float("nan"),
            )
        )
    return tuple(choices)


def bound_words(bound: dict) -> str:
    """How far a batch can be from the best one, such as `gains 40 of at most 50 nats (80 %)`."""
    return (
        f"the batch gains {bound['gain']:.4g} nats, and no batch of its size more than "
        f"{bound['bound']:.4g} ({bound['ratio']:.0%} of that)"
    )
