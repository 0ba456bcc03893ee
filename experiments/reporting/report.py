"""The report of a run: what came out in plain words, then all numbers, pictures and choices."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

from experiments.reporting import camera_map, pictures, plots, run_tables, stats
from experiments.reporting.page import FOLDER, write_template
from experiments.reporting.results import (
    Run,
    bound_words,
    load_acquisition,
    load_pictures,
    load_runs,
    make_rounds,
    policies_of,
)
from experiments.reporting.stats import REFERENCES
from experiments.reporting.tables import signed

# The first seed of each policy is shown at full size, the others folded away and smaller.
MAX_SIDE, MAX_SIDE_FOLDED = 320, 160  # pixels
MOST_COMPARED = 6  # policies that the headline names
SEED_SPREAD = (
    "One seed proves little: the spread between seeds is often half a dB, as large as most gains. "
    "Run at least 5 seeds before drawing a conclusion."
)


def write_report(workdir: str | os.PathLike) -> Path:
    """Writes `report.html` from the result files of a working folder, and from nothing else.

    Args:
      workdir: folder with `summary.json` and, as far as they exist, the `pictures.npz` and
        `acquisition.npz` of each run.

    Returns:
      Path of the page.

    Raises:
      ReportError: a file is missing, broken or of another schema version.
    """
    runs = load_runs(Path(workdir))
    focus = stats.focus_policy(policies_of(runs))
    # In the order of the file, but ours first: it gets the first colour.
    policies = sorted(policies_of(runs), key=lambda p: p != focus)
    by_policy = {p: [run for run in runs if run.policy == p] for p in policies}
    by_policy = {p: sorted(some, key=lambda run: run.seed) for p, some in by_policy.items()}
    coloured = plots.in_colour(runs, policies, focus)
    num_views = stats.common_num_views(runs)
    finals = {p: stats.over_seeds(runs, p, "psnr", num_views) for p in coloured}
    colours = plots.policy_style(coloured)
    qualities, missing = [], []
    for measure in stats.MEASURES:
        figure = plots.quality_figure(runs, policies, measure, coloured)
        if figure is not None:
            label = f"{measure.label} against training views"
            qualities.append(plots.to_svg(figure, salt=f"quality-{measure.key}", label=label))
        elif runs:
            missing.append(run_tables.missing_measure(measure, runs))
    limits, strips = _strips(by_policy)
    configs: dict[str, list[str]] = {}
    versions: dict[str, set[str]] = {}
    for run in runs:
        text = json.dumps(run.result.get("config", {}), indent=2, sort_keys=True)
        configs.setdefault(text, []).append(run.label)
        for package, version in run.result.get("versions", {}).items():
            versions.setdefault(package, set()).add(str(version))
    path = Path(workdir) / "report.html"
    write_template(
        path,
        FOLDER / "report.html",
        runs=runs,
        policies=policies,
        by_policy=by_policy,
        num_views=[r["num_views"] for run in runs for r in run.rounds],
        num_seeds=len({run.seed for run in runs}),
        headline=make_headline(runs, policies),
        tiles=[(p, colours[p][0], psnr) for p, psnr in finals.items() if psnr is not None],
        num_grey=len(policies) - len(coloured),
        gaps=plots.gap_plot(runs, policies, coloured),
        incomplete=[run.label for run in runs if not run.completed],
        qualities=qualities,
        missing=missing,
        final=run_tables.final_table(runs, policies),
        by_round=run_tables.rounds_table(runs, policies),
        all_runs=run_tables.runs_table(runs),
        strips=strips,
        bars=pictures.colour_bars(limits) if strips else [],
        maps=_maps(by_policy),
        bound_words=bound_words,
        timing=plots.timing_plot(runs, policies),
        timing_table=run_tables.timing_table(runs, policies),
        versions=versions,
        configs=configs,
    )
    return path


def _strips(by_policy: dict[str, list[Run]]) -> tuple[tuple[float, float], dict]:
    """The scale of all uncertainties, and by run its round and the pictures of each view."""
    found = {run.label: load_pictures(run) for some in by_policy.values() for run in some}
    found = {label: arrays for label, arrays in found.items() if arrays is not None}
    limits = pictures.uncertainty_limits([*found.values()])
    large = {some[0].label for some in by_policy.values()}
    strips = {}
    for label, arrays in found.items():
        side = MAX_SIDE if label in large else MAX_SIDE_FOLDED
        strips[label] = int(arrays["round"]), pictures.strips(arrays, limits, max_side=side)
    return limits, strips


def _maps(by_policy: dict[str, list[Run]]) -> dict[str, tuple]:
    """By run, the maps of its rounds, and each round with the table of its choices."""
    maps = {}
    for number, some in enumerate(by_policy.values()):
        for place, run in enumerate(some):
            acquisition = load_acquisition(run)
            if acquisition is not None:
                rounds = make_rounds(acquisition)
                svg = camera_map.map_plot(acquisition, rounds, salt=f"map{number}-{place}")
                tables = [(one, run_tables.choice_table(one)) for one in rounds]
                maps[run.label] = svg, tables
    return maps


# --- the result in plain words ---


class Headline(NamedTuple):
    """What stands at the top of the page."""

    result: str
    verdict: str
    more: tuple[str, ...] = ()


def decibels(value: float, *, gap: bool = False) -> str:
    """A level, or a gap with its sign, that is never broken before its unit."""
    return f"{signed(value) if gap else f'{value:.2f}'}\u00a0dB"


def make_headline(runs: list[Run], policies: list[str]) -> Headline:
    """Says what came out, for better or worse."""
    num_views = stats.common_num_views(runs)
    done = [p for p in policies if stats.completed(runs, p)]
    focus = stats.focus_policy(done)
    if focus is None or num_views is None:
        return Headline("There is no result yet.", "No run has been completed so far.")
    # Ours leads the sentence; then random and farthest-view, then whatever else there is.
    others = [p for p in REFERENCES if p in done] + [p for p in done if p not in REFERENCES]
    pairs = [(p, stats.compare(runs, focus, p, "psnr", num_views)) for p in others if p != focus]
    pairs = [(p, comparison) for p, comparison in pairs if comparison is not None]
    if not pairs:
        return _single_headline(runs, focus, num_views, len(done) > 1)
    reference, first = pairs[0]
    result = (
        f"With {num_views} views, {focus} reached {decibels(first.policy.mean)} and "
        f"{reference} {decibels(first.reference.mean)}: {_gap_words(first.gap)}."
    )
    more = [
        f"Against {p} ({decibels(c.reference.mean)}): {_gap_words(c.gap)}."
        for p, c in pairs[1:MOST_COMPARED]
    ]
    if len(pairs) > MOST_COMPARED:
        more.append(f"{len(pairs) - MOST_COMPARED} more policies are in the table below.")
    target = stats.over_seeds(runs, reference, "psnr", num_views).mean
    needed = stats.views_to_reach(stats.mean_curve(runs, focus, "psnr"), target)
    if needed is not None and needed < num_views:
        more.append(
            f"{focus} needed about {needed:.1f} views to reach the {decibels(target)} that "
            f"{reference} has with {num_views}."
        )
    return Headline(result, _verdict_words(first.gap, focus, reference), tuple(more))


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


def _single_headline(runs: list[Run], focus: str, num_views: int, unpaired: bool) -> Headline:
    """Result and verdict where there is nothing to compare with."""
    why = "No seed has two policies" if unpaired else "Only one policy was run"
    verdict = f"{why}, so there is nothing to compare it with; add random to config.policies."
    interval = stats.over_seeds(runs, focus, "psnr", num_views)
    if interval is None:
        return Headline(f"With {num_views} views, {focus} has no PSNR.", verdict)
    reached = f"With {num_views} views, {focus} reached {decibels(interval.mean)}"
    if interval.half is None:
        return Headline(f"{reached}.", f"{verdict} {SEED_SPREAD}")
    return Headline(f"{reached} (± {decibels(interval.half)}, {interval.num} seeds).", verdict)
