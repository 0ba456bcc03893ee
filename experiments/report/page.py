"""Puts the report together: reads a working folder, writes one page that needs nothing else."""

from __future__ import annotations

import json
import os
from pathlib import Path

from markupsafe import Markup

from experiments.report import camera_map, choices, pictures, plots, stats, tables
from experiments.report.headline import focus_policy, make_headline
from experiments.report.results import Run, load_acquisition, load_pictures, load_runs
from experiments.web.page import write_template

# The first seed of each policy is shown at full size, the others folded away and smaller.
MAX_SIDE, MAX_SIDE_FOLDED = 320, 160  # pixels


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
    workdir = Path(workdir)
    runs = load_runs(workdir)
    path = workdir / "report.html"
    write_template(path, Path(__file__).parent, **page_content(runs))
    return path


def page_content(runs: list[Run]) -> dict:
    """Everything that the template names."""
    policies = _ordered_policies(runs)
    picture_sections, bars = _picture_sections(runs, policies)
    coloured = plots.in_colour(runs, policies, focus_policy(policies))
    qualities = [plots.quality_plot(runs, policies, m, coloured) for m in stats.MEASURES]
    gap_svg = plots.gap_plot(runs, policies, coloured)
    timing = plots.timing_plot(runs, policies)
    return {
        "title": runs[0].result["scene"]["name"] if runs else "no runs",
        "headline": make_headline(runs, policies),
        "tiles": _tiles(runs, coloured),
        "num_grey": len(policies) - len(coloured),
        "gaps": Markup(gap_svg) if gap_svg else None,
        "incomplete": [run.label for run in runs if not run.completed],
        "qualities": [Markup(svg) for svg in qualities if svg],
        "missing": _missing(runs),
        "final": tables.final_table(runs, policies),
        "by_round": tables.rounds_table(runs, policies),
        "all_runs": tables.runs_table(runs),
        "pictures": picture_sections,
        "bars": bars,
        "maps": _map_sections(runs, policies),
        "timing": Markup(timing) if timing else None,
        "timing_table": tables.timing_table(runs, policies),
        "making": _making(runs),
    }


def _ordered_policies(runs: list[Run]) -> list[str]:
    """In the order of the file, but ours first: it gets the first colour."""
    policies = list(dict.fromkeys(run.policy for run in runs))
    focus = focus_policy(policies)
    return sorted(policies, key=lambda p: p != focus)


def _tiles(runs: list[Run], policies: list[str]) -> list[dict]:
    """The final PSNR of each policy in large type."""
    num_views = stats.common_num_views(runs)
    style = plots.policy_style(policies)
    tiles = []
    for policy in policies:
        interval = stats.over_seeds(runs, policy, "psnr", num_views)
        if interval is not None:
            spread = "one seed" if interval.half is None else f"± {interval.half:.2f} dB"
            seeds = "" if interval.half is None else f", {interval.num} seeds"
            tiles.append(
                {
                    "policy": policy,
                    "colour": style[policy][0],
                    "number": f"{interval.mean:.2f}",
                    "below": f"{spread}{seeds}",
                }
            )
    return tiles


def _missing(runs: list[Run]) -> list[str]:
    """Measures that no run has, with the reason."""
    measured = {
        measure.key
        for measure in stats.MEASURES
        for run in runs
        for r in run.rounds
        if run.value(measure.key, r["num_views"]) is not None
    }
    lacking = [m for m in stats.MEASURES if m.key not in measured]
    return [tables.missing_measure(m, runs) for m in lacking] if runs else []


def _grouped(runs: list[Run], policies: list[str]) -> list[list[Run]]:
    """The runs of each policy, smallest seed first."""
    by_policy = [[run for run in runs if run.policy == policy] for policy in policies]
    return [sorted(group, key=lambda run: run.seed) for group in by_policy]


def _picture_sections(runs, policies) -> tuple[list[dict], list[pictures.ColourBar]]:
    """Per policy: the strips of its first seed, and of the others to unfold."""
    found = {id(run): load_pictures(run) for run in runs}
    limits = pictures.uncertainty_limits([p for p in found.values() if p is not None])
    sections = []
    for group in _grouped(runs, policies):
        entries = []
        for run in group:
            arrays = found[id(run)]
            side = MAX_SIDE_FOLDED if entries else MAX_SIDE
            rows = None if arrays is None else pictures.strips(arrays, limits, max_side=side)
            views = "" if arrays is None else _views_after(run, int(arrays["round"]))
            entries.append({"label": run.label, "views": views, "rows": rows})
        sections.append({"policy": group[0].policy, "first": entries[0], "others": entries[1:]})
    bars = pictures.colour_bars(limits) if any(p is not None for p in found.values()) else []
    return sections, bars


def _views_after(run: Run, round_number: int) -> str:
    if not 0 <= round_number < len(run.rounds):
        return f"after round {round_number}"
    return f"trained on {run.rounds[round_number]['num_views']} views"


def _map_sections(runs: list[Run], policies: list[str]) -> list[dict]:
    """Per policy: the maps and choices of its first seed, and of the others to unfold."""
    sections = []
    for number, group in enumerate(_grouped(runs, policies)):
        entries = [_map_entry(run, f"map{number}-{i}") for i, run in enumerate(group)]
        sections.append({"policy": group[0].policy, "first": entries[0], "others": entries[1:]})
    return sections


def _map_entry(run: Run, salt: str) -> dict:
    acquisition = load_acquisition(run)
    if acquisition is None:
        return {"label": run.label, "svg": None, "rounds": []}
    rounds = choices.make_rounds(acquisition)
    svg = camera_map.map_plot(acquisition, rounds, salt=salt)
    described = [
        {
            "title": f"Round {one.number}: {_filter_words(run, one)}",
            "table": tables.choice_table(one),
        }
        for one in rounds
    ]
    return {"label": run.label, "svg": Markup(svg), "rounds": described}


def _filter_words(run: Run, one: choices.Round) -> str:
    """How the candidates became the chosen ones, in a line."""
    words = f"{len(one.selected)} chosen of {len(one.candidates)} candidates"
    info = run.rounds[one.number] if one.number < len(run.rounds) else {}
    if all(choice.score is None for choice in one.choices):
        words += ", without scores"
    if info.get("num_survivors") is not None or not one.survives.all():
        words += f", {int(one.survives.sum())} left by the distance filter"
    if info.get("farthest_overlap") is not None:
        words += f"; farthest-view would share {info['farthest_overlap']}"
    if info.get("batch_bound"):
        words += f"; {choices.bound_words(info['batch_bound'])}"
    return words


def _making(runs: list[Run]) -> dict:
    """Commands, devices, versions and configs, each kind once."""
    configs: dict[str, list[str]] = {}
    for run in runs:
        text = json.dumps(run.result.get("config", {}), indent=2, sort_keys=True)
        configs.setdefault(text, []).append(run.label)
    versions: dict[str, set[str]] = {}
    for run in runs:
        for package, version in run.result.get("versions", {}).items():
            versions.setdefault(package, set()).add(str(version))
    return {
        "commands": sorted({run.result.get("command", "") for run in runs} - {""}),
        "devices": sorted({str(run.result.get("device", "")) for run in runs} - {""}),
        "versions": [(name, ", ".join(sorted(v))) for name, v in sorted(versions.items())],
        "configs": [{"text": text, "runs": "; ".join(who)} for text, who in configs.items()],
    }
