"""Random sets of views as tables and as a plot: how much is there to win, and by what."""

import pathlib

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from experiments.reporting import plots, stats
from experiments.reporting.results import read_result
from experiments.reporting.tables import Cell, Collected, Table, dash, interval_cell

FILE = "view_sets.json"
RANDOM = "random"  # the policy whose sets the others are held against
SHOWN = 4  # descriptors in the plot, the best ones
FEW = "fewer than three sets a descriptor"


def sets_table(result: dict) -> Table:
    """Spread and noise of random sets, and the share of the spread that is explained."""
    head = ("views", "random sets", "PSNR (dB)", "sd over sets", "sd of training", "best set")
    head += ("explained by all descriptors (R²)", "could be explained")
    rows = []
    for group in result["numbers"]:
        psnr, noise = group["random_psnr"], group["noise"]
        few = dash("fewer than two sets")
        spread = float(np.std(psnr, ddof=1)) if len(psnr) > 1 else None
        unknown = dash("no set was trained on twice")
        could = None if noise is None or not spread else max(0.0, 1.0 - (noise / spread) ** 2)
        share = group["explained"]
        rows.append(
            [
                str(group["num_views"]),
                str(len(psnr)),
                interval_cell(stats.mean_interval(psnr), 2, "no random set"),
                few if spread is None else f"{spread:.2f}",
                unknown if noise is None else f"{noise:.2f}",
                f"{max(psnr):.2f}" if len(psnr) else few,
                dash(FEW) if share is None else f"{share:.2f}",
                unknown if could is None else f"{could:.2f}",
            ]
        )
    return Table(head, rows)


def policies_table(result: dict) -> Table | None:
    """Where the sets of other policies stand among the random ones; None without any."""
    rows = []
    for group in result["numbers"]:
        others = [row for row in group["rows"] if row["policy"] != RANDOM]
        psnr = np.array(group["random_psnr"])
        for policy in dict.fromkeys(row["policy"] for row in others):
            mine = [row for row in others if row["policy"] == policy]
            values = [row["psnr"] for row in mine]
            below = [np.mean(psnr < value) for value in values] if len(psnr) else []
            predicted = [row["predicted"] for row in mine if "predicted" in row]
            why = "no random sets to compare with"
            rows.append(
                [
                    str(group["num_views"]),
                    policy,
                    interval_cell(stats.mean_interval(values), 2, ""),
                    Cell(f"{np.mean(below):.0%}") if below else dash(why),
                    interval_cell(stats.mean_interval(predicted), 2, FEW),
                ]
            )
    head = ("views", "policy", "PSNR (dB)", "random sets below it", "as its descriptors say (dB)")
    return Table(head, rows) if rows else None


def features_table(result: dict) -> Table:
    """Rank correlation of each descriptor with PSNR, over all sets."""
    groups = [group for group in result["numbers"] if group["features"]]
    names = list(groups[0]["features"]) if groups else []
    rows = []
    for name in sorted(names, key=lambda n: -abs(groups[0]["features"][n] or 0.0)):
        cells = [group["features"].get(name) for group in groups]
        same = dash(f"{name}: the same for all sets")
        rows.append([name, *(same if c is None else f"{c:+.2f}".replace("-", "−") for c in cells)])
    return Table(("descriptor", *(f"{g['num_views']} views" for g in groups)), rows)


def view_set_tables(path: pathlib.Path) -> Collected:
    """What a folder of view sets says."""
    result = read_result(path)
    tables = {"sets": sets_table(result), "policies": policies_table(result)}
    tables["descriptors"] = features_table(result)
    kept = {name: table for name, table in tables.items() if table is not None}
    return Collected(f"`{result['command']}` ({result['device']})", kept)


def features_plot(result: dict) -> Markup | None:
    """PSNR of sets against the descriptors that rank them best."""
    groups = [group for group in result["numbers"] if group["num_sets"] > 1]
    if not groups:
        return None
    figure = Figure(figsize=(3.2 * SHOWN, 3.0 * len(groups)))
    panels = figure.subplots(len(groups), SHOWN, squeeze=False)
    for group, line in zip(groups, panels):
        order = sorted(group["features"], key=lambda n: -abs(group["features"][n] or 0.0))
        policies = plots.by_interest({row["policy"] for row in group["rows"]})
        style = plots.policy_style(policies[: plots.MANY])
        for name, axes in zip(order, line):
            for policy in policies:
                mine = [row for row in group["rows"] if row["policy"] == policy]
                colour, marker = style.get(policy, (plots.PALE, "."))
                points = [(row["described"][name], row["psnr"]) for row in mine]
                look = {"color": colour, "marker": marker, "alpha": 0.7}
                look["label"] = policy if policy in style else None
                axes.scatter(*zip(*points), s=16, **look)
            axes.set_xlabel(name.replace("_", " "))
            axes.set_title(f"PSNR (dB), {group['num_views']} views")
        line[-1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return plots.to_svg(figure, salt="sets", label="PSNR against what sets are described by")
