"""The libraries that only an export needs."""

from __future__ import annotations

import importlib
from types import ModuleType

PACKAGES = {"nrrd": "pynrrd", "skimage.measure": "scikit-image", "trimesh": "trimesh"}


class ExportError(ValueError):
    """An export that cannot be made: one line that names what is wrong and the fix."""


def import_extra(name: str) -> ModuleType:
    """One of the modules in `PACKAGES`.

    Raises:
      ExportError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExportError(
            f"{PACKAGES[name]}: is not installed ({error}): pip install 'bavs_jax[export]'"
        ) from error
