"""Names: checks of them, and tables that fill themselves from the modules of a package."""

import importlib
import pkgutil
from collections.abc import Iterable
from typing import Protocol, TypeVar


def check_known(field: str, name: str, known: Iterable[str]) -> None:
    """Raises ValueError where a name is none of those that are known."""
    if name not in (known := tuple(known)):
        raise ValueError(f"{field}: {name!r} is unknown; use one of {', '.join(known)}")


class Named(Protocol):
    """What has a name that nothing else of its kind has."""

    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=Named)


def collect(package: str, path: Iterable[str], attribute: str, kind: type[T]) -> dict[str, T]:
    """Imports every module of a package and collects what each holds, sorted by name.

    Args:
      package: its full name.
      path: its `__path__`.
      attribute: what every module must hold: a tuple of objects with a `name`.
      kind: their type.

    Raises:
      ValueError: a module without it, or two objects of one name.
    """
    table: dict[str, T] = {}
    folder = package.rsplit(".", 1)[-1]
    for module_info in pkgutil.iter_modules(path):
        file = f"{folder}/{module_info.name}.py"
        entries = getattr(importlib.import_module(f"{package}.{module_info.name}"), attribute, ())
        is_tuple = type(entries) is tuple and len(entries) > 0
        if not is_tuple or not all(isinstance(entry, kind) for entry in entries):
            raise ValueError(f"{file}: must hold {attribute} = ({kind.__name__}(name=..., ...),)")
        for entry in entries:
            if entry.name in table:
                raise ValueError(f"{file}: the name {entry.name!r} is taken; give it another")
            table[entry.name] = entry
    return dict(sorted(table.items()))
