"""A regular grid as an NRRD file, which ParaView, 3D Slicer, napari and others open."""

from __future__ import annotations

import io

import numpy as np

from bavs_jax.export.extras import import_extra


def nrrd_bytes(values, axes, *, user_from_scene, content: str) -> bytes:
    """One quantity on a grid, placed in the user's coordinates.

    A similarity may turn the grid: NRRD holds a vector per axis in place of a spacing. Point
    `(i, j, k)` lies at `origin + i step_x + j step_y + k step_z`.

    Args:
      values: [X, Y, Z] in the unit that `content` names.
      axes: [X], [Y], [Z] of at least two planes each, scene units.
      user_from_scene: [4, 4] similarity.
      content: what the values are, with their unit.

    Returns:
      the file, compressed.

    Raises:
      ExportError: pynrrd is not installed.
    """
    nrrd = import_extra("nrrd")
    matrix = np.asarray(user_from_scene, np.float64)
    steps = np.array([axis[1] - axis[0] for axis in axes])
    corner = np.array([axis[0] for axis in axes])
    header = {
        "content": content,
        "space dimension": 3,
        "space origin": matrix[:3, :3] @ corner + matrix[:3, 3],
        "space directions": steps[:, None] * matrix[:3, :3].T,
        "kinds": ["domain"] * 3,
        "centerings": ["node"] * 3,
    }
    file = io.BytesIO()
    nrrd.write(file, np.asarray(values, np.float32), header, index_order="F", compression_level=6)
    return file.getvalue()
