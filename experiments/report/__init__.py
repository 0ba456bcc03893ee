"""One self-contained page that shows what a run's files say."""

from experiments.report.page import write_report
from experiments.report.results import ReportError

__all__ = ["ReportError", "write_report"]
