"""What can be wrong with what a user gives: each error is one line with the fix."""

from bavs_jax.export.extras import ExportError
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


def check_choice(name: str, value, known) -> None:
    """Raises ConfigError for an option that is not one of its choices."""
    if value not in known:
        raise ConfigError(f"config.{name}: {value!r} is unknown; use one of {tuple(known)}")
