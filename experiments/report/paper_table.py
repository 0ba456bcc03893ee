"""Our rows beside those that the paper prints."""

from __future__ import annotations

from experiments.report import stats
from experiments.report.headline import signed
from experiments.report.printed import TABLES, Row
from experiments.report.results import ReportError, Run
from experiments.report.tables import Cell, Table, dash, interval_cell, missing_measure

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
