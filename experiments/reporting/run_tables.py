"""Tables of runs: quality, rounds, baselines, time, choices, settings of a sweep, the paper's."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from experiments.reporting import stats
from experiments.reporting.plots import PARTS
from experiments.reporting.results import Round, Run
from experiments.reporting.stats import REFERENCES
from experiments.reporting.tables import Cell, Table, dash, interval_cell, seconds, signed
from experiments.runtime import ReportError

RANDOM = REFERENCES[0]
NO_SELF_GAP = "a policy has no gap to itself"


def missing_measure(measure: stats.Measure, runs: list[Run]) -> str:
    """Why a measure has no number."""
    if any(r.get(measure.key) is not None for run in runs for r in run.rounds):
        return f"{measure.label}: not a finite number, or not measured at this number of views"
    if measure.key == "lpips":
        reasons = [run.result.get("lpips_reason") for run in runs]
        return f"LPIPS: {next(filter(None, reasons), 'not measured')}"
    if measure.key == "depth_mae":
        return "Depth error: this scene has no true depth"
    return f"{measure.label}: not measured"


def final_table(runs: list[Run], policies: list[str]) -> Table:
    """Means over seeds at the largest number of views that all completed runs share."""
    done = [p for p in policies if stats.completed(runs, p)]
    references = [p for p in REFERENCES if p in done and len(done) > 1]
    head = ("policy", "seeds", "views", *(m.heading for m in stats.MEASURES))
    head += tuple(f"PSNR gap to {p} (dB)" for p in references)
    rows = []
    for policy in policies:
        row = [Cell(policy), _seeds_cell(policy, stats.completed(runs, policy))]
        if policy not in done:
            rows.append((*row, *[dash(f"{policy}: no completed run")] * (len(head) - 2)))
            continue
        row += _measure_cells(runs, policy, stats.MEASURES)
        rows.append((*row, *(_gap_cell(runs, policy, p) for p in references)))
    return Table(head, tuple(rows))


def _seeds_cell(policy: str, runs: list[Run]) -> Cell:
    """How many seeds there are, and a note where the field of one learnt nothing."""
    stuck = [str(run.seed) for run in runs if any(r.get("stuck") for r in run.rounds)]
    if not stuck:
        return Cell(str(len(runs)))
    why = f"{policy}: a field of seed {', '.join(stuck)} is stuck in fog, so these numbers are not "
    return Cell(f"{len(runs)}*", f"{why}its policy's")


def _measure_cells(runs: list[Run], policy: str, measures) -> list[Cell]:
    """The last shared number of views, and each measure there."""
    num_views, mine = stats.common_num_views(runs), stats.completed(runs, policy)
    cells = [Cell(str(num_views)) if num_views is not None else dash("no shared number")]
    for measure in measures:
        interval = stats.over_seeds(runs, policy, measure.key, num_views)
        cells.append(interval_cell(interval, measure.digits, missing_measure(measure, mine)))
    return cells


def _gap_cell(runs: list[Run], policy: str, reference: str, where: str = "") -> Cell:
    """PSNR minus that of a reference at the end, paired by seed."""
    if policy == reference:
        return dash(NO_SELF_GAP)
    pair = stats.compare(runs, policy, reference, "psnr", stats.common_num_views(runs))
    why = f"{where}{policy} and {reference} share no seed"
    return interval_cell(pair and pair.gap, 2, why, gap=True)


def rounds_table(runs: list[Run], policies: list[str]) -> Table | None:
    """PSNR round by round, and the gap to each reference averaged over them.

    None for one policy, or one round of choosing.
    """
    numbers = stats.chosen_num_views(runs)
    done = [p for p in policies if stats.completed(runs, p)]
    if len(numbers) < 2 or len(done) < 2:
        return None
    references = [p for p in REFERENCES if p in done]
    rows = []
    for policy in done:
        row = [Cell(policy)]
        for n in numbers:
            interval = stats.over_seeds(runs, policy, "psnr", n)
            row.append(interval_cell(interval, 2, f"{policy}: PSNR not measured"))
        for reference in references:
            gap = stats.mean_round_gap(runs, policy, reference, "psnr")
            why = f"{policy} and {reference} share no seed"
            same = policy == reference
            row.append(dash(NO_SELF_GAP) if same else interval_cell(gap, 2, why, gap=True))
        rows.append(tuple(row))
    head = ["policy", *(f"PSNR at {n} views (dB)" for n in numbers)]
    return Table((*head, *(f"gap to {p}, mean of rounds (dB)" for p in references)), tuple(rows))


def runs_table(runs: list[Run]) -> Table:
    """Every run by itself, at its own last round."""
    rows = []
    for run in runs:
        row = [Cell(run.policy), Cell(str(run.seed))]
        row.append(Cell("completed" if run.completed else "incomplete"))
        if not run.rounds:
            why = f"{run.label}: no round measured yet"
            rows.append((*row, *[dash(why)] * (1 + len(stats.MEASURES))))
            continue
        num_views = run.rounds[-1]["num_views"]
        row.append(Cell(str(num_views)))
        for measure in stats.MEASURES:
            value = run.value(measure.key, num_views)
            known = value is not None and Cell(f"{value:.{measure.digits}f}")
            row.append(known or dash(missing_measure(measure, [run])))
        rows.append(tuple(row))
    head = ("policy", "seed", "state", "views", *(m.heading for m in stats.MEASURES))
    return Table(head, tuple(rows))


def baseline_table(runs: list[Run], policies: list[str]) -> Table | None:
    """The field against what can be had without one; None where views were chosen or none is known.

    The gap is to the better of the two, seed by seed.
    """
    known = [run for run in stats.completed(runs) if run.result.get("baselines")]
    if not known or any(len(run.rounds) > 1 for run in runs):
        return None
    rows = []
    for policy in policies:
        mine = [run for run in known if run.policy == policy]
        psnr = [run.rounds[-1]["psnr"] for run in mine]
        colour, photo = (
            [run.result["baselines"][f"{name}_psnr"] for run in mine]
            for name in ("mean_colour", "nearest_image")
        )
        gaps = stats.mean_interval(p - max(pair) for p, *pair in zip(psnr, colour, photo))
        why = f"{policy}: no completed run"
        cells = [interval_cell(stats.mean_interval(v), 2, why) for v in (psnr, colour, photo)]
        cells.append(interval_cell(gaps, 2, why, gap=True))
        rows.append((Cell(policy), Cell(str(mine[0].rounds[-1]["num_test_views"])), *cells))
    head = ("policy", "held-out views", "field (dB)", "mean colour (dB)", "nearest photo (dB)")
    return Table((*head, "above the better of the two (dB)"), tuple(rows))


def timing_table(runs: list[Run], policies: list[str]) -> Table:
    """Seconds of each part, all rounds of a run together, mean over completed runs.

    Parts that no run has spent any time on are left out.
    """
    used = [p for p in PARTS if any(stats.mean_seconds(runs, policy, p) for policy in policies)]
    rows = []
    for policy in policies:
        parts = [stats.mean_seconds(runs, policy, part) for part in used]
        cells = [dash(f"{policy}: no completed run")] * (len(used) + 1)
        if None not in parts:
            cells = [Cell(seconds(value)) for value in (*parts, sum(parts))]
        rows.append((Cell(policy), *cells))
    return Table(("policy", *(PARTS[part][0] for part in used), "together"), tuple(rows))


def choice_table(one: Round) -> Table:
    """Why each view of a round was chosen: its score, its rank, its distance from what was held."""
    filtered = one.is_scored and not one.survives.all()
    head = ["view", *["score", "rank among all"] * one.is_scored]
    head += ["rank after filter"] * filtered
    ranked = [one.scores[np.isfinite(one.scores) & kept] for kept in (True, one.survives)]
    rows = []
    for name, score, distance in zip(one.names, one.selected_scores, one.distances):
        row = [dash(f"{name} was not scored")] * (len(head) - 1)
        if np.isfinite(score):
            ranks = [Cell(f"{(some > score).sum() + 1} of {some.size}") for some in ranked]
            row = [Cell(f"{score:.4g}"), *ranks[: 1 + filtered]]
        rows.append((Cell(name), *row, Cell(f"{distance:.3g}")))
    return Table((*head, "nearest training view (scene units)"), tuple(rows))


# --- settings of a sweep ---

SCENE_OPTIONS = ("loader", "data_dir", "scene")  # PSNRs of two scenes are no gap


@dataclasses.dataclass(frozen=True)
class Setting:
    """The runs of one combination of options."""

    name: str
    values: dict[str, Any]
    policies: list[str]
    runs: list[Run]  # empty where there is no result yet


def settings_table(settings: list[Setting], *, compared: bool = True) -> Table:
    """Means over seeds at the end of each setting, with gaps paired by seed.

    Options that every setting sets have a column each; where settings differ in what they set, as
    with one change at a time, their names are the first column.

    Args:
      settings: at least one.
      compared: whether there is a column of gaps between settings, see `_references`.
    """
    options = [*settings[0].values] if len({(*s.values,) for s in settings}) == 1 else []
    references = _references(settings, options)
    others = {words for first, words in references.values() if first is not None}
    compared = compared and bool(others)
    all_rounds = [r for s in settings for run in s.runs for r in run.rounds]
    measures = [m for m in stats.MEASURES if any(r.get(m.key) is not None for r in all_rounds)]
    to_random = any(RANDOM in s.policies and len(s.policies) > 1 for s in settings)
    head = [*(options or ["setting"]), "policy", "seeds", "views", *(m.heading for m in measures)]
    head += [f"PSNR gap to {RANDOM} (dB)"] * to_random
    other = others.pop() if len(others) == 1 else "the first of its kind"
    head += [f"PSNR gap to {other} (dB)"] * compared
    rows = []
    for setting in settings:
        fixed = [Cell(str(setting.values[o])) for o in options] or [Cell(setting.name)]
        for policy in setting.policies:
            mine = stats.completed(setting.runs, policy)
            row = [*fixed, Cell(policy), Cell(str(len(mine)))]
            if mine:
                row += _measure_cells(setting.runs, policy, measures)
                row += [_gap_cell(setting.runs, policy, RANDOM, f"{setting.name}: ")] * to_random
                first = references[setting.name][0]
                row += [_setting_gap(setting, first, policy)] * compared
            why = f"{setting.name}, {policy}: no completed run"
            rows.append((*row, *[dash(why)] * (len(head) - len(row))))
    return Table(tuple(head), tuple(rows))


def _references(
    settings: list[Setting], options: list[str]
) -> dict[str, tuple[Setting | None, str]]:
    """What each setting is compared with, by name, and in which options that one differs.

    The first setting that has the most of the leading options in common with it: in a sweep over
    views and steps, that of as many views. None where there is no other of the same scene. Where
    settings differ in what they set, all are compared with the very first.
    """
    if not options:
        return {s.name: (settings[0], settings[0].name) for s in settings}
    found = {}
    for setting in settings:
        found[setting.name] = None, ""
        for depth in range(len(options) - 1, -1, -1):
            shared = (*options[:depth], *(o for o in SCENE_OPTIONS if o in options))
            alike = [s for s in settings if all(s.values[o] == setting.values[o] for o in shared)]
            if len(alike) > 1:
                first = alike[0]
                words = ",".join(f"{o}={first.values[o]}" for o in options if o not in shared)
                found[setting.name] = first, words
                break
    return found


def _setting_gap(setting: Setting, first: Setting | None, policy: str) -> Cell:
    """Each at its own last number of views: an option may change how many there are."""
    if first is None:
        return dash(f"{setting.name}: no other setting of this scene")
    if setting is first:
        return dash("a setting has no gap to itself")
    ours, theirs = (
        stats.by_seed(one.runs, policy, "psnr", stats.common_num_views(one.runs))
        for one in (setting, first)
    )
    gaps = [value - theirs[seed] for seed, value in ours.items() if seed in theirs]
    why = f"{policy}: {setting.name} and {first.name} share no seed"
    return interval_cell(stats.mean_interval(gaps), 2, why, gap=True)


# --- the paper beside ours ---


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table of the paper."""

    name: str  # as printed
    policy: str | None  # ours of the same kind; None: the field of the initial views
    psnr: float  # dB
    ssim: float
    lpips: float
    seconds: float | None = None  # of choosing
    candidates: int | None = None  # that were scored


