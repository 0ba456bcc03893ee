"""What the paper prints, beside ours."""

from __future__ import annotations

import dataclasses

from experiments.report import stats
from experiments.report.headline import signed
from experiments.report.results import ReportError, Run
from experiments.report.tables import Cell, Table, dash, interval_cell, missing_measure


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
TABLES: dict[str, tuple[Row, ...]] = {
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


REFERENCE = "random"
NOT_PRINTED = "the paper prints no such number"
MEASURES = tuple(m for m in stats.MEASURES if m.key in ("psnr", "ssim", "lpips"))


def paper_table(runs: list[Run], policies: list[str], name: str) -> Table:
    """Each of the paper's rows and each of ours, and both gaps to random choice.

    Args:
      runs: of one experiment.
      policies: what we ran.
      name: of the table, a key of `printed.TABLES`.

    Raises:
      ReportError: there is no such table.
    """
    if name not in TABLES:
        raise ReportError(f"paper={name}: no such table; use one of {', '.join(TABLES)}")
    printed = TABLES[name]
    known = {row.policy for row in printed}
    rows = [(row.policy, row) for row in printed]
    rows += [(policy, None) for policy in policies if policy not in known]
    timed = any(row.seconds is not None for row in printed)
    head = ["policy", "in the paper"]
    for measure in MEASURES:
        unit = f" ({measure.unit})" if measure.unit else ""
        head += [f"{measure.label}{unit}", "paper"]
    head += [f"PSNR gap to {REFERENCE} (dB)", "paper"]
    head += ["scoring and selecting (s)", "paper", "candidates scored", "paper"] * timed
    lines = []
    for policy, row in rows:
        cells = [Cell(policy or "initial views"), _printed(row and row.name)]
        for measure in MEASURES:
            cells.append(_our_measure(runs, policies, policy, measure))
            cells.append(_printed(row and f"{getattr(row, measure.key):.{measure.digits}f}"))
        cells += [_our_gap(runs, policy), _printed(_printed_gap(printed, row))]
        if timed:
            cells += [_seconds(runs, policy), _printed(row and f"{row.seconds:.0f}")]
            cells += [_candidates(runs, policy), _printed(row and str(row.candidates))]
        lines.append(tuple(cells))
    return Table(tuple(head), tuple(lines))


def _printed(text: str | None) -> Cell:
    return dash(NOT_PRINTED) if text is None else Cell(text)


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
    if policy == REFERENCE:
        return dash("a policy has no gap to itself")
    if policy is None:
        return dash("the initial views are those of random choice too")
    if not stats.completed(runs, policy):
        return dash(_no_run(policy))
    pair = stats.compare(runs, policy, REFERENCE, "psnr", stats.common_num_views(runs))
    why = f"{policy} and {REFERENCE} share no seed"
    return interval_cell(pair.gap if pair else None, 2, why, gap=True)


def _printed_gap(printed: tuple[Row, ...], row: Row | None) -> str | None:
    levels = {other.policy: other.psnr for other in printed}
    if row is None or row.policy == REFERENCE or REFERENCE not in levels:
        return None
    return signed(row.psnr - levels[REFERENCE])


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
