"""Paired gaps of many policies to one of them, sorted: the picture of a table of rivals."""

from __future__ import annotations

from matplotlib.figure import Figure

from experiments.report import stats
from experiments.report.headline import REFERENCES
from experiments.report.plots import GREY, policy_style, tidy, to_svg
from experiments.report.results import Run

MANY = 7  # policies from which curves crowd, and each no longer has a colour of its own


def gap_plot(runs: list[Run], policies: list[str], coloured: list[str]) -> str | None:
    """PSNR of each policy minus that of random choice, seed by seed; None without random.

    Large dots are means with their 95 % intervals, small ones single seeds. The scale follows the
    seeds: intervals over two or three seeds may reach beyond it. Policies in `coloured` have the
    colours of their curves.
    """
    reference = REFERENCES[0]
    num_views = stats.common_num_views(runs)
    if num_views is None or len(policies) < 3:
        return None
    rows = []
    for policy in policies:
        pair = stats.compare(runs, policy, reference, "psnr", num_views)
        if policy != reference and pair is not None:
            seeds = stats.paired_gaps(runs, policy, reference, "psnr", num_views)
            rows.append((pair.gap, seeds, policy))
    if not rows:
        return None
    rows.sort(key=lambda row: row[0].mean)
    style = policy_style(coloured)
    figure = Figure(figsize=(10.6, 1.0 + 0.28 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.axvline(0.0, color=GREY, linewidth=1.2, zorder=1)
    for place, (gap, seeds, policy) in enumerate(rows):
        colour, _ = style.get(policy, (GREY, None))
        if gap.half is not None:
            axes.plot([gap.low, gap.high], [place, place], color=colour, linewidth=1.6, zorder=2)
        single = {"s": 20, "edgecolors": "white", "linewidths": 0.6, "zorder": 2.5}
        axes.scatter(seeds, [place] * len(seeds), color=colour, **single)
        axes.scatter([gap.mean], [place], s=70, color=colour, edgecolors="white", zorder=3)
    values = [0.0] + [g for _, seeds, _ in rows for g in seeds]
    margin = 0.15 * (max(values) - min(values)) + 0.05
    axes.set_xlim(min(values) - margin, max(values) + margin)
    axes.set_yticks(range(len(rows)), [policy for _, _, policy in rows])
    axes.set_xlabel(f"PSNR minus that of {reference} with {num_views} views (dB)", fontsize=10)
    tidy(axes)
    axes.grid(axis="x", color="#e5e7eb", linewidth=0.8)
    return to_svg(figure, salt="gaps", label=f"PSNR gap of each policy to {reference}")


def in_colour(runs: list[Run], policies: list[str], focus: str | None) -> list[str]:
    """The policies whose curves are told apart: all, or of many the few that matter most.

    Those are ours, the references, and the best of the others at the end.
    """
    if len(policies) <= MANY:
        return policies
    num_views = stats.common_num_views(runs)
    finals = {p: stats.over_seeds(runs, p, "psnr", num_views) for p in policies}
    ranked = sorted((p for p in policies if finals[p]), key=lambda p: -finals[p].mean)
    return list(dict.fromkeys(p for p in (focus, *REFERENCES, *ranked[:2]) if p in policies))
