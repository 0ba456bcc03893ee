"""Tables of runs: quality, rounds, baselines, time, choices, settings of a sweep, the paper's."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.reporting import stats
from experiments.reporting.results import Run, policies_of
from experiments.reporting.stats import MEASURES, REFERENCES, Measure
from experiments.reporting.tables import Cell, Table, dash, interval_cell, seconds, signed
from experiments.runtime import ReportError

RANDOM = REFERENCES[0]
NOT_PRINTED = "the paper prints no such number"
PARTS = {
    "train": "training",
    "curvature": "curvature",
    "fit": "training other fields",
    "score": "scoring candidates",
    "select": "selecting",
    "evaluate": "measuring on test views",
}


def missing_measure(measure: Measure, runs: list[Run]) -> str:
    """Why a measure has no number."""
    if any(r.get(measure.key) is not None for run in runs for r in run.rounds):
        return f"{measure.label}: not a finite number, or not measured at this number of views"
    if measure.key == "lpips":
        reasons = [run.result.get("lpips_reason") for run in runs]
        return f"LPIPS: {next(filter(None, reasons), 'not measured')}"
    if measure.key == "depth_mae":
        return "Depth error: this scene has no true depth"
    return f"{measure.label}: not measured"


# --- of one experiment; `policies` may hold some that have no completed run ---


def final_table(runs: list[Run], policies: list[str]) -> Table:
    """Means over seeds at the largest number of views that all completed runs share."""
    done = [p for p in policies if stats.completed(runs, p)]
    references = [p for p in REFERENCES if p in done and len(done) > 1]
    rows = []
    for policy in policies:
        mine = stats.completed(runs, policy)
        num = len({run.seed for run in mine})
        stuck = [str(run.seed) for run in mine if any(r.get("stuck") for r in run.rounds)]
        why = f"{policy}: a field of seed {', '.join(stuck)} is stuck in fog, so these numbers are "
        seeds = Cell(f"{num}*", f"{why}not its policy's") if stuck else num
        rows.append([policy, seeds, *_cells(runs, policy, MEASURES, references)])
    head = ["policy", "seeds", "views", *(m.heading for m in MEASURES)]
    return Table([*head, *(f"PSNR gap to {p} (dB)" for p in references)], rows)


def _cells(
    runs: list[Run], policy: str, measures: Sequence[Measure], references=(), where="", at=None
) -> list[Cell]:
    """Number of views, each measure there, and the PSNR gap to each reference; see `by_seed`."""
    mine = stats.completed(runs, policy)
    if not mine:
        why = f"{where}{policy}: no completed run"
        return [dash(why)] * (1 + len(measures) + len(references))
    at = stats.shared_num_views(runs)[-1:] if at is None else at
    cells = [Cell(str(at[0])) if at else dash("no shared number")]
    for measure in measures:
        interval = stats.mean_interval(stats.by_seed(runs, policy, measure.key, at))
        cells.append(interval_cell(interval, measure.digits, missing_measure(measure, mine)))
    return cells + [_gap_cell(runs, policy, reference, where, at) for reference in references]


def _gap_cell(runs: list[Run], policy: str, reference: str, where: str = "", at=None) -> Cell:
    """PSNR minus that of a reference, paired by seed; `at` as in `by_seed`."""
    if policy == reference:
        return dash("a policy has no gap to itself")
    gap = stats.paired_gap(*(stats.by_seed(runs, p, at=at) for p in (policy, reference)))
    return interval_cell(gap, 2, f"{where}{policy} and {reference} share no seed", gap=True)


def rounds_table(runs: list[Run], policies: list[str]) -> Table | None:
    """PSNR round by round, and the gap to each reference averaged over them.

    None for one policy, or one round of choosing.
    """
    numbers = stats.shared_num_views(runs)[1:]
    done = [p for p in policies if stats.completed(runs, p)]
    if len(numbers) < 2 or len(done) < 2:
        return None
    references = [p for p in REFERENCES if p in done]
    rows = []
    for policy in done:
        levels = [_cells(runs, policy, MEASURES[:1], at=[n])[1] for n in numbers]
        gaps = [_gap_cell(runs, policy, p, at=numbers) for p in references]
        rows.append([policy, *levels, *gaps])
    head = ["policy", *(f"PSNR at {n} views (dB)" for n in numbers)]
    return Table([*head, *(f"gap to {p}, mean of rounds (dB)" for p in references)], rows)


def baseline_table(runs: list[Run]) -> Table | None:
    """The field against what can be had without one; None where views were chosen or none is known.

    The gap is to the better of the two, seed by seed.
    """
    known = [run for run in stats.completed(runs) if run.result.get("baselines")]
    if not known or any(len(run.rounds) > 1 for run in runs):
        return None
    rows, has_exposure = [], all(run.rounds[-1].get("psnr_exposure") for run in known)
    for policy in policies_of(known):
        mine = [run for run in known if run.policy == policy]
        field = [run.rounds[-1]["psnr"] for run in mine]
        colour = [run.result["baselines"]["mean_colour_psnr"] for run in mine]
        photo = [run.result["baselines"]["nearest_image_psnr"] for run in mine]
        above = [psnr - max(pair) for psnr, *pair in zip(field, colour, photo)]
        means = [stats.mean_interval(values) for values in (field, colour, photo, above)]
        cells = [interval_cell(mean, 2, "", gap=mean is means[-1]) for mean in means]
        if has_exposure:
            fitted = stats.mean_interval([run.rounds[-1]["psnr_exposure"] for run in mine])
            cells.insert(1, interval_cell(fitted, 2, ""))
        rows.append([policy, mine[0].rounds[-1]["num_test_views"], *cells])
    head = ["policy", "held-out views", "field (dB)", "mean colour (dB)", "nearest photo (dB)"]
    if has_exposure:
        head.insert(3, "at their exposure (dB)")
    return Table((*head, "above the better of the two (dB)"), rows)


def timing_table(runs: list[Run], policies: list[str]) -> Table:
    """Seconds of each part, all rounds of a run together, mean over completed runs.

    Parts that no run has spent any time on are left out.
    """
    done = [p for p in policies if stats.completed(runs, p)]
    used = [part for part in PARTS if any(stats.run_seconds(runs, p, part).mean for p in done)]
    rows = []
    for policy in policies:
        means = [stats.run_seconds(runs, policy, *parts) for parts in (*zip(used), used)]
        why = f"{policy}: no completed run"
        rows.append([policy, *(seconds(i.mean) if i else dash(why) for i in means)])
    return Table(["policy", *(PARTS[part] for part in used), "together"], rows)


def choices_table(run: Run, acquisition: dict[str, np.ndarray]) -> Table:
    """What one run chose round by round, with the policy's scores, and out of what."""
    names = acquisition.get("names", [f"view {v}" for v in range(len(acquisition["positions"]))])
    rows = []
    choices = zip(acquisition["selected"], acquisition["scores"])
    for number, (selected, scores) in enumerate(choices, start=1):
        info = run.rounds[number] if number < len(run.rounds) else {}
        bound = info.get("batch_bound")
        numbers = [info.get(k) for k in ("num_candidates", "num_survivors", "farthest_overlap")]
        numbers.append(bound and f"{bound['ratio']:.0%}")
        chosen = [  # -1 fills a round that chose fewer
            f"{names[v]} ({scores[v]:.4g})" if np.isfinite(scores[v]) else str(names[v])
            for v in selected[selected >= 0]
        ]
        rows.append([number, *("—" if n is None else n for n in numbers), ", ".join(chosen)])
    head = ("round", "candidates", "left by the distance filter", "farthest-view would share")
    head = (*head, "gain / most that a batch can gain", "chosen (score)")
    # Without what this policy has in no round.
    kept = [i for i in range(len(head)) if not rows or any(row[i] != "—" for row in rows)]
    return Table(tuple(head[i] for i in kept), [[row[i] for i in kept] for row in rows])


