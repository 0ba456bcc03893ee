"""Tables that fill themselves from the modules of a package."""

from __future__ import annotations

import importlib
import pkgutil


def collect(package: str, path, attribute: str, kind: type) -> dict:
    """Imports every module of a package and collects what each holds, sorted by name.

    Args:
      package: its full name.
      path: its `__path__`.
      attribute: what every module must hold: a tuple of objects with a `name`.
      kind: their type.

    Raises:
      ValueError: a module without it, or two objects of one name.
    """
    table, folder = {}, package.rsplit(".", 1)[-1]
    for module_info in pkgutil.iter_modules(path):
        file = f"{folder}/{module_info.name}.py"
        entries = getattr(importlib.import_module(f"{package}.{module_info.name}"), attribute, None)
        is_tuple = type(entries) is tuple and entries
        if not is_tuple or not all(isinstance(entry, kind) for entry in entries):
            raise ValueError(f"{file}: must hold {attribute} = ({kind.__name__}(name=..., ...),)")
        for entry in entries:
            if entry.name in table:
                raise ValueError(f"{file}: the name {entry.name!r} is taken; give it another")
            table[entry.name] = entry
    return dict(sorted(table.items()))