# Table 2's Ours is Table 4's row with the policy: one scene, not a mean.
PAPER: dict[str, tuple[Row, ...]] = {
    "table_1": (
        Row("ActiveNeRF", "activenerf", 26.240, 0.8560, 0.1240),
        Row("Random", "random", 27.138, 0.9206, 0.0652),
        Row("ActiveNeRF*", "activenerf_star", 27.346, 0.9163, 0.0743),
        Row("Ours", "bavs_topk", 27.997, 0.9306, 0.0696),
        Row("Ours*", "bavs", 29.023, 0.9328, 0.0405),
    ),
    "table_2": (
        Row("Origin", None, 16.5965, 0.6184, 0.4783),
        Row("Random", "random", 17.1705, 0.6283, 0.3954),
        Row("Ours", "bavs", 19.7318, 0.7951, 0.2953),
    ),
    "table_4": (
        Row("no policy", "bavs_topk", 17.2311, 0.6101, 0.4125, 1408.0, 250),
        Row("with policy", "bavs", 19.7318, 0.7951, 0.2953, 197.0, 43),
    ),
}


def paper_table(runs: list[Run], policies: list[str], name: str) -> Table:
    """Each of the paper's rows and each of ours, and both gaps to random choice.

    Args:
      runs: of one experiment.
      policies: what we ran.
      name: of the table, a key of `PAPER`.

    Raises:
      ReportError: there is no such table.
    """
    if name not in PAPER:
        raise ReportError(f"paper={name}: no such table; use one of {', '.join(PAPER)}")
    levels = {row.policy: row.psnr for row in PAPER[name]}
    timed = any(row.seconds is not None for row in PAPER[name])
    measures = [m for m in stats.MEASURES if m.key in ("psnr", "ssim", "lpips")]
    names = [m.heading for m in measures] + [f"PSNR gap to {RANDOM} (dB)"]
    names += ["scoring and selecting (s)", "candidates scored"] * timed
    rows = [(row.policy, row) for row in PAPER[name]]
    rows += [(policy, None) for policy in policies if policy not in levels]
    lines = []
    for policy, row in rows:
        pairs = [  # ours, and as it is printed
            (_our_measure(runs, policies, policy, m), row and f"{getattr(row, m.key):.{m.digits}f}")
            for m in measures
        ]
        gap = None
        if row is not None and policy != RANDOM and RANDOM in levels:
            gap = signed(row.psnr - levels[RANDOM])
        pairs.append((_our_gap(runs, policy), gap))
        if timed:
            pairs.append((_seconds(runs, policy), row and f"{row.seconds:.0f}"))
            pairs.append((_candidates(runs, policy), row and str(row.candidates)))
        cells = [Cell(policy or "initial views"), _printed(row and row.name)]
        lines.append((*cells, *(cell for a, b in pairs for cell in (a, _printed(b)))))
    head = ("policy", "in the paper", *(part for title in names for part in (title, "paper")))
    return Table(head, tuple(lines))


