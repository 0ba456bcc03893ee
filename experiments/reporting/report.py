"""The report of a run: what came out in plain words, then all numbers, pictures and choices."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from markupsafe import Markup

from experiments.reporting import camera_map, pictures, plots, run_tables, stats
from experiments.reporting.page import FOLDER, write_template
from experiments.reporting.results import (
    Round,
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
    path = Path(workdir) / "report.html"
    write_template(path, FOLDER / "report.html", **_content(load_runs(Path(workdir))))
    return path


def _content(runs: list[Run]) -> dict:
    """Everything that the template names."""
    focus = stats.focus_policy(policies_of(runs))
    # In the order of the file, but ours first: it gets the first colour.
    policies = sorted(policies_of(runs), key=lambda p: p != focus)
    coloured = plots.in_colour(runs, policies, focus)
    qualities = [plots.quality_figure(runs, policies, m, coloured) for m in stats.MEASURES]
    qualities = [
        plots.to_svg(figure, salt=f"quality-{m.key}", label=f"{m.label} against training views")
        for m, figure in zip(stats.MEASURES, qualities)
        if figure is not None
    ]
    found = {run.label: load_pictures(run) for run in runs}
    known = [arrays for arrays in found.values() if arrays is not None]
    limits = pictures.uncertainty_limits(known)

    def strips(run: Run, number: int) -> dict:
        arrays, rows, views = found[run.label], None, ""
        if arrays is not None:
            side = MAX_SIDE_FOLDED if number else MAX_SIDE
            rows = pictures.strips(arrays, limits, max_side=side)
            last = int(arrays["round"])
            views = f"after round {last}"
            if 0 <= last < len(run.rounds):
                views = f"trained on {run.rounds[last]['num_views']} views"
        return {"label": run.label, "views": views, "rows": rows}

    def maps(run: Run, number: int) -> dict:
        acquisition = load_acquisition(run)
        if acquisition is None:
            return {"label": run.label, "svg": None, "rounds": []}
        rounds = make_rounds(acquisition)
        salt = f"map{policies.index(run.policy)}-{number}"
        return {
            "label": run.label,
            "svg": Markup(camera_map.map_plot(acquisition, rounds, salt=salt)),
            "rounds": [(_round_title(run, one), run_tables.choice_table(one)) for one in rounds],
        }

    def sections(make_entry: Callable[[Run, int], dict]) -> list[dict]:
        """Of each policy: its first seed, and the others to unfold."""
        made = []
        for policy in policies:
            mine = sorted((run for run in runs if run.policy == policy), key=lambda run: run.seed)
            first, *others = (make_entry(run, number) for number, run in enumerate(mine))
            made.append({"policy": policy, "first": first, "others": others})
        return made

    scene, compared = _about(runs, policies)
    gaps = plots.gap_plot(runs, policies, coloured)
    timing = plots.timing_plot(runs, policies)
    return {
        "title": runs[0].result["scene"]["name"] if runs else "no runs",
        "headline": make_headline(runs, policies),
        "scene": scene,
        "compared": compared,
        "tiles": _tiles(runs, coloured),
        "num_grey": len(policies) - len(coloured),
        "gaps": gaps and Markup(gaps),
        "incomplete": [run.label for run in runs if not run.completed],
        "qualities": [Markup(svg) for svg in qualities],
        "missing": _missing(runs),
        "final": run_tables.final_table(runs, policies),
        "by_round": run_tables.rounds_table(runs, policies),
        "all_runs": run_tables.runs_table(runs),
        "pictures": sections(strips),
        "bars": pictures.colour_bars(limits) if known else [],
        "maps": sections(maps),
        "timing": timing and Markup(timing),
        "timing_table": run_tables.timing_table(runs, policies),
        "making": _making(runs),
    }


def _tiles(runs: list[Run], policies: list[str]) -> list[dict]:
    """The final PSNR of each policy in large type."""
    num_views = stats.common_num_views(runs)
    tiles = []
    for policy, (colour, _) in plots.policy_style(policies).items():
        interval = stats.over_seeds(runs, policy, "psnr", num_views)
        if interval is not None:
            below = "one seed"
            if interval.half is not None:
                below = f"± {interval.half:.2f} dB, {interval.num} seeds"
            number = f"{interval.mean:.2f}"
            tiles.append({"policy": policy, "colour": colour, "number": number, "below": below})
    return tiles


def _missing(runs: list[Run]) -> list[str]:
    """Measures that no run has, with the reason."""
    values = {
        m: [run.value(m.key, r["num_views"]) for run in runs for r in run.rounds]
        for m in stats.MEASURES
    }
    lacking = [m for m, found in values.items() if all(value is None for value in found)]
    return [run_tables.missing_measure(m, runs) for m in lacking] if runs else []


def _round_title(run: Run, one: Round) -> str:
    """How the candidates became the chosen ones, in a line."""
    words = f"Round {one.number}: {len(one.selected)} chosen of {len(one.candidates)} candidates"
    info = run.rounds[one.number] if one.number < len(run.rounds) else {}
    if all(choice.score is None for choice in one.choices):
        words += ", without scores"
    if info.get("num_survivors") is not None or not one.survives.all():
        words += f", {int(one.survives.sum())} left by the distance filter"
    if info.get("farthest_overlap") is not None:
        words += f"; farthest-view would share {info['farthest_overlap']}"
    if info.get("batch_bound"):
        words += f"; {bound_words(info['batch_bound'])}"
    return words


def _making(runs: list[Run]) -> dict:
    """Commands, devices, versions and configs, each kind once."""
    configs: dict[str, list[str]] = {}
    versions: dict[str, set[str]] = {}
    for run in runs:
        text = json.dumps(run.result.get("config", {}), indent=2, sort_keys=True)
        configs.setdefault(text, []).append(run.label)
        for package, version in run.result.get("versions", {}).items():
            versions.setdefault(package, set()).add(str(version))
    return {
        "commands": sorted({run.result.get("command", "") for run in runs} - {""}),
        "devices": sorted({str(run.result.get("device", "")) for run in runs} - {""}),
        "versions": [(name, ", ".join(sorted(v))) for name, v in sorted(versions.items())],
        "configs": [{"text": text, "runs": "; ".join(who)} for text, who in configs.items()],
    }


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


def _about(runs: list[Run], policies: list[str]) -> tuple[str, str]:
    """The scene, and what was compared."""
    if not runs:
        return "No scene", "no policy"
    scene = runs[0].result["scene"]
    width, height = scene["image_size"]
    about = (
        f"{scene['name']}: a {scene['kind']} scene with {scene['num_pool']} views to choose from "
        f"and {scene['num_test']} test views of {width} × {height} pixels"
    )
    *others, last = policies
    names = f"policies {', '.join(others)} and {last}" if others else f"policy {last}"
    numbers = [r["num_views"] for run in runs for r in run.rounds]
    if numbers:
        fewest, most = min(numbers), max(numbers)
        names += f", training sets of {fewest}{f' to {most}' if most > fewest else ''} views"
    seeds = len({run.seed for run in runs})
    return about, f"{names}, {seeds} seed{'s' if seeds > 1 else ''}"


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