# --- settings of a sweep ---

SCENE_OPTIONS = ("loader", "data_dir", "scene")  # PSNRs of two scenes are no gap


class Setting(NamedTuple):
    """The runs of one combination of options."""

    name: str
    values: dict[str, Any]
    policies: list[str]
    runs: list[Run]  # empty where there is no result yet


def settings_table(settings: list[Setting]) -> Table:
    """Means over seeds at the end of each setting, with gaps paired by seed.

    Options that every setting sets have a column each; where settings differ in what they set, as
    with one change at a time, their names are the first column.
    """
    options = [*settings[0].values] if len({(*s.values,) for s in settings}) == 1 else []
    references = {s.name: _reference(s, settings, options) for s in settings}
    others = {words for _, words in references.values() if words}
    all_rounds = [r for s in settings for run in s.runs for r in run.rounds]
    measures = [m for m in MEASURES if any(r.get(m.key) is not None for r in all_rounds)]
    to_random = any(RANDOM in s.policies and len(s.policies) > 1 for s in settings)
    head = [*(options or ["setting"]), "policy", "seeds", "views", *(m.heading for m in measures)]
    head += [f"PSNR gap to {RANDOM} (dB)"] * to_random
    if others:
        other = others.pop() if len(others) == 1 else "the first of its kind"
        head.append(f"PSNR gap to {other} (dB)")
    rows = []
    for setting, policy in ((s, policy) for s in settings for policy in s.policies):
        row = [setting.values[o] for o in options] or [setting.name]
        row += [policy, len(stats.completed(setting.runs, policy))]
        where = f"{setting.name}, "
        row += _cells(setting.runs, policy, measures, [RANDOM] * to_random, where)
        if len(head) > len(row):
            row.append(_setting_gap(setting, references[setting.name][0], policy))
        rows.append(row)
    return Table(head, rows)


