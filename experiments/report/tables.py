"""Tables of the page: what each cell says, and why where it says nothing."""

from __future__ import annotations

import dataclasses

from experiments.report import stats
from experiments.report.choices import Round
from experiments.report.headline import REFERENCES, signed
from experiments.report.plots import PARTS, seconds
from experiments.report.results import Run


@dataclasses.dataclass(frozen=True)
class Cell:
    """Text of a cell; `why` explains a dash."""

    text: str
    why: str | None = None
    interval: stats.Interval | None = None  # what the text rounds
    p_value: float | None = None  # of a gap


@dataclasses.dataclass(frozen=True)
class Table:
    head: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why there are dashes, each reason once."""
        whys = [cell.why for row in self.rows for cell in row if cell.why]
        return tuple(dict.fromkeys(whys))


def dash(why: str) -> Cell:
    return Cell("—", why)


def missing_measure(measure: stats.Measure, runs: list[Run]) -> str:
    """Why a measure has no number."""
    values = [r.get(measure.key) for run in runs for r in run.rounds]
    if any(v is not None for v in values):
        return f"{measure.label}: not a finite number, or not measured at this number of views"
    if measure.key == "lpips":
        reasons = [run.result.get("lpips_reason") for run in runs]
        reason = next((r for r in reasons if r), "not measured")
        return f"LPIPS: {reason}"
    if measure.key == "depth_mae":
        return "Depth error: this scene has no true depth"
    return f"{measure.label}: not measured"


def interval_cell(interval: stats.Interval | None, digits: int, why: str, *, gap=False) -> Cell:
    """`mean ± half`, without the half where there is one seed; of a gap also how sure it is."""
    if interval is None:
        return dash(why)
    mean = signed(interval.mean, digits) if gap else f"{interval.mean:.{digits}f}"
    text = mean if interval.half is None else f"{mean} ± {interval.half:.{digits}f}"
    p_value = stats.paired_p_value(interval) if gap else None
    if p_value is not None:
        text += f" ({p_words(p_value)})"
    return Cell(text, interval=interval, p_value=p_value)


def seeds_cell(policy: str, runs: list[Run]) -> Cell:
    """How many seeds there are, and a note where the field of one learnt nothing."""
    stuck = [run.seed for run in runs if any(r.get("stuck") for r in run.rounds)]
    if not stuck:
        return Cell(str(len(runs)))
    seeds = ", ".join(str(seed) for seed in stuck)
    why = (
        f"{policy}: a field of seed {seeds} is stuck in fog, so these numbers are not its policy's"
    )
    return Cell(f"{len(runs)}*", why)


def p_words(p_value: float) -> str:
    """A p-value, as exactly as it matters."""
    return "p < 0.001" if p_value < 0.001 else f"p = {p_value:.2g}"


def final_table(runs: list[Run], policies: list[str]) -> Table:
    """Means over seeds at the largest number of views that all completed runs share."""
    num_views = stats.common_num_views(runs)
    done = [p for p in policies if stats.completed(runs, p)]
    references = [p for p in REFERENCES if p in done and len(done) > 1]
    head = ["policy", "seeds", "views"]
    head += [f"{m.label} ({m.unit})" if m.unit else m.label for m in stats.MEASURES]
    head += [f"PSNR gap to {p} (dB)" for p in references]
    rows = []
    for policy in policies:
        mine = stats.completed(runs, policy)
        row = [Cell(policy), seeds_cell(policy, mine)]
        if not mine:
            why = f"{policy}: no completed run"
            rows.append((*row, *[dash(why)] * (len(head) - 2)))
            continue
        row.append(Cell(str(num_views)) if num_views is not None else dash("no shared number"))
        for measure in stats.MEASURES:
            interval = stats.over_seeds(runs, policy, measure.key, num_views)
            row.append(interval_cell(interval, measure.digits, missing_measure(measure, mine)))
        for reference in references:
            if reference == policy:
                row.append(dash("a policy has no gap to itself"))
                continue
            pair = stats.compare(runs, policy, reference, "psnr", num_views)
            gap = pair.gap if pair else None
            row.append(_gap_cell(gap, f"{policy} and {reference} share no seed"))
        rows.append(tuple(row))
    return Table(tuple(head), tuple(rows))


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
            row.append(dash("a policy has no gap to itself") if same else _gap_cell(gap, why))
        rows.append(tuple(row))
    head = ["policy", *(f"PSNR at {n} views (dB)" for n in numbers)]
    return Table((*head, *(f"gap to {p}, mean of rounds (dB)" for p in references)), tuple(rows))


def _gap_cell(gap: stats.Interval | None, why: str) -> Cell:
    return interval_cell(gap, 2, why, gap=True)


def runs_table(runs: list[Run]) -> Table:
    """Every run by itself, at its own last round."""
    head = ["policy", "seed", "state", "views"]
    head += [f"{m.label} ({m.unit})" if m.unit else m.label for m in stats.MEASURES]
    rows = []
    for run in runs:
        row = [Cell(run.policy), Cell(str(run.seed))]
        row.append(Cell("completed" if run.completed else "incomplete"))
        if not run.rounds:
            rows.append((*row, *[dash(f"{run.label}: no round measured yet")] * (len(head) - 3)))
            continue
        num_views = run.rounds[-1]["num_views"]
        row.append(Cell(str(num_views)))
        for measure in stats.MEASURES:
            value = run.value(measure.key, num_views)
            text = dash(missing_measure(measure, [run])) if value is None else None
            row.append(text or Cell(f"{value:.{measure.digits}f}"))
        rows.append(tuple(row))
    return Table(tuple(head), tuple(rows))


def baseline_table(runs: list[Run], policies: list[str]) -> Table | None:
    """The field against what can be had without one; None where views were chosen or none is known.

    The gap is to the better of the two, seed by seed.
    """
    names = ("mean_colour_psnr", "nearest_image_psnr")
    known = [run for run in stats.completed(runs) if run.result.get("baselines")]
    if not known or any(len(run.rounds) > 1 for run in runs):
        return None
    rows = []
    for policy in policies:
        mine = [run for run in known if run.policy == policy]
        psnr = [run.rounds[-1]["psnr"] for run in mine]
        guesses = [[run.result["baselines"][name] for run in mine] for name in names]
        gaps = [p - max(pair) for p, *pair in zip(psnr, *guesses)]
        why = f"{policy}: no completed run"
        cells = [interval_cell(stats.mean_interval(v), 2, why) for v in (psnr, *guesses)]
        gap = interval_cell(stats.mean_interval(gaps), 2, why, gap=True)
        rows.append((Cell(policy), Cell(str(mine[0].rounds[-1]["num_test_views"])), *cells, gap))
    head = ("policy", "held-out views", "field (dB)", "mean colour (dB)", "nearest photo (dB)")
    return Table((*head, "above the better of the two (dB)"), tuple(rows))


def timing_table(runs: list[Run], policies: list[str]) -> Table:
    """Seconds of each part, all rounds of a run together, mean over completed runs.

    Parts that no run has spent any time on are left out.
    """
    used = [p for p in PARTS if any(stats.mean_seconds(runs, policy, p) for policy in policies)]
    head = ("policy", *(PARTS[part][0] for part in used), "together")
    rows = []
    for policy in policies:
        parts = [stats.mean_seconds(runs, policy, part) for part in used]
        if None in parts:
            cells = [dash(f"{policy}: no completed run")] * (len(head) - 1)
        else:
            cells = [Cell(seconds(value)) for value in (*parts, sum(parts))]
        rows.append((Cell(policy), *cells))
    return Table(head, tuple(rows))


def choice_table(one: Round) -> Table:
    """Why each view of a round was chosen: its score, its rank, its distance from what was held."""
    scored = any(choice.score is not None for choice in one.choices)
    filtered = scored and not one.survives.all()
    head = ["view", *["score", "rank among all"] * scored, *["rank after filter"] * filtered]
    rows = []
    for choice in one.choices:
        row = [Cell(choice.name)]
        if choice.score is not None:
            row += [Cell(f"{choice.score:.4g}"), Cell(f"{choice.rank} of {choice.num_scored}")]
            row += [Cell(f"{choice.rank_left} of {choice.num_left}")] * filtered
        else:
            row += [dash(f"{choice.name} was not scored")] * (len(head) - 1)
        rows.append((*row, Cell(f"{choice.distance:.3g}")))
    return Table((*head, "nearest training view (scene units)"), tuple(rows))
