"""What can be wrong with a config."""


class ConfigError(ValueError):
    """An option that cannot be used: one line that names it and the fix."""


def check_choice(name: str, value, known) -> None:
    """Raises ConfigError for an option that is not one of its choices."""
    if value not in known:
        raise ConfigError(f"config.{name}: {value!r} is unknown; use one of {tuple(known)}")
