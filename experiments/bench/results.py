"""The result files of the benchmark and of time to quality, as tables and pages."""

from __future__ import annotations

import pathlib

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator

from experiments.reporting import plots
from experiments.reporting.page import Section, write_page
from experiments.reporting.results import read_result
from experiments.reporting.tables import Cell, Collected, Table, dash, seconds

BENCHMARK, QUALITY = "benchmark.json", "time_to_quality.json"
STAGES = {
    "train": "training",
    "render": "rendering",
    "curvature": "curvature",
    "score": "scoring candidates",
    "select": "selecting a batch",
}
PANELS = 3  # of the plot of growth, side by side


def amount(value: float) -> str:
    """A number with three digits and a unit prefix: `1.23 G`."""
    for factor, prefix in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}"
    return f"{value:.3g} "


def duration(value: float) -> str:
    """Seconds in words, milliseconds below one."""
    return f"{1e3 * value:.3g} ms" if value < 0.9995 else seconds(value)


# --- tables ----------------------------------------------------------------------------------


def stage_table(result: dict) -> Table:
    """Rates and compile times; of older files, operations and bytes too, which they counted."""
    head = ["stage", "a second", "one run", "compiling"]
    counted = all("flops_per_run" in row for row in result["stages"].values())
    if counted:
        head += ["operations a second", "of the matrix product", "bytes a second", "of the copy"]
    rows = []
    for name, title in STAGES.items():
        row = result["stages"][name]
        unit = row["unit"]
        run = f"{row[f'{unit}_per_run']:,.0f} in {duration(row['median_run_s'])}"
        rate, compiling = f"{row[f'{unit}_per_s']:,.0f} {unit}", duration(row["compile_s"])
        cells = [Cell(text) for text in (title, rate, run, compiling)]
        if counted and row["flops_per_run"] > 0.0:
            cells.append(Cell(f"{amount(row['flops_per_s'])}FLOP"))
            cells.append(Cell(f"{row['share_of_matmul_ceiling']:.1%}"))
        elif counted:
            cells += [dash("operations were not counted on this device")] * 2
        if counted:
            cells.append(Cell(f"{amount(row['bytes_per_s'])}B"))
            cells.append(Cell(f"{row['share_of_copy_ceiling']:.1%}"))
        rows.append(tuple(cells))
    return Table(tuple(head), tuple(rows))


def growth_table(result: dict) -> Table | None:
    """Exponents and straight lines, or None where growth was left out."""
    if not result["growth"]:
        return None
    head = ("what", "grows with", "from", "to", "time", "exponent", "off a straight line by")
    rows = []
    for row in result["growth"].values():
        sizes, fit = row["sizes"], row["fit"]
        times = f"{duration(row['median_s'][0])} to {duration(row['median_s'][-1])}"
        texts = (row["title"], row["size"], f"{sizes[0]:,}", f"{sizes[-1]:,}", times)
        if fit is None:
            fitted = [dash(f"{row['title']}: one size only")] * 2
        else:
            deviation = f"at most {fit['largest_deviation']:.0%}"
            fitted = [Cell(f"{fit['exponent']:.2f}"), Cell(deviation)]
        rows.append((*map(Cell, texts), *fitted))
    return Table(head, tuple(rows))


def quality_table(result: dict) -> Table:
    """Seconds to each PSNR, and to within 0.3 dB of the best."""
    targets = list(next(iter(result["runs"].values()))["seconds_to_db"])
    rows = []
    for cache, run in result["runs"].items():
        reached, best = run["seconds_to_db"], run["plateau"]["db"]
        why = f"not reached: {best:.2f} dB at most"
        cells = [dash(why) if reached[t] is None else Cell(seconds(reached[t])) for t in targets]
        ending = run["plateau"]["seconds"]
        cells.append(dash("falls again") if ending is None else Cell(seconds(ending)))
        rows.append((Cell(f"{cache} compilation cache"), *cells, Cell(f"{best:.2f}")))
    head = ("start", *(f"to {t} dB" for t in targets), "to 0.3 dB below the best", "best PSNR (dB)")
    return Table(head, tuple(rows))


def facts(result: dict) -> list[str]:
    """What a table does not hold, a sentence each."""
    ceilings = result["ceilings"]
    memory = f"Peak memory: {result['peak_memory_mb']:,.0f} MB of the host"
    if result["peak_device_memory_mb"] is not None:
        memory += f", {result['peak_device_memory_mb']:,.0f} MB of the device"
    return [
        f"Training evaluates {result['train_samples_per_s']:,.0f} samples a second.",
        f"Ceilings: {amount(ceilings['matmul_flops_per_s'])}FLOP/s in a float32 matrix product, "
        f"{amount(ceilings['copy_bytes_per_s'])}B/s in a copy.",
        f"{memory}.",
    ]