def _printed(text: str | None) -> Cell:
    return dash("the paper prints no such number") if text is None else Cell(text)


def _our_measure(runs: list[Run], policies: list[str], policy: str | None, measure) -> Cell:
    """A measure at the end, or of the initial views, which all policies share."""
    owner = policy or next((p for p in policies if stats.completed(runs, p)), None)
    mine = stats.completed(runs, owner) if owner else []
    if not mine:
        return dash(_no_run(policy))
    num_views = stats.common_num_views(runs) if policy else mine[0].rounds[0]["num_views"]
    interval = stats.over_seeds(runs, owner, measure.key, num_views)
    return interval_cell(interval, measure.digits, missing_measure(measure, mine))


def _our_gap(runs: list[Run], policy: str | None) -> Cell:
    if policy is None:
        return dash("the initial views are those of random choice too")
    if policy != RANDOM and not stats.completed(runs, policy):
        return dash(_no_run(policy))
    return _gap_cell(runs, policy, RANDOM)


def _seconds(runs: list[Run], policy: str | None) -> Cell:
    """Of looking at the candidates, all rounds together."""
    totals = [
        sum(r["seconds"].get("score", 0.0) + r["seconds"].get("select", 0.0) for r in run.rounds)
        for run in stats.completed(runs, policy)
    ]
    return interval_cell(stats.mean_interval(totals), 1, _no_run(policy))


def _candidates(runs: list[Run], policy: str | None) -> Cell:
    """That the distance filter left, or all of them where there is none; mean over rounds."""
    rows = [r for run in stats.completed(runs, policy) for r in run.rounds[1:]]
    numbers = [r.get("num_survivors") or r.get("num_candidates") for r in rows]
    known = [n for n in numbers if n is not None]
    why = _no_run(policy) if not rows else f"{policy}: not in its result files"
    return Cell(f"{sum(known) / len(known):.0f}") if known else dash(why)


def _no_run(policy: str | None) -> str:
    return f"{policy}: no completed run" if policy else "no completed run"
