"""The result files of the benchmark and of time to quality, as tables and pages."""

import pathlib

from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.files import write_json
from experiments.reporting import plots
from experiments.reporting.results import read_result
from experiments.reporting.tables import (
    Cell,
    Collected,
    Section,
    Table,
    collected_text,
    dash,
    seconds,
    write_page,
)

BENCHMARK, QUALITY = "benchmark.json", "time_to_quality.json"
STAGES = {
    "train": "training",
    "render": "rendering",
    "curvature": "curvature",
    "score": "scoring candidates",
    "select": "selecting a batch",
}
NEAR = 0.3  # dB below the plateau, from where on a field counts as done


def amount(value: float, unit: str) -> str:
    """A number with three digits and a unit prefix: `1.23 GB`."""
    return EngFormatter(unit)(float(f"{value:.3g}"))


def duration(value: float) -> str:
    """Seconds in words, milliseconds below one."""
    return f"{1e3 * value:.3g} ms" if value < 0.9995 else seconds(value)


# --- the benchmark ---------------------------------------------------------------------------


def stage_table(result: dict) -> Table:
    """Rates and compile times; of older files, operations and bytes too, which they counted."""
    head = ("stage", "a second", "one run", "compiling")
    counted = all("flops_per_run" in row for row in result["stages"].values())
    if counted:
        head += ("operations a second", "of the matrix product", "bytes a second", "of the copy")
    rows = []
    for name, title in STAGES.items():
        row = result["stages"][name]
        unit = row["unit"]
        run = f"{row[f'{unit}_per_run']:,.0f} in {duration(row['median_run_s'])}"
        texts = (title, f"{row[f'{unit}_per_s']:,.0f} {unit}", run, duration(row["compile_s"]))
        cells = [*map(Cell, texts)]
        if counted:
            flops, share = amount(row["flops_per_s"], "FLOP"), row["share_of_matmul_ceiling"]
            known = row["flops_per_run"] > 0.0
            unknown = [dash("operations were not counted on this device")] * 2
            cells += [Cell(flops), Cell(f"{share:.1%}")] if known else unknown
            cells.append(Cell(amount(row["bytes_per_s"], "B")))
            cells.append(Cell(f"{row['share_of_copy_ceiling']:.1%}"))
        rows.append(tuple(cells))
    return Table(head, tuple(rows))


def benchmark_tables(path: pathlib.Path) -> Collected:
    """What a benchmark found; the notes say what the tables do not hold."""
    result = read_result(path)
    flops, copied = (result["ceilings"][x] for x in ("matmul_flops_per_s", "copy_bytes_per_s"))
    memory = f"Peak memory: {result['peak_memory_mb']:,.0f} MB of the host"
    if result["peak_device_memory_mb"] is not None:
        memory += f", {result['peak_device_memory_mb']:,.0f} MB of the device"
    notes = (
        f"Training evaluates {result['train_samples_per_s']:,.0f} samples a second.",
        f"Ceilings: {amount(flops, 'FLOP/s')} in a float32 matrix product, "
        f"{amount(copied, 'B/s')} in a copy.",
        f"{memory}.",
    )
    made = f"`{result['command']}` ({result['device']})"
    return Collected(made, {"stages": stage_table(result)}, notes)


# --- time to quality -------------------------------------------------------------------------


def quality_table(result: dict) -> Table:
    """Seconds to each PSNR, and to within 0.3 dB of the best."""
    targets = list(next(iter(result["runs"].values()))["seconds_to_db"])
    rows = []
    for cache, run in result["runs"].items():
        best, ending = run["plateau"]["db"], run["plateau"]["seconds"]
        why = f"not reached: {best:.2f} dB at most"
        reached = [(run["seconds_to_db"][target], why) for target in targets]
        cells = [
            dash(why) if value is None else Cell(seconds(value))
            for value, why in (*reached, (ending, "falls again"))
        ]
        rows.append((Cell(f"{cache} compilation cache"), *cells, Cell(f"{best:.2f}")))
    head = ("start", *(f"to {t} dB" for t in targets), "to 0.3 dB below the best", "best PSNR (dB)")
    return Table(head, tuple(rows))


def quality_tables(path: pathlib.Path) -> Collected:
    """How long it took to each quality."""
    result = read_result(path)
    made = f"`{result['command']}` ({result['device']})"
    return Collected(made, {"time_to_quality": quality_table(result)})


def plateau(curve: list[dict]) -> dict[str, float | None]:
    """The best PSNR of a curve, and seconds until it comes within `NEAR` dB of it for good.

    Returns:
      `db`, and `seconds` of the first look from which on none is further below; None if even
      the last one is.
    """
    best = max(point["psnr"] for point in curve)
    below = [i for i, point in enumerate(curve) if point["psnr"] < best - NEAR - 1e-6]
    near = curve[below[-1] + 1 :] if below else curve
    return {"db": best, "seconds": near[0]["seconds"] if near else None}


def first_seconds(curve: list[dict], targets: list[str]) -> dict[str, float | None]:
    """By target, seconds until it was first seen to be reached; None if it never was."""
    return {
        target: next((p["seconds"] for p in curve if p["psnr"] >= float(target)), None)
        for target in targets
    }


# --- plots and pages -------------------------------------------------------------------------


def quality_plot(result: dict) -> Markup:
    """PSNR on test views against seconds since the process was started."""
    runs = result["runs"]
    figure = Figure(figsize=(6.2, 4.2))
    axes = figure.add_subplot()
    for target in next(iter(runs.values()))["seconds_to_db"]:
        axes.axhline(float(target), color=plots.PALE, linewidth=1.0)
    for (cache, run), colour in zip(runs.items(), (plots.BLUE, plots.VERMILION)):
        times, psnrs = zip(*((point["seconds"], point["psnr"]) for point in run["curve"]))
        axes.plot(times, psnrs, "o-", color=colour, label=f"{cache} compilation cache")
    axes.set_xlim(0.0, None)
    axes.set_xlabel("seconds since the start, without measuring")
    axes.set_title("PSNR on test views (dB)")
    axes.legend()
    return plots.to_svg(figure, salt="quality", label="PSNR against seconds")


FILES = {BENCHMARK: benchmark_tables, QUALITY: quality_tables}
STOOD = "From the start of the process; the clock stands while test views are measured."
SECTIONS = {  # of a page: the title of a table, what is said below it, and its plot
    "stages": ("Each stage", "Rates are medians over uniformly drawn training pixels.", None),
    "time_to_quality": ("Seconds to quality", STOOD, quality_plot),
}


def write_result(path: pathlib.Path, result: dict, title: str) -> None:
    """Writes a result file of `FILES` and a page beside it, and prints its tables."""
    write_json(path, result)
    found, sections = FILES[path.name](path), []
    for name, table in found.tables.items():
        heading, note, plot = SECTIONS[name]
        sections.append(Section(heading, table, note, [plot(result)] if plot else []))
    sections[0] = sections[0]._replace(note=" ".join([sections[0].note, *found.notes]))
    page, what = path.with_suffix(".html"), f"{result['scene']}, {result['num_views']} views"
    write_page(page, title=f"{title}: {what}", made=result, sections=sections)
    print(f"{collected_text(found)}\nnumbers: {path}\npage:    {page}")
