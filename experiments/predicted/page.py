"""The page that shows how well predicted gains tell realised ones."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

from markupsafe import Markup

from experiments.predicted.cases import Case
from experiments.predicted.plots import gain_plot
from experiments.predicted.results import HELD_OUT, correlation_table, stop_table
from experiments.web.page import write_template


def write_page(path: pathlib.Path, *, cases: Sequence[Case], result: dict) -> None:
    """Plots of every predictor, and the tables.

    Args:
      path: where to.
      cases: all batches.
      result: the result file.
    """
    write_template(
        path,
        pathlib.Path(__file__).parent,
        scenes=", ".join(dict.fromkeys(case.scene for case in cases)),
        num_cases=len(cases),
        left_out=result["left_out"],
        planned=result["planned"],
        commands=result["commands"],
        plots=[Markup(gain_plot(cases, name)) for name in result["predictors"]],
        correlations=correlation_table(result),
        stops=[(held, stop_table(result, held)) for held in HELD_OUT],
    )