def benchmark_tables(path: pathlib.Path) -> Collected:
    """What a benchmark found."""
    result = read_result(path)
    tables = {"stages": stage_table(result)}
    if (growth := growth_table(result)) is not None:
        tables["growth"] = growth
    return Collected(f"`{result['command']}` ({result['device']})", tables, tuple(facts(result)))


def quality_tables(path: pathlib.Path) -> Collected:
    """How long it took to each quality."""
    result = read_result(path)
    made = f"`{result['command']}` ({result['device']})"
    return Collected(made, {"time_to_quality": quality_table(result)})


# --- plots -----------------------------------------------------------------------------------


def growth_plot(growth: dict[str, dict]) -> str:
    """Seconds against size, both on log scales, with the straight line; linear has a slope of 1."""
    num_rows = -(-len(growth) // PANELS)
    figure = Figure(figsize=(4.0 * PANELS, 3.4 * num_rows), layout="constrained")
    panels = figure.subplots(num_rows, PANELS, squeeze=False).flat
    for row, axes in zip(growth.values(), panels):
        _draw_growth(axes, row)
    for axes in panels:  # that are left
        axes.set_axis_off()
    return plots.to_svg(figure, salt="growth", label="How the time of each stage grows")


def _draw_growth(axes: Axes, row: dict) -> None:
    sizes, times, fit = np.array(row["sizes"]), np.array(row["median_s"]), row["fit"]
    title = row["title"]
    if fit is not None:
        steps = np.geomspace(sizes[0], sizes[-1], 100)
        line = fit["intercept_s"] + fit["slope_s"] * steps
        label = f"straight line, off by at most {fit['largest_deviation']:.0%}"
        axes.plot(steps[line > 0], line[line > 0], "--", color=plots.GREY, label=label)
        proportional = times[-1] * steps / sizes[-1]
        axes.plot(steps, proportional, color=plots.PALE, linewidth=1.0, label="in proportion")
        title += f"\ntime ~ n^{fit['exponent']:.2f}"
    axes.plot(sizes, times, "o", color=plots.BLUE, markeredgecolor="white", label="measured")
    axes.set(xscale="log", yscale="log")
    # Room above and below, so that a time which does not grow looks like one.
    axes.set_ylim(min(times.min() / 2, times.max() / 8), times.max() * 2)
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes], rotation=30, ha="right")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{1e3 * value:g} ms"))
    axes.set_xlabel(f"n: {row['size']}", fontsize=9.5)
    axes.set_title(title, fontsize=10, loc="left")
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=8)


def quality_plot(result: dict) -> str:
    """PSNR on test views against seconds since the process was started."""
    runs = result["runs"]
    style = plots.policy_style(list(runs))
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for target in next(iter(runs.values()))["seconds_to_db"]:
        axes.axhline(float(target), color=plots.PALE, linewidth=1.0)
    for cache, run in runs.items():
        times, psnrs = zip(*((point["seconds"], point["psnr"]) for point in run["curve"]))
        colour, marker = style[cache]
        axes.plot(times, psnrs, color=colour, marker=marker, label=f"{cache} compilation cache")
    axes.set_xlim(0.0, None)
    axes.set_xlabel("seconds since the start, without measuring", fontsize=10)
    axes.set_title("PSNR on test views (dB)", fontsize=10.5, loc="left")
    plots.tidy(axes)
    axes.legend(frameon=False, fontsize=9)
    return plots.to_svg(figure, salt="quality", label="PSNR against seconds")


# --- pages -----------------------------------------------------------------------------------


def write_benchmark_page(path: pathlib.Path, result: dict) -> None:
    """Rates, and growth where it was measured."""
    note = " ".join(facts(result)) + " Rates are medians over uniformly drawn training pixels."
    sections = [Section("Each stage", stage_table(result), note)]
    if (table := growth_table(result)) is not None:
        note = "Medians of warm runs. An exponent of 1 is linear growth; below 1, a fixed cost "
        note += "still shows, which the straight line allows for."
        sections.append(Section("Growth", table, note, [growth_plot(result["growth"])]))
    title = f"How fast bavs_jax is: {result['scene']}, {result['num_views']} views"
    write_page(path, title=title, made=result, sections=sections)


def write_quality_page(path: pathlib.Path, result: dict) -> None:
    """Time to quality."""
    note = (
        f"From the start of the process, with all imports and compilation, on "
        f"{result['num_views']} training views; PSNR is the mean over "
        f"{result['num_test_views']} test views, measured while the clock stands. The last "
        "time is that of the first look from which on none is 0.3 dB below the best."
    )
    section = Section("Seconds to quality", quality_table(result), note, [quality_plot(result)])
    title = f"Time to quality: {result['scene']}, {result['num_views']} views"
    write_page(path, title=title, made=result, sections=[section])