def _reference(
    setting: Setting, settings: list[Setting], options: list[str]
) -> tuple[Setting | None, str]:
    """What a setting is compared with, and in which options that one differs.

    The first setting that has the most of the leading options in common with it: in a sweep over
    views and steps, that of as many views. None where there is no other of the same scene. Where
    settings differ in what they set, all are compared with the very first.
    """
    if not options:
        return settings[0], settings[0].name
    for depth in range(len(options) - 1, -1, -1):
        shared = {*options[:depth], *(o for o in SCENE_OPTIONS if o in options)}
        alike = [s for s in settings if all(s.values[o] == setting.values[o] for o in shared)]
        if len(alike) > 1:
            differ = [f"{o}={alike[0].values[o]}" for o in options if o not in shared]
            return alike[0], ",".join(differ)
    return None, ""


def _setting_gap(setting: Setting, first: Setting | None, policy: str) -> Cell:
    """PSNR at the own last number of views: an option may change how many there are."""
    if not stats.completed(setting.runs, policy):
        return dash(f"{setting.name}, {policy}: no completed run")
    if first is None:
        return dash(f"{setting.name}: no other setting of this scene")
    if setting is first:
        return dash("a setting has no gap to itself")
    gap = stats.paired_gap(*(stats.by_seed(one.runs, policy) for one in (setting, first)))
    why = f"{policy}: {setting.name} and {first.name} share no seed"
    return interval_cell(gap, 2, why, gap=True)


# --- the paper beside ours ---


class Row(NamedTuple):
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
    """Rows of a table of `PAPER` beside ours of one experiment, and both gaps to random choice.

    Raises:
      ReportError: there is no such table.
    """
    if name not in PAPER:
        raise ReportError(f"paper={name}: no such table; use one of {', '.join(PAPER)}")
    printed = {row.policy: row for row in PAPER[name]}
    random = printed.get(RANDOM)
    timed = name == "table_4"
    measures = MEASURES[:3]
    initial = stats.completed(runs)
    rows = []
    for policy in dict.fromkeys([*printed, *policies]):
        row = printed.get(policy)
        owner, at = policy or "initial views", None
        if policy is None and initial:  # all policies share these views
            owner, at = initial[0].policy, [initial[0].rounds[0]["num_views"]]
        ours = _cells(runs, owner, measures, [RANDOM], at=at)[1:]
        if policy is None:
            ours[-1] = dash("the initial views are those of random choice too")
        theirs = [None] * len(ours)
        if row is not None:
            theirs = [f"{getattr(row, m.key):.{m.digits}f}" for m in measures]
            has_gap = random is not None and row is not random
            theirs.append(signed(row.psnr - random.psnr) if has_gap else None)
        if timed:
            ours += _choosing_cells(stats.completed(runs, policy), policy)
            theirs += [f"{row.seconds:.0f}", str(row.candidates)] if row else [None, None]
        theirs = [number or dash(NOT_PRINTED) for number in theirs]
        start = [policy or "initial views", row.name if row else dash(NOT_PRINTED)]
        rows.append(start + [cell for pair in zip(ours, theirs) for cell in pair])
    titles = [*(m.heading for m in measures), f"PSNR gap to {RANDOM} (dB)"]
    titles += ["scoring and selecting (s)", "candidates scored"] * timed
    head = ["policy", "in the paper", *(part for title in titles for part in (title, "paper"))]
    return Table(head, rows)


def _choosing_cells(runs: list[Run], policy: str) -> list[Cell]:
    """Seconds of looking at candidates, all rounds together, and how many there are in a round."""
    interval = stats.run_seconds(runs, policy, "score", "select")
    time = interval_cell(interval, 1, f"{policy}: no completed run")
    # Those that the distance filter left, or all where there is none.
    rounds = [r for run in runs for r in run.rounds[1:]]
    numbers = [r.get("num_survivors") or r.get("num_candidates") for r in rounds]
    known = [number for number in numbers if number is not None]
    why = f"{policy}: not in its result files" if rounds else time.why
    return [time, Cell(f"{np.mean(known):.0f}") if known else dash(why)]
