"""What the page says about a suggestion: sentences and the table of poses."""

from __future__ import annotations

import math

import numpy as np

from bavs_jax.placement.collect import Proposals
from bavs_jax.selection.worth import Worth
from experiments.reporting.tables import Cell, Table, dash
from experiments.suggest.choosing import Suggestion
from experiments.suggest.facts import length
from experiments.suggest.places import Surroundings

MANY_IN_MATTER = 0.1  # share of the photos inside of "matter" from which the page warns


def worth_sentence(worth: Worth, photo_gain: float) -> str:
    """How much is left to gain, so that the user can judge when to stop.

    Args:
      worth: along the picks, nats.
      photo_gain: of one more photo from where there is one already, nats.
    """
    num, first, left = len(worth.picked), worth.best_left[0], worth.best_left[-1]
    if math.isnan(left):
        return f"No candidate is left after these {num}: draw more to see what else there is."
    words = (
        f"After {'this pose' if num == 1 else f'these {num}'}, the best candidate left would tell "
        f"{left / first:.0%} of what the best would have told before ({first:.3g} nats)"
    )
    if first <= photo_gain:
        return words + (
            f"; but even that is no more than another photo from where there is one already would "
            f"tell ({photo_gain:.3g} nats): the candidates hardly show anything new."
        )
    words += f"; another photo from where there is one already would tell {photo_gain / first:.0%}."
    excess = max(left - photo_gain, 0.0) / (first - photo_gain)
    if excess >= 0.5:
        return words + " Further views are still worth taking."
    if excess >= 0.2:
        return words + " Further views gain less and less."
    return words + " There is little left to gain: this is a good place to stop."


def headline(scene, suggestion: Suggestion, proposals: Proposals) -> str:
    """What the page says first."""
    num, total = len(suggestion.selected), len(proposals.poses)
    poses = "pose" if num == 1 else "poses"
    return (
        f"The {num} {poses} to photograph next, chosen from {total} free places around "
        f"{scene.num_views} photos."
    )


def warnings(scene, around: Surroundings, facts, foggy: int) -> list[str]:
    """What the user should know before going there."""
    found = []
    if foggy > MANY_IN_MATTER * scene.num_views:
        found.append(
            f"{foggy} of {scene.num_views} photos stand in what the field takes for matter: it has "
            "fog in front of the cameras, so free places are turned away too. Train longer "
            "(--train_steps)."
        )
    unseen = sum(f.num_seeing == 0 for f in facts)
    if unseen:
        found.append(
            f"{unseen} of {len(facts)} poses stand where no photo looks. What the field says of "
            "such places is a guess: make sure that they are free before you send a robot there."
        )
    if not around.faces_focus:
        found.append(
            "The photos look outwards, so that they have no common point in front of them: shell "
            "candidates look where the photos near them look."
        )
    return found


def candidate_words(options, proposals, suggestion, around: Surroundings) -> str:
    """How candidates came about and how many were left."""
    words = (
        f"Candidates ({options.candidates}): {proposals.in_words()}. Matter: half of the light "
        f"lost within {length(np.log(2.0) / around.solid_density * around.unit)}; clearance "
        f"{length(around.clearance * around.unit)}."
    )
    if suggestion.info.filter is not None:
        words += (
            f" The distance filter of {options.policy!r} left "
            f"{int(suggestion.info.survivors.sum())}, at least "
            f"{length(float(suggestion.info.filter.radii.min_train_distance) * around.unit)} from "
            "every photo and from each other."
        )
    return words


def place_words(pose: np.ndarray) -> str:
    """A pose as text."""
    place = ", ".join(f"{x:.3f}" for x in pose[:3, 3])
    look = ", ".join(f"{x:.2f}" for x in -pose[:3, 2])
    return f"at ({place}), looks along ({look})"


def numbers(rows, poses, facts) -> Table:
    """The table of all poses."""
    head = ("no.", "picked", "x", "y", "z", "score", "information, of the best", "high pixels")
    head += ("nearest photo", "photos that see the place")
    lines = []
    for row, pose, fact in zip(rows, poses, facts):
        share = row["share_of_best"]
        texts = [str(row["order"]), str(row["picked"]), *(f"{x:.3f}" for x in pose[:3, 3])]
        cells = [Cell(text) for text in (*texts, f"{row['score']:.3f}")]
        cells.append(dash("no candidate would tell anything") if share is None else _share(share))
        cells += [_share(fact.share_high), Cell(f"{fact.nearest_distance:.3g}")]
        lines.append((*cells, Cell(str(fact.num_seeing))))
    return Table(head, tuple(lines))


def _share(value: float) -> Cell:
    return Cell(f"{value:.0%}")


def details(problem, options, around: Surroundings, quality, foggy, seconds) -> list[tuple]:
    """How it was made, as pairs of name and value."""
    scene = problem.scene
    width, height = np.asarray(scene.cameras.sizes).max(axis=0)
    measured = "not measured: no photo was left out (--holdout)"
    if quality is not None:
        measured = (
            f"PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f} on "
            f"{quality['num_test_views']} photos left out"
        )
    focus = ", ".join(f"{x:.3f}" for x in around.to_user(around.focus))
    return [
        ("photos", f"{len(scene.pool)} to train on, at most {width} x {height} pixels"),
        ("field", measured),
        ("policy", options.policy),
        ("focus", f"({focus}), {length(around.distance * around.unit)} from the photos (median)"),
        ("photos inside of matter", f"{foggy} of {scene.num_views}"),
        ("time", f"{seconds:.0f} s"),
    ]
