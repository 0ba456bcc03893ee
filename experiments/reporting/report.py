"""The report of a run: what came out in plain words, then all numbers, pictures and choices."""

import json
import os
from pathlib import Path

from bavs_jax.pools import BANDS, crowded_band
from experiments.reporting import pictures, plots, results, run_tables, stats
from experiments.reporting.camera_map import map_plot
from experiments.reporting.stats import MEASURES, REFERENCES
from experiments.reporting.tables import interval_cell, write_template

SEED_SPREAD = (
    "One seed proves little: seeds often differ by half a dB, as much as most gains; run 5 or more."
)


def write_report(workdir: str | os.PathLike) -> Path:
    """Writes `report.html` from the result files of a working folder, and says where.

    Pictures and maps are of the runs that have `pictures.npz` and `acquisition.npz`. Raises
    ReportError for a file that cannot be used.
    """
    runs = results.load_runs(Path(workdir))
    policies = plots.by_interest(results.policies_of(runs))
    runs = sorted(runs, key=lambda run: (policies.index(run.policy), run.seed))
    curves = []
    for measure in MEASURES:
        figure = plots.quality_figure(runs, policies, measure)
        if figure is not None:
            label = f"{measure.label} against training views"
            curves.append(plots.to_svg(figure, salt=f"quality-{measure.key}", label=label))
    configs: dict[str, list[str]] = {}
    for run in runs:
        made = {key: run.result.get(key) for key in ("versions", "config")}
        text = json.dumps(made, indent=2, sort_keys=True)
        configs.setdefault(text, []).append(run.label)
    path = Path(workdir) / "report.html"
    write_template(
        path,
        "report.html",
        runs=runs,
        pool=next((pool_words(run.result.get("config", {}).get("pool", {})) for run in runs), ""),
        policies=policies,
        headline=make_headline(runs, policies),
        curves=curves,
        final=run_tables.final_table(runs, policies),
        by_round=run_tables.rounds_table(runs, policies),
        strips=_strips(runs),
        maps=_maps(runs),
        timing=run_tables.timing_table(runs, policies),
        configs=configs,
    )
    return path


def _strips(runs: list[results.Run]) -> dict[str, tuple]:
    """By policy, of its first run that has some: label, round, and its test views."""
    found = pictures.first_pictures(runs)
    limits = pictures.uncertainty_limits([arrays for _, arrays in found.values()])
    strips = {}
    for number, (policy, (run, arrays)) in enumerate(found.items()):
        if len(arrays["view_ids"]):
            shown = {policy: arrays}
            figure = pictures.views_figure(shown, pictures.MAX_VIEWS, limits, errors=True)
            words = f"Test views of {run.label}"
            svg = plots.to_svg(figure, salt=f"views{number}", label=words)
            strips[policy] = run.label, int(arrays["round"]), svg
    return strips


def _maps(runs: list[results.Run]) -> dict[str, tuple]:
    """By run, the maps of its rounds and the table of its choices."""
    maps = {}
    for number, run in enumerate(runs):
        if (arrays := results.load_acquisition(run)) is not None:
            svg = map_plot(arrays, salt=f"map{number}")
            maps[run.label] = svg, run_tables.choices_table(run, arrays)
    return maps


def pool_words(pool: dict) -> str:
    """What the pool of a config is, in a sentence; empty where it is even."""
    kind = pool.get("kind", "even")
    if kind == "even":
        return ""
    if kind == "unbalanced":
        band = BANDS[crowded_band(pool["seed"])]
        words = f"{100 * pool['share']:g} % of it in the {band} of three bands of elevation"
    elif kind == "arc":
        words = f"runs begin with views within {pool['degrees']:g} degrees of azimuth"
    elif kind == "reachable":
        words = f"on offer are the {pool['num_nearest']} unused views nearest to the last one"
    else:
        words = f"distances differ by a factor of up to {pool['factor']:g}, in test views too"
    return f"Pool: {kind}, seed {pool['seed']}: {words}."


def make_headline(runs: list[results.Run], policies: list[str]) -> tuple[str, str]:
    """What came out, and what that proves, for better or worse."""
    done = plots.by_interest(p for p in policies if stats.completed(runs, p))
    num_views = max(stats.shared_num_views(runs), default=None)
    if num_views is None:
        return "There is no result yet.", "No run has been completed so far."
    focus, *others = done
    level = interval_cell(stats.mean_interval(stats.by_seed(runs, focus)), 2, "")
    result = f"With {num_views} views, {focus} reached a PSNR of {level.text} dB"
    gaps = {p: stats.paired_gap(stats.by_seed(runs, focus), stats.by_seed(runs, p)) for p in others}
    # Random and farthest-view first, then whatever else there is.
    gaps = {p: gaps[p] for p in [*REFERENCES, *others] if gaps.get(p) is not None}
    if not gaps:
        verdict = "No seed has two policies, so there is nothing to compare it with: add random"
        return f"{result}.", f"{verdict} to config.policies."
    words = [
        f"{interval_cell(gap, 2, '', gap=True).text} against {p}"
        for p, gap in list(gaps.items())[: len(REFERENCES)]
    ]
    (reference, gap), *_ = gaps.items()
    verdict = f"Here {focus} is {'better' if gap.mean > 0.0 else 'worse'} than {reference}"
    if gap.half is None:
        verdict = f"{verdict}. {SEED_SPREAD}"
    elif abs(gap.mean) <= gap.half:
        verdict += " on average, but the interval includes zero: no clear difference."
    else:
        verdict += ", and the interval excludes zero."
    return f"{result}: {', '.join(words)}.", verdict
