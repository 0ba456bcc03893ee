"""Tables that fill themselves: every module of a package holds one entry."""

from __future__ import annotations

import importlib
import pkgutil


def collect(package: str, path, attribute: str, kind: str) -> dict:
    """Imports every module of a package and collects one attribute of each, by module name.

    Args:
      package: its full name.
      path: its `__path__`.
      attribute: what every module must hold, an object whose `name` is the module's.
      kind: its type, for messages.

    Raises:
      ValueError: a module without it, or with another name in it.
    """
    table = {}
    for module_info in pkgutil.iter_modules(path):
        name = module_info.name
        entry = getattr(importlib.import_module(f"{package}.{name}"), attribute, None)
        if entry is None or entry.name != name:
            folder = package.rsplit(".", 1)[-1]
            raise ValueError(
                f"{folder}/{name}.py: must hold {attribute} = {kind}(name={name!r}, ...)"
            )
        table[name] = entry
    return table
