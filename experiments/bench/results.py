"""The result files of `experiments.benchmark` and `experiments.time_to_quality`, as tables."""

from __future__ import annotations

import pathlib

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


def amount(value: float) -> str:
    """A number with three digits and a unit prefix: `1.23 G`."""
    for factor, prefix in ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= factor:
            return f"{value / factor:.3g} {prefix}"
    return f"{value:.3g} "


def duration(value: float) -> str:
    """Seconds in words, milliseconds below one."""
    return f"{1e3 * value:.3g} ms" if value < 0.9995 else seconds(value)


def stage_table(result: dict) -> Table:
    """Rates, compile times, and the shares of both ceilings."""
    head = ("stage", "a second", "one run", "compiling", "operations a second")
    head += ("of the matrix product", "bytes a second", "of the copy")
    rows = []
    for name, title in STAGES.items():
        row = result["stages"][name]
        unit = row["unit"]
        cells = (
            *(title, f"{row[f'{unit}_per_s']:,.0f} {unit}"),
            f"{row[f'{unit}_per_run']:,.0f} in {duration(row['median_run_s'])}",
            duration(row["compile_s"]),
        )
        operations = (f"{amount(row['flops_per_s'])}FLOP", f"{row['share_of_matmul_ceiling']:.1%}")
        traffic = (f"{amount(row['bytes_per_s'])}B", f"{row['share_of_copy_ceiling']:.1%}")
        known = [*map(Cell, cells)]
        if row["flops_per_run"] > 0.0:
            known += [*map(Cell, operations)]
        else:
            known += [dash("operations were not counted on this device")] * 2
        rows.append((*known, *map(Cell, traffic)))
    return Table(head, tuple(rows))


def growth_table(result: dict) -> Table | None:
    """Exponents and straight lines, or None where growth was left out."""
    if not result["growth"]:
        return None
    head = ("what", "grows with", "from", "to", "time", "exponent", "off a straight line by")
    rows = []
    for row in result["growth"].values():
        first, last = (duration(row["median_s"][i]) for i in (0, -1))
        cells = [row["title"], row["size"], f"{row['sizes'][0]:,}", f"{row['sizes'][-1]:,}"]
        fit = row["fit"]
        known = [Cell(text) for text in (*cells, f"{first} to {last}")]
        why = f"{row['title']}: one size only"
        if fit is None:
            rows.append((*known, dash(why), dash(why)))
            continue
        fitted = (f"{fit['exponent']:.2f}", f"at most {fit['largest_deviation']:.0%}")
        rows.append((*known, *map(Cell, fitted)))
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
