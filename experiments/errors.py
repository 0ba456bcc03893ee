"""What can be wrong with what a user gives: each error is one line with the fix."""

from bavs_jax.export.formats import ExportError
from bavs_jax.placement.collect import PlacementError
from bavs_jax.scenes import SceneError
from bavs_jax.selection.context import SelectionError


class ConfigError(ValueError):
    """An option that cannot be used: one line that names it and the fix."""


class WorkdirError(ValueError):
    """A folder that cannot be used: one line that names the file, the field and the fix."""


class ReportError(ValueError):
    """A file that cannot be used: one line that names the file, the field and the fix."""


# What a script prints in place of a traceback; the last is a loss that is not finite.
USER_ERRORS = (
    SceneError,
    SelectionError,
    PlacementError,
    ExportError,
    ConfigError,
    WorkdirError,
    ReportError,
    FloatingPointError,
)


def shown(value) -> str:
    """A value that a user gave, in one short line of characters that can be printed."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write out a number of thousands of digits
        return f"a number of {value.bit_length():,} bits"
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text):,} characters)"


def one_line(error: Exception) -> str:
    """An error in one line: of a traceback, where it began and what went wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(dict.fromkeys([lines[0], lines[-1]])) if lines else type(error).__name__
