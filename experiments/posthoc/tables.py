"""Tables of the result files that scripts on a trained run write, over their seeds."""

from __future__ import annotations

from collections.abc import Callable

from experiments.report import stats
from experiments.report.tables import Cell, Table, interval_cell

SPLITS = {  # of `draws.json`
    "training": "training views",
    "test": "test views",
    "farthest": "the test view farthest from all training views",
}


def cleanup_table(rows: list[dict]) -> Table:
    """Test views before and after the clean-up, and the change, seed by seed."""
    head = ("", "PSNR over pixels still covered (dB)", "PSNR over all pixels (dB)")
    head += ("matter covered (%)", "empty pixels covered (%)", "content of training views kept (%)")

    def numbers(when: str, row: dict) -> list[float | None]:
        test, train = row[when]["test"], row[when]["training"]
        # Before and after are held against each other over the same pixels.
        after = row["after"]["test"]
        covered = after["psnr_covered_before" if when == "before" else "psnr_covered"]
        shares = (test["share_covered"], test["share_floating"], train["content_kept"])
        return [covered, test["psnr"], *(None if x is None else 100.0 * x for x in shares)]

    before, after = ([numbers(when, row) for row in rows] for when in ("before", "after"))
    change = [[_difference(*pair) for pair in zip(*pairs)] for pairs in zip(after, before)]
    lines = (("before", before, False), ("after", after, False), ("change", change, True))
    return Table(head, tuple(_line(name, part, 2, gap=gap) for name, part, gap in lines))


def draws_table(rows: list[dict]) -> Table:
    """How far pixels move over draws, in training views and in test views."""
    head = ("", "colours move by, pixels with matter", "all pixels", "rank correlation")
    names = ("spread", "spread_all", "rank_correlation")
    lines = [
        _line(words, [[row[split][name] for name in names] for row in rows], 4)
        for split, words in SPLITS.items()
    ]
    return Table(head, tuple(lines))


def geometry_table(rows: list[dict]) -> Table:
    """Distances of a mesh from the true surface, and the floor that the number of points sets."""
    names = ("chamfer", "accuracy", "completeness", "f_score")
    parts = {
        "seen": "what views see",
        "whole": "whole surface",
        "floor": "floor: two draws of the true surface",
    }
    distance = rows[0]["whole"]["distance"]
    head = ("", "Chamfer (scene units)", "mesh to truth", "truth to mesh")
    lines = [
        _line(words, [[row[part][name] for name in names] for row in rows], 4)
        for part, words in parts.items()
        if all(row[part] is not None for row in rows)
    ]
    return Table((*head, f"F-score at {distance:.3g}"), tuple(lines))


# By the name of the result file.
TABLES: dict[str, Callable[[list[dict]], Table]] = {
    "cleanup.json": cleanup_table,
    "draws.json": draws_table,
    "geometry.json": geometry_table,
}


def _line(name: str, by_seed: list[list], digits: int, *, gap: bool = False) -> tuple[Cell, ...]:
    cells = [Cell(name)]
    for values in zip(*by_seed):
        known = stats.mean_interval(value for value in values if value is not None)
        cells.append(interval_cell(known, digits, "no pixel counts", gap=gap))
    return tuple(cells)


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b
