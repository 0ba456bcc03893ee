"""The result in plain words."""

from __future__ import annotations

import dataclasses

from experiments.report import stats
from experiments.report.results import Run

REFERENCES = ("random", "farthest")  # what a policy must beat to be worth its time
MOST_COMPARED = 6  # policies that the headline names
SEED_SPREAD = (
    "One seed proves little: the spread between seeds is often half a dB, as large as most gains. "
    "Run at least 5 seeds before drawing a conclusion."
)


@dataclasses.dataclass(frozen=True)
class Headline:
    """What stands at the top of the page."""

    scene: str
    compared: str
    result: str
    verdict: str
    more: tuple[str, ...] = ()


def focus_policy(policies: list[str]) -> str | None:
    """The policy that the report is about: ours where it ran, otherwise the first."""
    ours = [p for p in policies if p == "bavs"] or [p for p in policies if p.startswith("bavs")]
    return (ours or policies or [None])[0]


def signed(value: float, digits: int = 2) -> str:
    """A gap with its sign, and a true minus."""
    return f"{value:+.{digits}f}".replace("-", "−")


def decibels(value: float, *, gap: bool = False) -> str:
    """A level, or a gap with its sign, that is never broken before its unit."""
    return f"{signed(value) if gap else f'{value:.2f}'}\u00a0dB"


def make_headline(runs: list[Run], policies: list[str]) -> Headline:
    """Says what was done and what came out, for better or worse."""
    scene = _scene_words(runs)
    compared = _compared_words(runs, policies)
    num_views = stats.common_num_views(runs)
    done = [p for p in policies if stats.completed(runs, p)]
    focus = focus_policy(done)
    if focus is None or num_views is None:
        return Headline(
            scene, compared, "There is no result yet.", "No run has been completed so far."
        )
    # Ours leads the sentence; then random and farthest-view, then whatever else there is.
    others = sorted((p for p in done if p != focus), key=_reference_order)
    pairs = [(p, stats.compare(runs, focus, p, "psnr", num_views)) for p in others]
    pairs = [(p, comparison) for p, comparison in pairs if comparison is not None]
    if not pairs:
        return Headline(scene, compared, *_single_words(runs, focus, num_views, bool(others)))
    reference, comparison = pairs[0]
    result = (
        f"With {num_views} views, {focus} reached {decibels(comparison.policy.mean)} and "
        f"{reference} {decibels(comparison.reference.mean)}: {_gap_words(comparison.gap)}."
    )
    more = [
        f"Against {p} ({decibels(c.reference.mean)}): {_gap_words(c.gap)}."
        for p, c in pairs[1:MOST_COMPARED]
    ]
    if len(pairs) > MOST_COMPARED:
        more.append(f"{len(pairs) - MOST_COMPARED} more policies are in the table below.")
    saved = _saved_words(runs, focus, reference, num_views)
    return Headline(
        scene,
        compared,
        result,
        _verdict_words(comparison.gap, focus, reference),
        (*more, *saved),
    )


def _reference_order(policy: str) -> int:
    return REFERENCES.index(policy) if policy in REFERENCES else len(REFERENCES)


def _scene_words(runs: list[Run]) -> str:
    if not runs:
        return "No scene"
    scene = runs[0].result["scene"]
    width, height = scene["image_size"]
    return (
        f"{scene['name']}: a {scene['kind']} scene with {scene['num_pool']} views to choose from "
        f"and {scene['num_test']} test views of {width} × {height} pixels"
    )


def _compared_words(runs: list[Run], policies: list[str]) -> str:
    if not runs:
        return "no policy"
    seeds = len({run.seed for run in runs})
    numbers = [r["num_views"] for run in runs for r in run.rounds]
    names = policies[0] if len(policies) == 1 else f"{', '.join(policies[:-1])} and {policies[-1]}"
    growth = ""
    if numbers:
        growth = f", training sets of {min(numbers)} to {max(numbers)} views"
        if min(numbers) == max(numbers):
            growth = f", training sets of {min(numbers)} views"
    plural = "policies" if len(policies) > 1 else "policy"
    return f"{plural} {names}{growth}, {seeds} seed{'s' if seeds > 1 else ''}"


def _gap_words(gap: stats.Interval) -> str:
    if gap.half is None:
        return f"{decibels(gap.mean, gap=True)} (one seed, no interval)"
    return (
        f"{decibels(gap.mean, gap=True)} (95\u00a0% interval {signed(gap.low)} to "
        f"{decibels(gap.high, gap=True)} over {gap.num} seeds)"
    )


def _verdict_words(gap: stats.Interval, focus: str, reference: str) -> str:
    if round(gap.mean, 2) == 0.0:
        sides = f"Here {focus} and {reference} came out level"
    elif gap.mean > 0.0:
        sides = f"Here {focus} did better than {reference}"
    else:
        sides = f"Here {focus} lost: it did worse than {reference}"
    if gap.half is None:
        return f"{sides}. {SEED_SPREAD}"
    if gap.low <= 0.0 <= gap.high:
        return f"{sides} on average, but the interval includes zero: no clear difference."
    return f"{sides}, and the interval excludes zero."


def _single_words(runs: list[Run], focus: str, num_views: int, unpaired: bool) -> tuple[str, str]:
    """Result and verdict where there is nothing to compare with."""
    why = "No seed has two policies" if unpaired else "Only one policy was run"
    verdict = f"{why}, so there is nothing to compare it with; add random to config.policies."
    interval = stats.over_seeds(runs, focus, "psnr", num_views)
    if interval is None:
        return f"With {num_views} views, {focus} has no PSNR.", verdict
    spread = ""
    if interval.half is None:
        verdict = f"{verdict} {SEED_SPREAD}"
    else:
        spread = f" (± {decibels(interval.half)}, {interval.num} seeds)"
    return f"With {num_views} views, {focus} reached {decibels(interval.mean)}{spread}.", verdict


def _saved_words(runs: list[Run], focus: str, reference: str, num_views: int) -> tuple[str, ...]:
    """How many views the focus needs for what the reference reaches at the end."""
    target = stats.over_seeds(runs, reference, "psnr", num_views)
    needed = stats.views_to_reach(stats.mean_curve(runs, focus, "psnr"), target.mean)
    if needed is None or needed >= num_views:
        return ()
    return (
        f"{focus} needed about {needed:.1f} views to reach the {decibels(target.mean)} that "
        f"{reference} has with {num_views}.",
    )
